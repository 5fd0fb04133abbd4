"""How alike two pictures are: PSNR over a region, SSIM of a region's box (§11.2).

Pictures are (H, W, 3) in [0, 1].
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from refield.vision.pixels import bounding_box

MAX_PSNR = 100.0
"""Equal pictures have no finite PSNR, and JSON has no infinity."""
WINDOW, _SIGMA = 11, 1.5  # of SSIM's Gaussian (Wang et al. 2004)


def psnr(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float | None:
    """PSNR in dB over the pixels of ``mask`` (H, W) bool, at most `MAX_PSNR`; None if there is none."""
    return pooled_psnr([squared_error(image, truth, mask)])


def squared_error(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Per pixel of the mask, the mean over channels, (K,) float64."""
    error = (image.double() - truth.double()).square().mean(-1)
    return error.flatten() if mask is None else error[mask]


def pooled_psnr(errors: Sequence[Tensor]) -> float | None:
    """PSNR in dB of the pixels of several pictures taken together, from `squared_error` of each."""
    flat = torch.cat(list(errors)) if errors else torch.zeros(0)
    if len(flat) == 0:
        return None
    return min(MAX_PSNR, -10 * math.log10(max(float(flat.mean()), 1e-300)))


def ssim(image: Tensor, truth: Tensor) -> float:
    """Structural similarity of pictures at least 11 pixels wide and high.

    Gaussian window 11 x 11 with sigma 1.5, population covariances, mean over channels and over the places
    where the window fits.
    """
    a, b = (p.double().permute(2, 0, 1)[:, None] for p in (image, truth))
    mu_a, mu_b = _blur(a), _blur(b)
    var_a, var_b = _blur(a * a) - mu_a**2, _blur(b * b) - mu_b**2
    covariance = _blur(a * b) - mu_a * mu_b
    c1, c2 = 0.01**2, 0.03**2
    above = (2 * mu_a * mu_b + c1) * (2 * covariance + c2)
    below = (mu_a**2 + mu_b**2 + c1) * (var_a + var_b + c2)
    return float((above / below).mean())


def ssim_in_box(image: Tensor, truth: Tensor, mask: Tensor, side: int = 256) -> float | None:
    """SSIM of the tight bounding box of ``mask`` (H, W) bool, resized to ``side`` x ``side`` (§11.2).

    Pixels in the box that are outside the mask stay as they are. None if the mask has no pixel.
    """
    pair = boxed(image, truth, mask, side)
    return None if pair is None else ssim(*pair)


def boxed(image: Tensor, truth: Tensor, mask: Tensor, side: int) -> tuple[Tensor, Tensor] | None:
    """Both pictures in the tight bounding box of ``mask`` (H, W) bool, resized to (side, side, 3); None without one."""
    corners = bounding_box(mask.numpy())
    if corners is None:
        return None
    x0, y0, x1, y1 = corners
    box = (slice(y0, y1), slice(x0, x1))
    return _resized(image[box], side), _resized(truth[box], side)


def _blur(x: Tensor) -> Tensor:
    """(C, 1, H, W) -> the Gaussian mean wherever the whole window fits."""
    t = torch.arange(WINDOW, dtype=x.dtype) - WINDOW // 2
    g = torch.exp(-t.square() / (2 * _SIGMA**2))
    g = g / g.sum()
    return functional.conv2d(functional.conv2d(x, g.view(1, 1, -1, 1)), g.view(1, 1, 1, -1))


def _resized(image: Tensor, side: int) -> Tensor:
    """(h, w, 3) -> (side, side, 3), bilinear, smoothed where it shrinks."""
    x = image.permute(2, 0, 1)[None].float()
    x = functional.interpolate(x, (side, side), mode="bilinear", antialias=True, align_corners=False)
    return x[0].permute(1, 2, 0)
