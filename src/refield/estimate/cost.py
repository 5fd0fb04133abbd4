"""What a hypothesis pays: for each pixel by how wrong its picture is there, and for each body that it tells of."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from refield.estimate.detect import Mask
from refield.estimate.explain import LIMIT
from refield.estimate.look import Array

UNKNOWN = 0.4
"""what a pixel costs that may show anything, since nobody had seen what is behind"""
CAME = 0.7
"""what a pixel costs that may show anything, since something came there"""
_TAIL = 0.7
"""what a pixel costs more that is e times as wrong. A field's own errors that count as changes are one in 300 of its
pixels, and one e times as large is e^4 times as seldom (eight fields, docs/results.md): 4 over log 300"""
_BODY = 0.9
"""times the fewest pixels that a thing must fill in a photo: what a body costs, for each photo that shows it"""
_POSE = 0.3
"""times as many: what it costs that it went somewhere, for each photo that shows it there"""


def wrongness(difference: Array, threshold: Array) -> Array:
    """What pixels cost of which a photo and a picture are a Lab ``difference`` (H, W) apart; 1 where the picture is as
    wrong as a pose may be, beside the ``threshold`` (H, W) of what counts as a change."""
    x = difference / (LIMIT * threshold)
    return np.where(x < 1, x**2, 1 + _TAIL * np.log(np.maximum(x, 1))).astype(np.float32)


def price(shown: Iterable[Mask], smallest: float, moved: bool = False) -> float:
    """Pixels that a body must explain where it was or arrived, or more of them where it moved to, over all photos that
    show it there: of each the pixels (H, W) that do; ``smallest``: part of a photo that a thing must fill."""
    return (_POSE if moved else _BODY) * smallest * sum(s.size for s in shown if s.any())
