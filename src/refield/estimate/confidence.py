"""How likely what is told is true: by how much the best other answer explains less, as a part of the pixels concerned.

One curve for each kind, drawn through how often objects were told right (docs/results.md, "Confidence drawn anew"): the
part of what is left unexplained ranks them, the part of an object's pixels that look right does not.
"""

from __future__ import annotations

from scipy.special import expit

from refield.scene.change import Kind

_MOST = 0.93
"""of objects that lead the others clearly; some of them are wrong all the same, since no right answer was tried"""
_CURVES: dict[Kind, tuple[float, float, float]] = {
    "moved": (0.4, 0.27, 0.03),
    "removed": (0.0, 0.5, 0.06),
    "added": (0.0, 0.85, 0.06),
}
"""the part that is right of what leads by nothing (the best of several poses at a place is often right, whatever it
leads by), the lead with which half of the rest is right, and how much more makes that e times as likely"""
_ONE_OF_TWO = 0.2
"""of what left where something arrived, of what arrived where something left, and of what arrived by the only photo
there is: most are one thing that moved"""


def confidence(kind: Kind, lead: float, half: bool) -> float:
    """How likely an object's kind, and its place within 2 % of the distance to the cameras, is right, 0 to 1.

    Args:
        lead: pixels that the best other answer does not explain and this one does, as a part of those concerned.
        half: whether it may be one half of a move: something arrived, for what left; something left, for what arrived,
            or there is one photo alone, which does not say how far away it is, nor what left where it does not look.
    """
    least, even, scale = _CURVES[kind]
    right = least + (1 - least) * float(expit((lead - even) / scale))
    return _MOST * right * (_ONE_OF_TWO if half else 1.0)
