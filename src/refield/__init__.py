"""refield keeps a radiance field true to a scene whose objects move."""

__version__ = "0.1.0"
