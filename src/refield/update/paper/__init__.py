"""The paper's own update (§4.1, §10.1), step by step: the second route beside `refield.update.train`."""
