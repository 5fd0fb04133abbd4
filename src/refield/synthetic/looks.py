"""A photograph's own look, so that what is put into it can have the same: exposure, blur and noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.scene.srgb import to_linear

_EDGES = 0.005  # of the pixels, those with the steepest brightness, tell the blur
_SHARPEST = 20  # per cent of them that count: the others are edges of soft things
_LAPLACIAN = 20**0.5  # of white noise of deviation 1, by the kernel 0 1 0 / 1 -4 1 / 0 1 0
_MAD = 1.4826  # a normal's deviation against its median absolute deviation
_MOST_BLUR = 3.0  # pixels


@dataclass(frozen=True)
class Look:
    """How a photograph was taken."""

    gain: Tensor
    """(3,) float32: its exposure in linear light, against that of the scene's own colours"""
    noise: float
    """standard deviation, of 1 = white, in the photo's own (sRGB) values"""
    blur: float
    """pixels, the deviation of a Gaussian"""


def look_of(image: Tensor, gain: Tensor) -> Look:
    """Of a photo (H, W, 3) uint8."""
    grey = cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY).astype(np.float32)
    return Look(gain, noise_of(grey) / 255, blur_of(grey))


def gain_of(photo: Tensor, shown: Tensor, known: Tensor) -> Tensor:
    """Exposure (3,) of a photo against a rendering of the same view, both (H, W, 3) in [0, 1], where ``known``."""
    a, b = (torch.from_numpy(to_linear(x[known].numpy())) for x in (photo, shown))
    usable = ((b > 0.01) & (b < 0.9) & (a < 0.95)).all(-1)  # neither dark nor clipped
    if int(usable.sum()) < 20:
        return torch.ones(3)
    return (a[usable] / b[usable]).median(0).values.clamp(0.25, 4.0)


def noise_of(grey: NDArray[np.float32]) -> float:
    """Deviation of the noise in the smoothest quarter of a picture (H, W), in its own units."""
    slope = cv2.GaussianBlur(np.hypot(*_gradient(cv2.GaussianBlur(grey, (0, 0), 2))), (0, 0), 2)
    inner = (grey > 8) & (grey < 247)  # a clipped pixel has none
    if not inner.any():
        return 0.0
    smooth = inner & (slope <= np.quantile(slope[inner], 0.25))
    found = cv2.Laplacian(grey, cv2.CV_32F)[smooth]
    return float(_MAD * np.median(np.abs(found)) / _LAPLACIAN)


def blur_of(grey: NDArray[np.float32]) -> float:
    """Deviation (pixels) of the blur of the sharpest edges: an edge's height against its steepest slope."""
    slope = np.hypot(*_gradient(grey))
    square = np.ones((9, 9), np.uint8)
    span = cv2.dilate(grey, square) - cv2.erode(grey, square)
    steep = slope >= max(np.quantile(slope, 1 - _EDGES), 1e-6)
    if not steep.any():
        return 0.0
    width = span[steep] / (np.sqrt(2 * np.pi) * slope[steep])
    # the differences over two pixels widen an edge by themselves
    variance = float(np.percentile(width, _SHARPEST)) ** 2 - 1 / 3
    return float(np.sqrt(np.clip(variance, 0.09, _MOST_BLUR**2)))


def _gradient(grey: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Central differences, a pixel."""
    x, y = (cv2.Sobel(grey, cv2.CV_32F, *order, ksize=1, scale=0.5) for order in ((1, 0), (0, 1)))
    return np.asarray(x, np.float32), np.asarray(y, np.float32)
