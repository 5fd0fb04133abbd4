"""The paper's own scene-change estimation (§4.2), step by step: the second route beside `refield.estimate.recipe`."""
