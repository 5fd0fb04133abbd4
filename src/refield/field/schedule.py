"""How the learning rate falls over a training: the same for the fit of a field and for an update's helper."""

from __future__ import annotations

import math


def rate_factor(progress: float) -> float:
    """Learning rate over the run: warm for the first half, then down to 1/30 along a cosine in the logarithm."""
    late = max(0.0, (progress - 0.5) / 0.5)
    return 30 ** -(0.5 - 0.5 * math.cos(math.pi * min(late, 1.0)))
