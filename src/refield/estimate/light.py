"""Light that changed on surfaces that did not: shadows that moved along with their object.

Such a pixel's photo-to-field ratio is near grey and even around it, and every other view that sees the same surface
point sees the same ratio. What stands in front of the surface fails the second test, what is gone usually the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from refield.estimate.detect import Changed, DetectConfig, Mask, blur_sigma
from refield.estimate.look import Array
from refield.vision import pixels

_DARK = 0.03  # linear light; below it a ratio is noise
_AGREE = 0.12  # log units between two views' ratios of the same surface point
_SAME_PLACE = 0.02  # of the distance


def set_light_aside(changed: Sequence[Changed], config: DetectConfig) -> list[Changed]:
    """The same views with the light changes moved from ``mask`` to ``light``."""
    ratios = [log_ratio(c, config) for c in changed]
    out = []
    for i, c in enumerate(changed):
        agrees, asked = _agreement(i, changed, ratios)
        even = _even_and_grey(ratios[i], config)
        light = c.mask & even & (agrees >= np.maximum(1, 0.6 * asked))
        light = cv2.medianBlur(light.astype(np.uint8), 5).astype(bool)
        light &= c.mask
        smallest = max(6, config.smallest * light.size)
        light = pixels.keep_components(light, 2 * smallest)
        # the rim of a shadow is neither even nor quite grey: give it to the shadow it touches
        rest = c.mask & ~light
        core = pixels.keep_components(pixels.dilate(pixels.erode(rest, 1), 1) & rest, smallest)
        light = c.mask & ~core
        out.append(replace(c, mask=core, light=light) if light.any() else c)
    return out


def log_ratio(c: Changed, config: DetectConfig) -> Array:
    """log(photo / field) per channel in linear light, (H, W, 3)."""
    sigma = blur_sigma(c.view, config)
    photo, rgb = (pixels.blur(_linear(im), sigma) for im in (c.view.photo, c.view.rgb))
    return np.log((photo + _DARK / 3) / (rgb + _DARK / 3)).astype(np.float32)


def _linear(image: Array) -> Array:
    return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _even_and_grey(ratio: Array, config: DetectConfig) -> Mask:
    mean = ratio.mean(-1)
    chroma = np.abs(ratio - mean[..., None]).max(-1)
    spread = cv2.blur(mean**2, (3, 3)) - cv2.blur(mean, (3, 3)) ** 2
    even = np.sqrt(np.maximum(spread, 0)) < 0.15
    return even & (chroma < config.grey + 0.15 * np.abs(mean)) & (np.abs(mean) < np.log(config.largest_ratio))


def _agreement(i: int, changed: Sequence[Changed], ratios: Sequence[Array]) -> tuple[Array, Array]:
    """How many other views see the same ratio at the surface under each pixel, and how many see that surface."""
    view = changed[i].view
    points = view.surface.reshape(-1, 3)
    ok = np.isfinite(points).all(-1) & changed[i].mask.ravel()
    points = np.where(ok[:, None], points, 0)
    agrees, asked = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    own = ratios[i].reshape(-1, 3)
    for k, other in enumerate(changed):
        if k == i:
            continue
        uv, distance, inside = other.view.project(points)
        front = other.view.lookup(other.view.depth, uv, inside)
        visible = ok & inside & (np.abs(front - distance) < _SAME_PLACE * distance)
        same = np.abs(other.view.lookup(ratios[k], uv, inside) - own).max(-1) < _AGREE
        asked += visible
        agrees += visible & same
    return agrees.reshape(view.shape), asked.reshape(view.shape)
