"""When a training ends, and how its learning rate falls: the same for the fit of a field and for an update's helper."""

from __future__ import annotations

import math
from typing import Protocol


class Patience(Protocol):
    """A config that says when held-out pixels have stopped gaining."""

    @property
    def patience(self) -> int:
        """looks without ``least_gain``"""

    @property
    def least_gain(self) -> float:
        """dB"""


def at_plateau(looks: list[float], config: Patience) -> bool:
    """Whether the last looks at the held-out pixels, dB, have gained nothing."""
    n = config.patience
    return len(looks) > n and max(looks[-n:]) < max(looks[:-n]) + config.least_gain


def rate_factor(progress: float) -> float:
    """Learning rate over the run: warm for the first half, then down to 1/30 along a cosine in the logarithm."""
    late = max(0.0, (progress - 0.5) / 0.5)
    return 30 ** -(0.5 - 0.5 * math.cos(math.pi * min(late, 1.0)))
