"""Scenes run by the commands of the product, scored, and summed up (benchmarks/gauntlet.py)."""
