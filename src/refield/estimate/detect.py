"""Which pixels of the new photos show something else than the old field does (§4.2.2), and which of those only light.

The threshold is absolute: what the field gets wrong on the old photos, looked up where each new pixel's surface lies,
is no change. Otsu's level only sharpens it where the contrast is high. So "nothing changed" can be the answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refield.estimate.look import Array, View
from refield.vision import pixels

Mask = NDArray[Any]


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
    grey: float = 0.10
    """a light change multiplies all channels by the same factor, up to this in log units"""
    largest_ratio: float = 5.0
    """light changes by no more than this factor"""


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


def blur_sigma(view: View, config: DetectConfig) -> float:
    return max(0.8, config.blur * view.camera.width)


def carried(view: View, config: DetectConfig) -> View:
    """The view with its photo's exposure and colour balance fitted to the field's on unchanged pixels."""
    sigma = blur_sigma(view, config)
    opaque = view.opacity > 0.9
    source, target = pixels.blur(view.photo, sigma), pixels.blur(view.rgb, sigma)
    fit = pixels.fit_colours(source[opaque][None], target[opaque][None])
    return replace(view, photo=np.clip(view.photo * fit[0] + fit[1], 0, 1).astype(np.float32), colour_fit=fit)


def difference(view: View, config: DetectConfig) -> Array:
    """(H, W) Lab difference of photo and rendering; 0 where the field itself is empty or a guess."""
    sigma = blur_sigma(view, config)
    found = pixels.colour_difference(pixels.blur(view.photo, sigma), pixels.blur(view.rgb, sigma), config.reach)
    return found


def noise_at(view: View, survey: Sequence[Changed]) -> Array:
    """What the old photos' differences are at the surface under each pixel, (H, W): their mean where visible."""
    points = view.surface.reshape(-1, 3)
    finite = np.all(np.isfinite(points), axis=-1)
    points = np.where(finite[:, None], points, 0)
    total, count = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for old in survey:
        uv, distance, inside = old.view.project(points)
        front = old.view.lookup(old.view.depth, uv, inside)
        error = old.view.lookup(old.difference, uv, inside)
        visible = inside & finite & (np.abs(front - distance) < 0.03 * distance)
        total += np.where(visible, error, 0)
        count += visible
    mean = np.where(count > 0, total / np.maximum(count, 1), 0)
    return mean.reshape(view.shape)


def survey_noise(survey: Sequence[View], config: DetectConfig) -> list[Changed]:
    """The field's own errors on old photos."""
    out = []
    for view in survey:
        view = carried(view, config)
        nothing = np.zeros(view.shape, bool)
        diff = difference(view, config)
        out.append(Changed(view, diff, np.full(view.shape, np.inf, np.float32), nothing, nothing))
    return out


def changes(views: Sequence[View], survey: Sequence[Changed], config: DetectConfig) -> list[Changed]:
    """Change masks of the new photos; light not yet set aside."""
    views = [carried(v, config) for v in views]
    diffs = [difference(v, config) for v in views]
    known = np.concatenate([s.difference.ravel() for s in survey]) if survey else np.zeros(1)
    level = max(config.floor, float(np.quantile(known, config.noise_quantile)))
    seed_level = max(1.3 * config.floor, 1.3 * float(np.quantile(known, config.seed_quantile)))
    above = np.concatenate([d[d > level] for d in diffs])
    seed_level = max(seed_level, config.otsu_share * pixels.otsu(above, 60.0)) if len(above) else seed_level
    out = []
    for view, diff in zip(views, diffs):
        threshold = np.maximum(level, config.local_factor * noise_at(view, survey)).astype(np.float32)
        smallest = max(6, config.smallest * diff.size)
        mask = pixels.keep_components(diff > threshold, smallest, diff > np.maximum(seed_level, threshold))
        mask = pixels.fill_holes(pixels.close(mask, 2 * round(0.012 * view.camera.width) + 3), 8 * smallest)
        out.append(Changed(view, diff, threshold, mask, np.zeros_like(mask)))
    return out
