"""Frames of a video that are worth being photos: sharp ones, spread over its length, none twice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from refield.photos.look import look_at
from refield.scene import images
from refield.scene.errors import InputError

_CANDIDATES = 5  # looked at for each that is taken
_SAME = 0.012  # mean difference in [0, 1] of two small pictures, below which the camera stood still
_SMALL = (64, 64)


def sharp_frames(path: Path, count: int) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """At most ``count`` frames of a video, each the sharpest of its part: seconds, and (H, W, 3) uint8 RGB, upright.

    Raises:
        InputError: it cannot be opened, or holds no frame.
    """
    video = cv2.VideoCapture(str(path))
    try:
        total = int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
        rate = float(video.get(cv2.CAP_PROP_FPS)) or 30.0
        _check(path, video, total)
        yield from _chosen(_candidates(video, total, count), total, count, rate)
    finally:
        video.release()


def _check(path: Path, video: cv2.VideoCapture, total: int) -> None:
    if total < 1:
        what = "cannot be opened as a video" if not video.isOpened() else "says that it holds no frames"
        raise InputError(path, what, "convert it to H.264 in an .mp4 file, or give photos")
    width, height = video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)
    if width * height > images.MAX_PIXELS:
        raise InputError(path, f"{width:.0f}x{height:.0f} pixels are too many", "scale the video down")


def _candidates(video: cv2.VideoCapture, total: int, count: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Frames at an even step, decoded one after the other: seeking is inexact in many files."""
    step = max(total // (count * _CANDIDATES), 1)
    for i in range(total):
        if not video.grab():
            return
        if i % step == 0:
            there, frame = video.retrieve()
            if there:
                yield i, np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)


def _chosen(
    candidates: Iterator[tuple[int, NDArray[np.uint8]]], total: int, count: int, rate: float
) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    part, best, last = 0, None, None
    for i, frame in candidates:
        now = i * count // total
        if now != part and best is not None:
            if last is None or _differ(last, best[2]):
                yield best[1] / rate, best[2]
                last = best[2]
            part, best = now, None
        sharpness = look_at(frame).sharpness
        if best is None or sharpness > best[0]:
            best = (sharpness, i, frame)
    if best is not None and (last is None or _differ(last, best[2])):
        yield best[1] / rate, best[2]


def _differ(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> bool:
    small = [cv2.resize(x, _SMALL, interpolation=cv2.INTER_AREA).astype(np.float32) / 255 for x in (a, b)]
    return float(np.abs(small[0] - small[1]).mean()) > _SAME
