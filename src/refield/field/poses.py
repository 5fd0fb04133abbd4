"""Where photos were taken and what their lenses are, refined while a field is fitted to them.

Letters: F photos, C cameras, N rays. A ray's direction is R (x, y, 1) but for its length; a pose changes by a rotation
vector about the camera's centre and a shift, in world axes, a lens by its focal length and its principal point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays
from refield.scene.pose import exp

_SPEED = 0.004  # of a pixel that a parameter moves things in the photo in one step at the full rate
_FAR = 8.0  # pixels: poses from structure from motion are not further off; a photo that wants more is not followed
_SHARED = 3  # photos of one camera from which its lens can be told from their poses


class PoseFit:
    """Adam on six numbers a photo and three a camera, each in pixels of what it moves.

    The mean of all changes stays 0: photos that are left out keep their places in the same world.
    """

    def __init__(self, frames: Sequence[Frame], distance: float) -> None:
        """``distance``: how far from the cameras most of what they see is, world units."""
        self.frames = tuple(frames)
        self._cameras = list(dict.fromkeys(f.camera for f in frames))
        self.camera_of = torch.tensor([self._cameras.index(f.camera) for f in frames])
        self._given = torch.stack([f.world_from_cam for f in frames])
        focal = torch.tensor([f.camera.fx for f in frames])
        size = torch.tensor([math.hypot(c.width, c.height) / 2 for c in self._cameras])
        # one unit of each parameter moves a pixel by one
        self._unit = torch.cat([(1 / focal)[:, None].expand(-1, 3), (distance / focal)[:, None].expand(-1, 3)], -1)
        lens = torch.tensor([c.fx for c in self._cameras])
        self._lens_unit = torch.stack([1 / size, 1 / lens, 1 / lens], -1)
        self.moved, self.lens = torch.zeros(len(frames), 6), torch.zeros(len(self._cameras), 3)
        """in pixels: rotation and shift of each photo; focal length, and principal point right and down, of each
        camera"""
        self._moments = [torch.zeros_like(p) for p in (self.moved, self.moved, self.lens, self.lens)]
        self._count = 0
        self._shared = (torch.bincount(self.camera_of) >= _SHARED)[:, None]
        self._pose()

    def rays(self, owner: Tensor, camera_directions: Tensor) -> Rays:
        """World rays of photos (N,) along unit directions (N, 3) in camera axes, as given lenses have them."""
        d = camera_directions
        if bool(self.lens.any()):
            d = self._bent(owner, d)
        world = (self.rotations[owner] @ d[:, :, None])[:, :, 0]
        return Rays(self.centres[owner], world)

    def _bent(self, owner: Tensor, d: Tensor) -> Tensor:
        lens = (self.lens * self._lens_unit)[self.camera_of[owner]]
        xy = d[:, :2] * (1 + lens[:, :1]) - lens[:, 1:] * d[:, 2:]
        return torch.nn.functional.normalize(torch.cat([xy, d[:, 2:]], -1), dim=-1)

    def learn(self, owner: Tensor, rays: Rays, to_rays: tuple[Tensor, Tensor], rate: float) -> None:
        """Follow how the loss changes with the first rays' origins and directions; ``rate`` in [0, 1]."""
        n = len(to_rays[0])
        owner, d = owner[:n], rays.directions[:n]
        to_d = to_rays[1] - (to_rays[1] * d).sum(-1, keepdim=True) * d  # lengths are 1
        turned = torch.cat([torch.linalg.cross(d, to_d), to_rays[0]], -1)
        to_moved = torch.zeros_like(self.moved).index_add_(0, owner, turned) * self._unit
        seen = (self.rotations[owner].transpose(1, 2) @ to_d[:, :, None])[:, :, 0]
        own = (self.rotations[owner].transpose(1, 2) @ d[:, :, None])[:, :, 0]
        along = (seen[:, :2] * own[:, :2]).sum(-1, keepdim=True)
        parts = torch.cat([along, -seen[:, :2] * own[:, 2:]], -1)
        camera = self.camera_of[owner]
        to_lens = torch.zeros_like(self.lens).index_add_(0, camera, parts) * self._lens_unit * self._shared
        self._count += 1
        first, second, lens_first, lens_second = self._moments
        self._descend(self.moved, to_moved, first, second, rate)
        self._descend(self.lens, to_lens, lens_first, lens_second, rate)
        self.moved -= self.moved.mean(0)
        self.moved.clamp_(-_FAR, _FAR)
        self._pose()

    def _descend(self, param: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float) -> None:
        """Adam, with as much memory as it takes to see every photo often."""
        first.mul_(0.9).add_(grad, alpha=0.1)
        second.mul_(0.99).addcmul_(grad, grad, value=0.01)
        scale = _SPEED * rate * math.sqrt(1 - 0.99**self._count) / (1 - 0.9**self._count)
        param -= scale * first / (second.sqrt() + 1e-20)

    def _pose(self) -> None:
        change = (self.moved * self._unit).double()
        turns = exp(torch.cat([torch.zeros_like(change[:, 3:]), change[:, :3]], -1))[:, :3, :3]
        rotations = turns @ self._given[:, :3, :3]
        self._now = self._given.clone()
        self._now[:, :3, :3] = rotations
        self._now[:, :3, 3] += change[:, 3:]
        self.rotations, self.centres = rotations.float(), self._now[:, :3, 3].float()

    def found(self) -> tuple[Frame, ...]:
        """The frames where they were taken, with their lenses."""
        lenses = [self._lens(i, c) for i, c in enumerate(self._cameras)]
        return tuple(
            replace(f, world_from_cam=pose, camera=lenses[int(c)])
            for f, pose, c in zip(self.frames, self._now, self.camera_of)
        )

    def _lens(self, index: int, camera: Camera) -> Camera:
        """To first order in what distortion does; changes are parts of a hundredth."""
        focal, right, down = (self.lens[index] * self._lens_unit[index]).double().tolist()
        fx, fy = camera.fx / (1 + focal), camera.fy / (1 + focal)
        return replace(camera, fx=fx, fy=fy, cx=camera.cx + right * fx, cy=camera.cy + down * fy)
