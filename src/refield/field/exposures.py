"""Exposure, white balance and vignetting, found while a field is fitted to photos: beside the field, not in it.

Letters: F photos, C cameras, N rays of a step. See `refield.scene.exposure` for the model.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from refield.field.pixels import PixelBank
from refield.scene.camera import Camera
from refield.scene.capture import Frame
from refield.scene.exposure import Exposure

_SHARE = 0.05  # of what a step says is missing is taken over, at the full rate
_HOLD = 0.9  # of what is known of a parameter's curvature is kept from step to step
_STIFF = 0.1  # of the mean curvature is added to vignetting's, whose three terms are much alike
_SHARED = 3  # photos of one camera from which its vignetting can be told from theirs


class ExposureFit:
    """Natural gradient descent on three logarithms a photo and three numbers a camera.

    The photos' logarithms have the mean 0 in every channel, so that the field's colours are those of a photo of mean
    exposure.
    """

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._cameras = list(dict.fromkeys(f.camera for f in frames))
        self.camera_of = torch.tensor([self._cameras.index(f.camera) for f in frames])
        """(F,)"""
        self.log_gains = torch.zeros(len(frames), 3)
        self.vignetting = torch.zeros(len(self._cameras), 3)
        self._curvature = torch.zeros(len(frames), 3)
        self._bend = torch.zeros(len(self._cameras), 3, 3)
        self._shared = torch.bincount(self.camera_of) >= _SHARED

    def gains(self, owner: Tensor, basis: Tensor) -> Tensor:
        """By how much photos differ from neutral: of photos (N,) at pixels whose `vignetting_basis` is (N, 3)."""
        fallen = (self.vignetting[self.camera_of[owner]] * basis).sum(-1, keepdim=True)
        return (self.log_gains[owner] + fallen).exp()

    def learn(self, owner: Tensor, basis: Tensor, seen: Tensor, errors: Tensor, rate: float) -> None:
        """Follow a step: what was seen in the photos' exposure and its error, (N, 3) each; ``rate`` in [0, 1]."""
        self._follow_gains(owner, seen, errors, rate)
        if bool(self._shared.any()):
            self._follow_vignetting(owner, basis, seen, errors, rate)

    def _follow_gains(self, owner: Tensor, seen: Tensor, errors: Tensor, rate: float) -> None:
        slope = torch.zeros_like(self.log_gains).index_add_(0, owner, seen * errors)
        now = torch.zeros_like(self.log_gains).index_add_(0, owner, seen * seen)
        self._curvature = _remembered(self._curvature, now)
        self.log_gains -= _SHARE * rate * slope / self._curvature.clamp_min(1e-6)
        self.log_gains -= self.log_gains.mean(0)

    def _follow_vignetting(self, owner: Tensor, basis: Tensor, seen: Tensor, errors: Tensor, rate: float) -> None:
        camera = self.camera_of[owner]
        slope = torch.zeros_like(self.vignetting).index_add_(0, camera, (seen * errors).sum(-1, keepdim=True) * basis)
        weight = (seen * seen).sum(-1)[:, None, None]
        now = torch.zeros_like(self._bend).index_add_(0, camera, weight * basis[:, :, None] * basis[:, None])
        self._bend = _remembered(self._bend, now)
        stiff = self._bend.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1e-6)[:, None, None] * _STIFF
        change = torch.linalg.solve(self._bend + stiff * torch.eye(3), slope)
        self.vignetting -= _SHARE * rate * change * self._shared[:, None]

    def of_camera(self, camera: Camera) -> tuple[float, float, float]:
        """`Exposure.vignetting` of a camera; of one that took none of the photos, none."""
        if camera not in self._cameras:
            return 0.0, 0.0, 0.0
        a, b, c = self.vignetting[self._cameras.index(camera)].tolist()
        return a, b, c

    def found(self) -> tuple[Exposure, ...]:
        """Of each photo."""
        gains, fallen = self.log_gains.exp().tolist(), self.vignetting[self.camera_of].tolist()
        return tuple(Exposure((r, g, b), (u, v, w)) for (r, g, b), (u, v, w) in zip(gains, fallen))


def _remembered(before: Tensor, now: Tensor) -> Tensor:
    return now if not bool(before.any()) else _HOLD * before + (1 - _HOLD) * now


def basis_of(bank: PixelBank, pixels: Tensor, owner: Tensor) -> Tensor:
    """`vignetting_basis` at pixels (N,) of a bank, whose photos are ``owner`` (N,); (N, 3)."""
    width = torch.tensor([f.camera.width for f in bank.frames])[owner]
    height = torch.tensor([f.camera.height for f in bank.frames])[owner]
    place = bank.place_of(pixels)
    x, y = (place % width + 0.5) - width / 2, (place // width + 0.5) - height / 2
    square = (x * x + y * y) / ((width / 2) ** 2 + (height / 2) ** 2)
    return torch.stack([square, square**2, square**3], -1)
