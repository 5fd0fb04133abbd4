"""How a camera took the light that reached it, beside the scene and not in it: exposure, white balance, vignetting.

    photo = neutral colour * gain of the photo and channel * vignetting of the camera

in coded (sRGB) values, in which more light is a factor, but for the last tenth above black; what comes out brighter
than white is white. The physical part of PPISP, without its colour matrix and its response curve, which a single camera
cannot tell from the scene's own colours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from refield.scene.camera import Camera


@dataclass(frozen=True)
class Exposure:
    """Of one photo."""

    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """of red, green, blue"""
    vignetting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """a, b, c: the logarithm of what is left is a r^2 + b r^4 + c r^6, with r = 1 in the photo's corners"""

    @property
    def stops(self) -> float:
        """How much lighter than neutral the photo is, in stops."""
        return 2.2 * sum(float(torch.tensor(g).log2()) for g in self.gains) / 3  # sRGB's gamma, roughly

    def on(self, earlier: Exposure | None) -> Exposure:
        """Both together: this one of a photo that was read as neutral by an ``earlier`` one."""
        if earlier is None:
            return self
        r, g, b = (x * y for x, y in zip(self.gains, earlier.gains))
        v, w, u = (x + y for x, y in zip(self.vignetting, earlier.vignetting))
        return Exposure((r, g, b), (v, w, u))

    def factor(self, camera: Camera) -> Tensor:
        """By how much the photo differs from neutral at every pixel, (H, W, 3) float32."""
        shape = camera.height, camera.width, 1
        basis = vignetting_basis(camera.pixel_centres(), torch.tensor([camera.width, camera.height]))
        fallen = basis @ torch.tensor(self.vignetting)
        return fallen.exp().reshape(shape) * torch.tensor(self.gains)

    def neutral(self, image: Tensor, camera: Camera) -> Tensor:
        """A photo (H, W, 3) uint8 as it would be with the neutral exposure, uint8; burnt-out pixels stay so."""
        shown = (image.float() / self.factor(camera)).round().clamp(0, 255).to(torch.uint8)
        return torch.where(image == 255, image, shown)

    def taken(self, neutral: Tensor, camera: Camera) -> Tensor:
        """Neutral colours (H, W, 3) in [0, 1] as this photo would show them."""
        return (neutral * self.factor(camera).to(neutral)).clamp(0, 1)


def vignetting_basis(uv: Tensor, size: Tensor) -> Tensor:
    """r^2, r^4 and r^6, (N, 3) float32, at pixels (N, 2) of photos of the width and height ``size``, (2,) or (N, 2)."""
    middle = size / 2
    square = (uv.float() - middle).square().sum(-1) / middle.square().sum(-1)
    return torch.stack([square, square**2, square**3], -1)
