"""What a render is worth beside its photo: error after a fitted exposure, and sharpness.

Pictures are (H, W, 3) float32 in [0, 1] on the sRGB curve ("coded"), upright; halves are by their width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

BAND = (1 / 8, 1 / 4)
"""cycles a pixel between which sharpness is measured, the upper end excluded"""
_DARK, _BRIGHT = 2.5 / 255, 252.5 / 255  # coded; what is outside is clipped and says nothing of the light
_MOST_STOPS = 3.0
_FEWEST = 50  # usable pixels of a channel, without which its gain stays 1
_FIT_PIXELS = 200_000  # as many tell a gain as well as all do
_ROUNDS, _EXACT, _LONGEST_STEP = 50, 1e-6, 0.3
_HUBER = 1.345  # times the spread: 95 % efficient where errors are normal
_LUMA = (0.2126, 0.7152, 0.0722)


def halves(picture: Tensor) -> tuple[Tensor, Tensor]:
    """The left half and the right one; a middle column goes to the right."""
    middle = picture.shape[1] // 2
    return picture[:, :middle], picture[:, middle:]


def to_light(coded: Tensor) -> Tensor:
    """sRGB curve -> linear light."""
    return torch.where(coded <= 0.04045, coded / 12.92, ((coded.clamp_min(0) + 0.055) / 1.055) ** 2.4)


def to_coded(light: Tensor) -> Tensor:
    """Linear light -> sRGB curve; above 1 it goes on."""
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp_min(1e-9) ** (1 / 2.4) - 0.055)


def lit(render: Tensor, gains: Tensor) -> Tensor:
    """A render as a photo whose channels took in ``exp(gains)`` (3,) times as much light shows it, clipped."""
    return to_coded(to_light(render.double()) * gains.exp()).clamp(0, 1).to(render.dtype)


def log_gains(render: Tensor, photo: Tensor) -> Tensor:
    """The photo's exposure beside the render's: three logarithms of linear gains, (3,) float64.

    Robust least squares (Huber) in coded values. Pixels clipped in the photo or the render are left out; a channel
    with hardly any others has the gain 1.
    """
    stride = max(math.ceil(photo.shape[0] * photo.shape[1] / _FIT_PIXELS), 1)
    a, b = (picture.reshape(-1, 3)[::stride].double() for picture in (render, photo))
    return torch.tensor([_log_gain(a[:, c], b[:, c]) for c in range(3)], dtype=torch.float64)


def _log_gain(render: Tensor, photo: Tensor) -> float:
    """Of one channel, by Gauss-Newton with Huber's weights."""
    usable = (photo > _DARK) & (photo < _BRIGHT) & (render > _DARK) & (render < _BRIGHT)
    if int(usable.sum()) < _FEWEST:
        return 0.0
    light, goal = to_light(render[usable]), photo[usable]
    gain, most = 0.0, _MOST_STOPS * math.log(2)
    for _ in range(_ROUNDS):
        now = light * math.exp(gain)
        slope = torch.where(now <= 0.0031308, 12.92 * now, 1.055 / 2.4 * now ** (1 / 2.4))
        error = goal - to_coded(now)
        spread = max(1.4826 * float(error.abs().median()), 1 / 255)
        weight = (_HUBER * spread / error.abs().clamp_min(1e-12)).clamp_max(1)
        step = float((weight * slope * error).sum() / (weight * slope.square()).sum())
        gain = min(max(gain + min(max(step, -_LONGEST_STEP), _LONGEST_STEP), -most), most)
        if abs(step) < _EXACT:
            break
    return gain


def mean_square(render: Tensor, photo: Tensor) -> float:
    """Over pixels and channels; the render is rounded to 8 bits first, as in the PNG that it would become."""
    rounded = (render.double().clamp(0, 1) * 255).round() / 255
    return float((rounded - photo.double()).square().mean())


def decibels(error: float) -> float:
    """PSNR of a mean square, at most 100 dB."""
    return -10 * math.log10(max(error, 1e-10))


def band_energy(picture: Tensor) -> float:
    """Energy of the luma between the `BAND`'s frequencies, radially, summed over the picture's pixels.

    The mean is removed and a Hann window laid over; the window's own mean square is divided out, so that energies of
    pictures of several sizes add up as their pixels do.
    """
    luma = picture.double() @ picture.new_tensor(_LUMA, dtype=torch.float64)
    h, w = luma.shape
    window = torch.hann_window(h, False, dtype=torch.float64)[:, None] * torch.hann_window(
        w, False, dtype=torch.float64
    )
    spectrum = torch.fft.fft2((luma - luma.mean()) * window)
    v, u = torch.fft.fftfreq(h, dtype=torch.float64), torch.fft.fftfreq(w, dtype=torch.float64)
    radius = (v[:, None].square() + u.square()).sqrt()
    inside = (radius >= BAND[0]) & (radius < BAND[1])
    return float(spectrum[inside].abs().square().sum() / (h * w) / window.square().mean())


def sharpness(renders: Sequence[Tensor], photos: Sequence[Tensor]) -> float:
    """Root of the renders' `band_energy` over the photos', both pooled; 1 for what is as sharp as its photo.

    More than the photo's is no better: grain counts as well. NaN where the photos have no such energy.
    """
    photo = sum(band_energy(p) for p in photos)
    return math.sqrt(sum(band_energy(r) for r in renders) / photo) if photo > 0 else math.nan
