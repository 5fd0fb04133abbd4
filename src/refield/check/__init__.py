"""A capture looked over before any time is spent on it: ``refield check``."""
