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

from refield.field.kernels.reference import Batch, Stepped
from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays
from refield.scene.pose import exp

_MEMORY = 500.0  # rays of a photo after which a little more is forgotten than learnt: the field learns, too
_LIKELY = 0.5  # pixels: how far off poses and lenses usually are; photos that show too little to tell keep theirs
_FAR = 8.0  # pixels: poses from structure from motion are not further off; a photo that wants more is not followed
_SHARED = 3  # photos of one camera from which its lens can be told from their poses
_FAINT = (1 / 255) ** 2  # errors below say little of how a ray's colour changes


class PoseFit:
    """Natural gradient descent on six numbers a photo and three a camera, each in pixels of what it moves.

    What the changes of all poses have in common with a motion of the world, or with a turn of the principal point, is
    taken out of them: photos that are left out keep their places in the same world, and lenses are theirs, too.
    """

    def __init__(self, frames: Sequence[Frame], distance: float) -> None:
        """``distance``: how far from the cameras most of what they see is, world units."""
        self.frames = tuple(frames)
        self._cameras = list(dict.fromkeys(f.camera for f in frames))
        self.camera_of = torch.tensor([self._cameras.index(f.camera) for f in frames])
        self._given = torch.stack([f.world_from_cam for f in frames]).to(self.camera_of.device)
        focal = torch.tensor([f.camera.fx for f in frames])
        size = torch.tensor([math.hypot(c.width, c.height) / 2 for c in self._cameras])
        # one unit of each parameter moves a pixel by one
        self._unit = torch.cat([(1 / focal)[:, None].expand(-1, 3), (distance / focal)[:, None].expand(-1, 3)], -1)
        lens = torch.tensor([c.fx for c in self._cameras])
        self._lens_unit = torch.stack([1 / size, 1 / lens, 1 / lens], -1)
        self.moved, self.lens = torch.zeros(len(frames), 6), torch.zeros(len(self._cameras), 3)
        """in pixels: rotation and shift of each photo; focal length, and principal point right and down, of each
        camera"""
        self._known, self._lens_known = torch.zeros(len(frames), 6, 6), torch.zeros(len(self._cameras), 3, 3)
        self._noise = 0.0  # mean squared error of the rays, about
        self._photos = torch.bincount(self.camera_of)
        self._shared = (self._photos >= _SHARED)[:, None]
        self._common = self._in_common()
        self._now = self._given.clone()
        self.rotations, self.centres = self._now[:, :3, :3].float(), self._now[:, :3, 3].float()

    def rays(self, owner: Tensor, camera_directions: Tensor) -> Rays:
        """World rays of photos (N,) along unit directions (N, 3) in camera axes, as given lenses have them."""
        d = camera_directions
        if d.device.type != "cpu" or bool(self.lens.any()):  # a GPU is not asked
            d = self._bent(owner, d)
        world = (self.rotations[owner] @ d[:, :, None])[:, :, 0]
        return Rays(self.centres[owner], world)

    def _bent(self, owner: Tensor, d: Tensor) -> Tensor:
        lens = (self.lens * self._lens_unit)[self.camera_of[owner]]
        xy = d[:, :2] * (1 + lens[:, :1]) - lens[:, 1:] * d[:, 2:]
        return torch.nn.functional.normalize(torch.cat([xy, d[:, 2:]], -1), dim=-1)

    def learn(self, owner: Tensor, batch: Batch, done: Stepped, rate: float) -> None:
        """Follow a step on rays of photos (N,), the first of which told how the loss changes with them; ``rate`` in
        [0, 1]."""
        assert done.to_rays is not None and done.errors is not None
        n = batch.moving
        owner, d = owner[:n], batch.rays[1][:n]
        # of half of each ray's squared error, summed over its colours
        to_origin, to_d = (g * (1.5 * done.rays) for g in done.to_rays)
        to_d = to_d - (to_d * d).sum(-1, keepdim=True) * d  # lengths are 1
        turned = torch.cat([torch.linalg.cross(d, to_d), to_origin], -1) * self._unit[owner]
        off = done.errors[:n].square().sum(-1)
        off = off if batch.trust is None else off * batch.trust[:n]
        self._noise += (float(off.mean()) / 3 - self._noise) * (0.05 if self._noise else 1.0)
        rays = torch.bincount(owner, minlength=len(self.frames))
        step = self._followed(self._known, self.moved, (owner, turned, off), rays, torch.ones(len(rays)))
        self.moved -= rate * step
        self.moved -= (self._common @ (self.moved.reshape(-1) @ self._common)).view_as(self.moved)
        self.moved.clamp_(-_FAR, _FAR)
        camera = self.camera_of[owner]
        parts = self._lens_parts(owner, d, to_d) * self._lens_unit[camera]
        rays = torch.bincount(camera, minlength=len(self._cameras)) / self._photos
        told = camera, parts, off
        self.lens -= rate * self._shared * self._followed(self._lens_known, self.lens, told, rays, self._photos)
        self._pose()

    def _lens_parts(self, owner: Tensor, d: Tensor, to_d: Tensor) -> Tensor:
        """From directions and how the error changes with them, how it changes with the lens, (N, 3)."""
        back = self.rotations[owner].transpose(1, 2)
        seen, own = (back @ to_d[:, :, None])[:, :, 0], (back @ d[:, :, None])[:, :, 0]
        along = (seen[:, :2] * own[:, :2]).sum(-1, keepdim=True)
        return torch.cat([along, -seen[:, :2] * own[:, 2:]], -1)

    def _followed(
        self, known: Tensor, at: Tensor, told: tuple[Tensor, Tensor, Tensor], rays: Tensor, photos: Tensor
    ) -> Tensor:
        """How far parameters ``at`` (K, P) are to go back: rays' owners (N,), gradients (N, P) and errors (N,) are
        taken into what is ``known`` of the curvature (K, P, P), and the likely size of the parameters is heeded."""
        owner, slopes, off = told
        slope = torch.zeros_like(at).index_add_(0, owner, slopes)
        # a ray's gradient is its error times how its colour changes, which alone makes the curvature
        bend = slopes[:, :, None] * (slopes / (off + _FAINT)[:, None])[:, None]
        share = (rays / _MEMORY).clamp(max=1)[:, None]
        known.mul_(1 - share[:, None]).index_add_(0, owner, bend)
        likely = max(self._noise, _FAINT) / _LIKELY**2 * photos[:, None]
        return torch.linalg.solve(known + likely[:, None] * torch.eye(at.shape[1]), slope + share * likely * at)

    def _in_common(self) -> Tensor:
        """Changes of all poses that are no change of the photos, or one of their lens: orthonormal columns (6 F, K)."""
        eye = torch.eye(3, dtype=torch.float64).expand(len(self.frames), 3, 3)
        centres, none = self._given[:, :3, 3], torch.zeros_like(eye)
        turn = torch.linalg.cross(eye, centres[:, :, None].expand_as(eye), dim=1)
        scale = torch.cat([none[:, :, :1], (centres - centres.mean(0))[:, :, None]], 1)
        ways = [torch.cat([eye, turn], 1), torch.cat([none, eye], 1), scale]
        for camera in self._shared[:, 0].nonzero()[:, 0]:
            mine = (self.camera_of == camera).double()[:, None, None]
            ways.append(torch.cat([self._given[:, :3, :2] * mine, none[:, :, :2]], 1))
        rows = (torch.cat(ways, -1) / self._unit.double()[:, :, None]).reshape(6 * len(self.frames), -1)
        basis, sizes, _ = torch.linalg.svd(rows / rows.norm(dim=0).clamp_min(1e-12), full_matrices=False)
        return basis[:, sizes > 1e-3 * sizes[0]].float()

    def _pose(self) -> None:
        change = (self.moved * self._unit).double()
        turns = exp(torch.cat([torch.zeros_like(change[:, 3:]), change[:, :3]], -1))[:, :3, :3]
        self._now[:, :3, :3] = turns @ self._given[:, :3, :3]
        self._now[:, :3, 3] = self._given[:, :3, 3] + change[:, 3:]
        self.rotations.copy_(self._now[:, :3, :3])
        self.centres.copy_(self._now[:, :3, 3])

    def found(self) -> tuple[Frame, ...]:
        """The frames where they were taken, with their lenses."""
        lenses, poses = self.lenses(), self._now.clone().cpu()
        return tuple(replace(f, world_from_cam=pose, camera=lenses[f.camera]) for f, pose in zip(self.frames, poses))

    def lenses(self) -> dict[Camera, Camera]:
        """Of each camera as given, as it is now."""
        return {c: self._lens(i, c) for i, c in enumerate(self._cameras)}

    def _lens(self, index: int, camera: Camera) -> Camera:
        """To first order in what distortion does; changes are parts of a hundredth."""
        focal, right, down = (self.lens[index] * self._lens_unit[index]).double().tolist()
        fx, fy = camera.fx / (1 + focal), camera.fy / (1 + focal)
        return replace(camera, fx=fx, fy=fy, cx=camera.cx + right * fx, cy=camera.cy + down * fy)
