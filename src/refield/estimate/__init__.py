"""What changed? §4.2 of the paper, one file per step, in order."""
