"""A rendering laid over the photo of the same view by a homography (§4.2.2, §10.2.2 step 2).

Pixels here are OpenCV's, with the top-left pixel's centre at (0, 0), since only its own functions see them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refield.estimate.detect import Mask
from refield.vision.matcher import SiftMatcher

Picture = NDArray[np.uint8]
Warp = NDArray[np.float64]

_SIFT = SiftMatcher()


@dataclass(frozen=True)
class AlignConfig:
    """When a rendering is laid over its photo anew."""

    inliers: int = 20
    """matched features that a homography must explain"""
    error: float = 1.5
    """pixels within which it explains one"""
    least: float = 0.5
    """pixels, the median over those features; a smaller misfit is the features' own, and resampling blurs"""
    furthest: float = 0.03
    """of the width; a homography that moves a corner further is no error of the camera's pose"""


def found_warp(render: Picture, capture: Picture, config: AlignConfig) -> Warp | None:
    """The homography (3, 3) from a rendering's pixels to its photo's, both (H, W, 3); None where none is needed or can
    be trusted.

    From matched features rather than by correlation (`refield.vision.alignment.align`). What moved is an outlier to
    MAGSAC, while the correlation of all pixels is pulled along by it. And the homography is needed itself, to carry
    masks back to where the rendered depth is.
    """
    source, target, _ = _SIFT.match(render, capture)
    if len(source) < config.inliers:
        return None
    cv2.setRNGSeed(0)  # MAGSAC draws at random
    found, chosen = cv2.findHomography(source - 0.5, target - 0.5, cv2.USAC_MAGSAC, config.error)
    if found is None or int(chosen.sum()) < config.inliers:
        return None
    warp = np.asarray(found, np.float64)
    kept = chosen.ravel() > 0
    misfit = float(np.median(np.linalg.norm(target - source, axis=-1)[kept]))
    h, w = capture.shape[:2]
    return warp if misfit >= config.least and _corner_shift(warp, w, h) <= config.furthest * w else None


def warped(picture: Picture, warp: Warp | None) -> Picture:
    """A rendering (H, W, 3) in its photo's pixels; edges are repeated."""
    if warp is None:
        return picture
    size = (picture.shape[1], picture.shape[0])
    return np.asarray(cv2.warpPerspective(picture, warp, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def unwarped(mask: Mask, warp: Warp | None) -> Mask:
    """A mask (H, W) bool in the photo's pixels, in the rendering's."""
    if warp is None:
        return mask
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(mask.astype(np.uint8), warp, (mask.shape[1], mask.shape[0]), flags=flags) > 0


def _corner_shift(warp: Warp, w: int, h: int) -> float:
    """How far the warp moves the corner that it moves most, in pixels."""
    corners = np.array([[[0, 0], [w, 0], [0, h], [w, h]]], np.float64)
    return float(np.linalg.norm(cv2.perspectiveTransform(corners, warp) - corners, axis=-1).max())
