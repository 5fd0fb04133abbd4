"""Which pixels of the new photos show something else than the old field does (§4.2.2), and which of those only light.

The threshold is absolute: what the field gets wrong in photos of the old state, at the surface under a pixel and where
as few old photos looked as there, is no change. Otsu's level only sharpens it where the contrast is high. So "nothing
changed" can be the answer. What no old photo saw is no change either, whatever is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from refield.estimate.look import Array, View
from refield.estimate.memory import Memory
from refield.vision import pixels

Mask = NDArray[Any]
_CLASSES = 5
_TRUE = 0.99  # of times that nothing changed, so many are not said to be unclear
CERTAIN = 4
"""old photos that saw a surface, from which on one new photo is believed that it changed; what fewer saw, the field may
have guessed, and only another new photo could tell. Half of the false changes on real photographs lie where 2 or 3
looked, true ones where 15 to 49 did (docs/results.md)"""


@dataclass(frozen=True)
class DetectConfig:
    """How pixels are compared."""

    blur: float = 0.0085
    """sigma of the Gaussian before comparison, of the image width: the paper's kernel of 3 % of the width"""
    reach: int = 1
    """pixels of misalignment forgiven"""
    floor: float = 4.0
    """Lab units; a smaller difference is never a change"""
    noise_quantile: float = 0.97
    """of the differences on old photos; what is larger may be part of a change"""
    seed_quantile: float = 0.995
    """of the differences on old photos; a change is larger than this, and a third, somewhere"""
    local_factor: float = 2.5
    """a change exceeds the error that old photos show at the same surface by this factor"""
    otsu_share: float = 0.6
    """seeds of a change exceed this part of Otsu's level"""
    smallest: float = 0.0006
    """of the image's pixels; smaller spots are dropped"""


@dataclass(frozen=True)
class Changed:
    """A view with what changed in it."""

    view: View
    """with the photo's colours carried to the field's"""
    difference: Array
    """(H, W) Lab units, blurred and forgiving"""
    threshold: Array
    """(H, W) what counts as changed here"""
    mask: Mask
    """(H, W) changed, light set aside"""
    light: Mask
    """(H, W) brighter or darker, on a surface that stayed"""
    new: Mask
    """(H, W) what is there was seen by no old photo, and is not what the field took for granted: no change, as far as
    anyone knows"""
    guessed: Mask | None = None
    """(H, W) of ``mask`` what one new photo alone is not believed: too few old ones saw what is there"""

    @property
    def certain(self) -> Mask:
        """(H, W) of ``mask`` what is believed"""
        return self.mask if self.guessed is None else self.mask & ~self.guessed

    def witness(self, depth: Array | None = None) -> View:
        """The view, with the old surface at ``depth`` (H, W), for telling where in space nothing changed: pixels that
        show what is new to us tell of no place."""
        return replace(self.view, depth=np.where(self.new, 0, self.view.depth if depth is None else depth))


@dataclass(frozen=True)
class Errors:
    """What the field gets wrong where nothing changed."""

    shown: tuple[Changed, ...]
    """photos of the old state"""
    memory: Memory
    levels: Array
    """(C,) Lab units by the class of coverage, see `_coverage`: what is larger may be part of a change"""
    seeds: Array
    """(C,) a change is larger than this somewhere"""
    by_chance: tuple[float, ...] = ()
    """the part of each of those photos, and of others held out of the capture, that would be taken for changed if it
    were new"""

    def unusual(self, shares: Sequence[float]) -> bool:
        """Whether new photos' changed parts are more than the field's errors make of as many photos without a change.

        Of several photos the one that differs most counts as the next one does: it may be taken from where the field
        was seen badly, as none of the old ones was. If such parts are exponentially distributed, the sum of n counted
        like that is distributed as that of n - 1, and the quotient of two means as F.
        """
        if not self.by_chance:
            return True
        count, old = max(len(shares) - 1, 1), len(self.by_chance)
        mean = sum(np.minimum(shares, sorted(shares)[count - 1])) / count
        bound = float(fdtri(2 * count, 2 * old, _TRUE))
        return bool(mean > bound * (sum(self.by_chance) + DetectConfig.smallest) / old)


def blur_sigma(view: View, config: DetectConfig) -> float:
    return max(0.8, config.blur * view.camera.width)


def carried(view: View, config: DetectConfig) -> View:
    """The view with its photo's exposure and colour balance fitted to the field's on unchanged pixels."""
    sigma = blur_sigma(view, config)
    opaque = view.opacity > 0.9
    source, target = pixels.blur(view.photo, sigma), pixels.blur(view.rgb, sigma)
    fit = pixels.fit_colours(source[opaque][None], target[opaque][None])
    return replace(view, photo=np.clip(view.photo * fit[0] + fit[1], 0, 1).astype(np.float32), colour_fit=fit)


def difference(view: View, picture: Array, config: DetectConfig) -> Array:
    """(H, W) Lab difference of a view's photo and a picture (H, W, 3) of what it should show."""
    sigma = blur_sigma(view, config)
    return pixels.colour_difference(pixels.blur(view.photo, sigma), pixels.blur(picture, sigma), config.reach)


