"""Exposure, white balance and vignetting, found while a field is fitted to photos: beside the field, not in it.

What all photos have in common at a place is the field's, which is still learning; what sets them apart there is theirs.
So each place's own colour is solved for along with the exposures, and then forgotten: the field is to find it.

Letters: F photos, C cameras, K places, N rays of a step. See `refield.scene.exposure` for the model.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Frame
from refield.scene.exposure import Exposure

_EVERY = 32  # steps from one solution to the next
_KEPT = 0.7  # of what rays have told is still believed a solution later: the field has learnt since
_DOUBT = 0.05  # rays of full white that say as much as is known before: that photos are exposed alike
_SHARED = 3  # photos of one camera from which its vignetting can be told from theirs


class ExposureFit:
    """Least squares of three logarithms a photo and three numbers a camera, over what rays told lately.

    The photos' logarithms have the mean 0 in every channel, so that the field's colours are those of a photo of mean
    exposure.
    """

    def __init__(self, frames: Sequence[Frame], places: int) -> None:
        """``places``: K, where rays may end."""
        self._cameras = list(dict.fromkeys(f.camera for f in frames))
        self.camera_of = torch.tensor([self._cameras.index(f.camera) for f in frames])
        """(F,)"""
        self.log_gains = torch.zeros(len(frames), 3)
        self.vignetting = torch.zeros(len(self._cameras), 3)
        self._shared = torch.bincount(self.camera_of) >= _SHARED
        # of each photo at each place: weight of its rays, and that times their basis; their errors
        self._weights, self._slopes = torch.zeros(len(frames), places, 4), torch.zeros(len(frames), places, 3)
        # of each camera: weight of its rays times their basis squared; errors times basis
        self._bend, self._pull = torch.zeros(2, len(self._cameras), 3, 3)
        self._steps = 0

    def gains(self, owner: Tensor, basis: Tensor) -> Tensor:
        """By how much photos differ from neutral: of photos (N,) at pixels whose `vignetting_basis` is (N, 3)."""
        fallen = (self.vignetting[self.camera_of[owner]] * basis).sum(-1, keepdim=True)
        return (self.log_gains[owner] + fallen).exp()

    def learn(self, owner: Tensor, basis: Tensor, seen: Tensor, errors: Tensor, place: Tensor, rate: float) -> None:
        """Follow a step: what was seen in the photos' exposure and its error, (N, 3) each; where the rays end, (N,),
        -1: nowhere; ``rate`` in [0, 1]."""
        ends = (place >= 0)[:, None]
        weight, slope = ends * seen.square().mean(-1, keepdim=True), ends * seen * errors
        at, camera = owner * self._weights.shape[1] + place.clamp_min(0), self.camera_of[owner]
        self._weights.view(-1, 4).index_add_(0, at, torch.cat([weight, weight * basis], -1))
        self._slopes.view(-1, 3).index_add_(0, at, slope)
        self._bend.index_add_(0, camera, (weight * basis)[:, :, None] * basis[:, None])
        self._pull.index_add_(0, camera, basis[:, :, None] * slope[:, None])
        self._steps += 1
        if self._steps % _EVERY == 0:
            self._follow(rate)
            for told in (self._weights, self._slopes, self._bend, self._pull):
                told *= _KEPT

    def _follow(self, rate: float) -> None:
        """Go towards the solution, and bring what was told to where that leads."""
        photos, normal, toward = len(self.log_gains), *self._equations()
        # one vignetting for all channels: what their mean says
        fallen = torch.linalg.solve(normal, toward).mean(-1)[photos:]
        logs = torch.linalg.solve(
            normal[:photos, :photos], toward[:photos] - normal[:photos, photos:] @ fallen[:, None]
        )
        logs, fallen = -rate * logs, -rate * fallen.view(-1, 3)
        self.log_gains += logs
        self.log_gains -= self.log_gains.mean(0)
        self.vignetting += fallen
        moved = self._weights[..., 1:] @ fallen[self.camera_of][:, :, None] + self._weights[..., :1] * logs[:, None]
        self._pull += (self._bend @ fallen[:, :, None]) + self._of_cameras(
            self._weights[..., 1:].sum(1)[..., None] * logs[:, None]
        )
        self._slopes += moved

    def _equations(self) -> tuple[Tensor, Tensor]:
        """Normal equations of gains and vignetting, (F + 3 C, F + 3 C), and what stands on their right in every
        channel, (F + 3 C, 3); the places' own colours are eliminated."""
        used = self._weights[..., 0].sum(0) > 0
        weights, slopes = self._weights[:, used], self._slopes[:, used]
        photos, cameras = len(self.log_gains), len(self.vignetting)
        fallen = self._of_cameras(weights[..., 1:]).transpose(1, 2).reshape(3 * cameras, -1)
        rows = torch.cat([weights[..., 0], fallen])
        whole = torch.zeros(len(rows), len(rows))
        whole[:photos, :photos] = weights[..., 0].sum(1).diag()
        of = torch.nn.functional.one_hot(self.camera_of, cameras).float()
        mixed = (of[:, :, None] * weights[..., 1:].sum(1)[:, None]).reshape(photos, -1)
        whole[:photos, photos:], whole[photos:, :photos] = mixed, mixed.T
        whole[photos:, photos:] = torch.block_diag(*self._bend)
        shares = rows / (weights[..., 0].sum(0) + _DOUBT)
        normal = whole - rows @ shares.T + _DOUBT * torch.eye(len(rows))
        alone = (~self._shared).repeat_interleave(3).nonzero()[:, 0] + photos
        normal[alone], normal[:, alone] = 0.0, 0.0
        normal[alone, alone] = 1.0
        at = torch.cat([self.log_gains, self.vignetting.view(-1, 1).expand(-1, 3)])
        toward = torch.cat([slopes.sum(1), self._pull.reshape(-1, 3)]) - shares @ slopes.sum(0) + _DOUBT * at
        toward[alone] = 0.0
        return normal, toward

    def _of_cameras(self, values: Tensor) -> Tensor:
        """Sums over each camera's photos: (F, ...) -> (C, ...)."""
        return values.new_zeros(len(self.vignetting), *values.shape[1:]).index_add_(0, self.camera_of, values)

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
