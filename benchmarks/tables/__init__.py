"""The paper's tables and figures, made with refield: what is run, what is kept, and how it is shown."""