def is_of_scene(changed: Changed, survey: Sequence[View], config: DetectConfig) -> bool:
    """Whether a photo of which much changed shows the field's scene all the same: more of its pixels are as the field
    shows them from its own place than as it does from any of the old photos' places, each in the light that fits best.
    """

    def alike(picture: Array) -> float:
        view = carried(replace(changed.view, rgb=picture), config)
        return float((difference(view, picture, config) <= changed.threshold).mean())

    h, w = changed.view.shape
    others = (cv2.resize(s.rgb, (w, h), interpolation=cv2.INTER_AREA) for s in survey)
    return alike(changed.view.rgb) > max(map(alike, others), default=0.0)


def noise_at(view: View, survey: Sequence[Changed]) -> Array:
    """What the old photos' differences are at the surface under each pixel, (H, W): their mean where visible."""
    points = view.surface.reshape(-1, 3)
    finite = np.all(np.isfinite(points), axis=-1)
    points = np.where(finite[:, None], points, 0)
    total, count = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for old in survey:
        uv, shown = old.view.shows(points, 0.03)
        visible = shown & finite
        total += np.where(visible, old.view.lookup(old.difference, uv, shown), 0)
        count += visible
    mean = np.where(count > 0, total / np.maximum(count, 1), 0)
    return mean.reshape(view.shape)


def errors(photos: Sequence[View], memory: Memory, config: DetectConfig, left_out: Sequence[View] = ()) -> Errors:
    """The field's own errors, in ``photos`` of the old state.

    ``left_out``: others, held out of the capture, which the field did not learn from, as it did not from new ones. They
    tell how much of such a photo would be taken for changed; not what counts as a change, since where a few of them
    show the field wrong, true changes were missed as well (docs/results.md).
    """
    shown, others = (tuple(_unchanged(v, config) for v in views) for views in (photos, left_out))
    of = np.concatenate([_coverage(memory.times_seen(s.view)).ravel() for s in shown])
    known = np.concatenate([s.difference.ravel() for s in shown])
    levels, seeds = (_by_coverage(known, of, q) for q in (config.noise_quantile, config.seed_quantile))
    levels, seeds = np.maximum(config.floor, levels), 1.3 * np.maximum(config.floor, seeds)
    shares = []
    for one in (*shown, *others):
        beside = Errors(tuple(s for s in shown if s is not one), memory, levels, seeds)
        (found,) = _marked([one.view], [one.difference], beside, config)
        shares.append(float(found.mask.mean()))
    return Errors(shown, memory, levels, seeds, tuple(shares))


def _unchanged(view: View, config: DetectConfig) -> Changed:
    view = carried(view, config)
    nothing = np.zeros(view.shape, bool)
    none = np.full(view.shape, np.inf, np.float32)
    return Changed(view, difference(view, view.rgb, config), none, nothing, nothing, nothing)


def _coverage(times: NDArray[Any]) -> NDArray[np.int64]:
    """The class of what so many old photos saw: none, one, 2 or 3, 4 to 7, more."""
    return np.minimum(np.frexp(times)[1], _CLASSES - 1).astype(np.int64)


def _by_coverage(errors: Array, of: NDArray[np.int64], quantile: float) -> Array:
    """A quantile of errors (N,) for each class of coverage, (C,), no smaller than that of all, nor than that of what
    more photos saw."""
    fewest = 1 / (1 - quantile)  # that have one among them
    out: Array = np.full(_CLASSES, np.quantile(errors, quantile) if len(errors) else 0.0)
    for k in reversed(range(_CLASSES)):
        mine = errors[of == k]
        out[k] = max(float(np.quantile(mine, quantile)) if len(mine) >= fewest else 0.0, *out[k:])
    return out


def changes(views: Sequence[View], known: Errors, config: DetectConfig) -> list[Changed]:
    """Change masks of the new photos; light not yet set aside."""
    views = [carried(v, config) for v in views]
    enough = 1 if len(views) > 1 else CERTAIN
    return _marked(views, [difference(v, v.rgb, config) for v in views], known, config, enough)


def _marked(
    views: Sequence[View], diffs: Sequence[Array], known: Errors, config: DetectConfig, enough: int = 1
) -> list[Changed]:
    """Change masks of photos whose colours are carried over and whose differences (H, W) are known; what fewer than
    ``enough`` old photos saw is guessed."""
    times = [known.memory.times_seen(v) for v in views]
    floors = [known.levels[_coverage(t)] for t in times]
    above = np.concatenate([d[(d > f) & (t > 0)] for d, f, t in zip(diffs, floors, times)])
    strong = config.otsu_share * pixels.otsu(above, 60.0) if len(above) else 0.0
    out = []
    for view, diff, floor, seen in zip(views, diffs, floors, times):
        threshold = np.maximum(floor, config.local_factor * noise_at(view, known.shown)).astype(np.float32)
        seeds = diff > np.maximum(np.maximum(known.seeds[_coverage(seen)], strong), threshold)
        smallest, new = max(6, config.smallest * diff.size), (seen == 0) & (diff > threshold)
        mask = pixels.keep_components((diff > threshold) & ~new, smallest, seeds & ~new)
        mask = pixels.fill_holes(pixels.close(mask, 2 * round(0.012 * view.camera.width) + 3), 8 * smallest) & ~new
        guessed = mask & (seen < enough) if enough > 1 else None
        out.append(Changed(view, diff, threshold, mask, np.zeros_like(mask), new, guessed))
    return out
