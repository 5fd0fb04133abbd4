"""What the update is measured against, on the same engine: re-training, direct fine-tuning, 2-D in-painting (§5.2)."""
