"""Whether photos show a moved object: pixel by pixel, in the light of its new place, where old photos saw it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from refield.estimate.light import DARK, LARGEST, tint
from refield.estimate.look import Array
from refield.scene.srgb import to_linear, to_srgb
from refield.vision import pixels

LIMIT = 1.5  # times the difference from which on a pixel counts as changed
FEWEST = 50  # pixels from which a share is told


@dataclass(frozen=True)
class Compared:
    """One photo's pixels around an object, and what the composite and the old field show there."""

    photo: Array
    """(H, W, 3)"""
    composite: Array
    """(H, W, 3)"""
    unchanged: Array
    """(H, W, 3) the old field's rendering as it was"""
    threshold: Array
    """(H, W) Lab difference from which on a pixel counts as changed"""
    sides: NDArray[np.int64]
    """(H, W) the side of the object that the composite shows; -1 for none, or one that no old photo saw"""


class Explained(NamedTuple):
    """How much of an object's pixels ..."""

    part: float
    """show what the composite does"""
    before: float
    """show what the old field does"""
    pixels: int
    """how many there are, over all photos"""


def explained(photos: Sequence[Compared], sigma: float) -> Explained:
    """Ask every pixel that shows a known side; ``sigma``: pixels over which light on a side is even."""
    with_it, without, count = 0, 0, 0
    for p in photos:
        here = p.sides >= 0
        limit = LIMIT * p.threshold
        new = pixels.colour_difference(p.photo, relit(p, sigma), 1)
        old = pixels.colour_difference(p.photo, p.unchanged, 1)
        with_it += int((here & (new < limit)).sum())
        without += int((here & (old < limit)).sum())
        count += int(here.sum())
    return Explained(with_it / max(count, 1), without / max(count, 1), count)


def explained_before(pictures: Sequence[tuple[Array, Array, NDArray[np.bool_]]], threshold: float) -> float:
    """How much of an object's pixels in old photos show what the old field does there; 1 if too few show the object.

    No pose explains more: of a thing a few pixels wide the field shows hardly more than a blur.

    Args:
        pictures: photo (H, W, 3), the field's rendering of it, and the pixels (H, W) that show the object.
        threshold: Lab difference from which on a pixel counts as changed.
    """
    right, count = 0, 0
    for photo, rendering, here in pictures:
        if here.any():
            right += int((here & (pixels.colour_difference(photo, rendering, 1) < LIMIT * threshold)).sum())
            count += int(here.sum())
    return right / count if count >= FEWEST else 1.0


def relit(p: Compared, sigma: float) -> Array:
    """The composite with each side's smooth light taken from the photo: what turned is lit anew."""
    seen, shown = to_linear(p.photo), to_linear(np.maximum(p.composite, 0))
    ratio = np.zeros_like(shown)
    for side in np.unique(p.sides[p.sides >= 0]):
        here = p.sides == side
        weight = here[..., None].astype(np.float32)
        dark = DARK / 3 * pixels.blur(weight, sigma)[..., None] + 1e-6
        over, under = (pixels.blur(light * weight, sigma) + dark for light in (seen, shown))
        ratio[here] = np.log(over / under)[here]
    mean = ratio.mean(-1, keepdims=True)
    most = np.log(LARGEST)
    gain = np.clip(mean, -most, most) + np.clip(ratio - mean, -tint(mean), tint(mean))
    return to_srgb(shown * np.exp(gain))
