"""Exposure, white balance and vignetting, found while a field is fitted to photos: beside the field, not in it.

Letters: F photos, C cameras, N rays of a step. See `refield.scene.exposure` for the model.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Frame
from refield.scene.exposure import Exposure

_MEMORY = 1000.0  # rays of a photo after which a little more is forgotten than learnt: the field learns, too
_DOUBT = 0.5  # what is known before: as much as so many rays of full white say
_FADE = 0.98  # of what the field lacks where rays end is still so a step later
_SHARED = 3  # photos of one camera from which its vignetting can be told from theirs


class ExposureFit:
    """Natural gradient descent on three logarithms a photo and three numbers a camera.

    The photos' logarithms have the mean 0 in every channel, so that the field's colours are those of a photo of mean
    exposure.
    """

    def __init__(self, frames: Sequence[Frame], cells: int) -> None:
        self._cameras = list(dict.fromkeys(f.camera for f in frames))
        self.camera_of = torch.tensor([self._cameras.index(f.camera) for f in frames])
        """(F,)"""
        self.log_gains = torch.zeros(len(frames), 3)
        self.vignetting = torch.zeros(len(self._cameras), 3)
        self._cells = torch.zeros(cells + 1, 2, 3)  # where rays end: their errors, their curvature
        self._curvature = torch.zeros(len(frames), 3)
        self._bend = torch.zeros(len(self._cameras), 3, 3)
        self._photos = torch.bincount(self.camera_of)
        self._shared = self._photos >= _SHARED

    def gains(self, owner: Tensor, basis: Tensor) -> Tensor:
        """By how much photos differ from neutral: of photos (N,) at pixels whose `vignetting_basis` is (N, 3)."""
        fallen = (self.vignetting[self.camera_of[owner]] * basis).sum(-1, keepdim=True)
        return (self.log_gains[owner] + fallen).exp()

    def learn(self, owner: Tensor, basis: Tensor, seen: Tensor, errors: Tensor, surface: Tensor, rate: float) -> None:
        """Follow a step: what was seen in the photos' exposure and its error, (N, 3) each; where the rays end, (N,),
        -1: nowhere; ``rate`` in [0, 1]."""
        errors = self._alone(seen, errors, surface)
        self._follow_gains(owner, seen, errors, rate)
        if bool(self._shared.any()):
            self._follow_vignetting(owner, basis, seen, errors, rate)

    def _alone(self, seen: Tensor, errors: Tensor, surface: Tensor) -> Tensor:
        """Errors less what all photos have in common where rays end: that is the field's, which is still learning."""
        place = surface + 1
        cells = self._cells[place]
        common = cells[:, 0] / (cells[:, 1] + _DOUBT)
        self._cells *= _FADE
        self._cells.index_add_(0, place, torch.stack([seen * errors, seen * seen], 1))
        return errors - seen * common

    def _follow_gains(self, owner: Tensor, seen: Tensor, errors: Tensor, rate: float) -> None:
        slope = torch.zeros_like(self.log_gains).index_add_(0, owner, seen * errors)
        now = torch.zeros_like(self.log_gains).index_add_(0, owner, seen * seen)
        rays = torch.bincount(owner, minlength=len(self.log_gains))[:, None]
        self._curvature = (1 - rays / _MEMORY).clamp_min(0) * self._curvature + now
        self.log_gains -= rate * slope / (self._curvature + _DOUBT)
        self.log_gains -= self.log_gains.mean(0)

    def _follow_vignetting(self, owner: Tensor, basis: Tensor, seen: Tensor, errors: Tensor, rate: float) -> None:
        camera = self.camera_of[owner]
        slope = torch.zeros_like(self.vignetting).index_add_(0, camera, (seen * errors).sum(-1, keepdim=True) * basis)
        weight = (seen * seen).sum(-1)[:, None, None]
        now = torch.zeros_like(self._bend).index_add_(0, camera, weight * basis[:, :, None] * basis[:, None])
        rays = torch.bincount(camera, minlength=len(self.vignetting)) / self._photos
        self._bend = (1 - rays / _MEMORY).clamp_min(0)[:, None, None] * self._bend + now
        change = torch.linalg.solve(self._bend + _DOUBT * torch.eye(3), slope)
        self.vignetting -= rate * change * self._shared[:, None]

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
