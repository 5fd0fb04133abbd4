"""Align one picture of a view with another, for cameras whose poses are a pixel or so off (§4.2.2, §5.3)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from refield.vision.pixels import Image

Warp = NDArray[np.float32]

_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-6)
_FURTHEST = 0.03, 2.0  # share of the width, and pixels: a warp beyond both is no pose error


def align(image: Image, target: Image) -> Image:
    """``image`` warped onto ``target`` by the translation or homography that correlates them best (ECC).

    Where no small warp does better than none, the image comes back as it was. Edges are repeated.
    """
    h, w = target.shape[:2]
    source, goal = _grey(image), _grey(target)
    best, score = None, float(cv2.computeECC(goal, source))
    start = np.eye(3, dtype=np.float32)
    for motion in (cv2.MOTION_TRANSLATION, cv2.MOTION_HOMOGRAPHY):
        found, warp = _warp(goal, source, start, motion)
        if found > score and _corner_shift(warp, w, h) <= max(_FURTHEST[0] * w, _FURTHEST[1]):
            best, score = warp, found
            start = warp
    if best is None:
        return image
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(image, best, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return warped.astype(np.float32, copy=False)


def _warp(goal: Image, source: Image, start: Warp, motion: int) -> tuple[float, Warp]:
    """The correlation that is reached, and the warp (3, 3) from goal to source pixels."""
    warp = start.copy()
    rows = 3 if motion == cv2.MOTION_HOMOGRAPHY else 2
    try:
        score, warp[:rows] = cv2.findTransformECC(goal, source, start[:rows].copy(), motion, _STEPS)
    except cv2.error:  # it did not converge
        return -1.0, start
    return float(score), warp


def _corner_shift(warp: Warp, w: int, h: int) -> float:
    """How far the warp moves the corner that it moves most, in pixels."""
    corners = np.array([[0, 0], [w, 0], [0, h], [w, h]], np.float32)
    moved = cv2.perspectiveTransform(corners[None], warp)[0]
    return float(np.linalg.norm(moved - corners, axis=1).max())


def _grey(image: Image) -> Image:
    return cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2GRAY).astype(np.float32, copy=False)
