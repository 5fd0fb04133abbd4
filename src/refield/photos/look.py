"""A first look at a photo: is it sharp, is it lit, does it show anything?

Letters: ratio of the mean gradient at a fine and at a coarse scale; a blurred photo has nothing finer, so its ratio
comes near 1, whatever it shows. The direction in which it is least counts: a hand moves in one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

LONGEST = 960
"""pixels; photos are looked at no larger, so that large ones are not judged more strictly"""
BLURRED = 1.15
"""sharpness below which a photo shows little: as blurred by 4.5 pixels (1 σ) at 960, or moved by 25"""
_RELATIVE = 0.35  # and of what the sharpness of the others exceeds 1
_FINE, _COARSE = 1.0, 4.0
_FLAT = 0.02  # standard deviation of grey values; less shows nothing
_DARK, _BRIGHT = 0.02, 0.98


@dataclass(frozen=True)
class Look:
    """Numbers of one photo; grey values in [0, 1]."""

    sharpness: float
    """1 is without any fine detail; sharp photos have 1.5 to 2.5"""
    brightness: float
    """mean"""
    contrast: float
    """standard deviation"""

    @property
    def fault(self) -> str:
        """Why the photo shows nothing at all; empty if it does show something."""
        if self.contrast >= _FLAT:
            return ""
        if self.brightness < _DARK + _FLAT:
            return f"is black (mean brightness {100 * self.brightness:.0f} %)"
        if self.brightness > _BRIGHT - _FLAT:
            return f"is white (mean brightness {100 * self.brightness:.0f} %)"
        return f"shows one flat colour (contrast {100 * self.contrast:.1f} %)"

    def blur(self, others: float) -> str:
        """Why the photo is too blurred among photos of the sharpness ``others``; empty if it is not."""
        if self.sharpness >= min(BLURRED, 1 + _RELATIVE * (others - 1)):
            return ""
        return f"is too blurred (sharpness {self.sharpness:.2f}, the old photos' is {others:.2f}; 1 is no detail)"


def look_at(image: NDArray[np.uint8]) -> Look:
    """Measure an image, (H, W, 3) uint8 RGB."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = LONGEST / max(grey.shape)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    unit = np.asarray(grey, np.float32) / np.float32(255)
    return Look(_sharpness(unit), float(unit.mean()), float(unit.std()))


def usual_sharpness(looks: Sequence[Look]) -> float:
    """Median of the photos that show something; 1 without any."""
    sharp = [look.sharpness for look in looks if not look.fault]
    return float(np.median(sharp)) if sharp else 1.0


def stops(looks: Sequence[Look]) -> float:
    """How far the photos' brightness spreads, in stops (10 % to 90 %)."""
    light = np.array([look.brightness for look in looks if not look.fault])
    if len(light) < 2:
        return 0.0
    low, high = np.quantile(light, [0.1, 0.9])
    return float(2.2 * np.log2(max(high, 1e-3) / max(low, 1e-3)))  # sRGB's gamma, roughly


def _sharpness(unit: NDArray[Any]) -> float:
    fine, coarse = _slopes(unit, _FINE), _slopes(unit, _COARSE)
    if coarse.max() < 1e-4:
        return 1.0
    return float((fine / np.maximum(coarse, 1e-4)).min())


def _slopes(unit: NDArray[Any], sigma: float) -> NDArray[np.float64]:
    """Mean absolute slope along x, y and both diagonals, (4,)."""
    g = cv2.GaussianBlur(unit, (0, 0), sigma)
    x, y = g[1:-1, 2:] - g[1:-1, :-2], g[2:, 1:-1] - g[:-2, 1:-1]
    down, up = g[2:, 2:] - g[:-2, :-2], g[:-2, 2:] - g[2:, :-2]
    return np.array([np.abs(s).mean() for s in (x, y, down / np.sqrt(2), up / np.sqrt(2))], np.float64)
