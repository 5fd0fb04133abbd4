"""Closed-form worlds: painted boxes on a painted floor, as a field and as photos of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from refield.field.encoding import Contraction
from refield.field.render import render_camera
from refield.field.sampling import OccupancySampler
from refield.scene import pose
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.images import write_image
from tests.fields import oracle_sampler

SPACE = Contraction(torch.tensor([0.0, 0.0, 0.2]), 1.4)
STEP = 0.02
FLOOR = 1.0


@dataclass(frozen=True)
class Box:
    """A box with its own paint; ``world_from_box`` has its origin in the middle."""

    half: tuple[float, float, float]
    world_from_box: Tensor
    paint: int = 0
    """seed of the pattern; negative is one plain colour"""

    @cached_property
    def _box_from_world(self) -> Tensor:
        return pose.invert(self.world_from_box)

    @cached_property
    def _waves(self) -> tuple[Tensor, Tensor]:
        g = torch.Generator().manual_seed(self.paint)
        return (torch.rand(3, 3, generator=g) - 0.5) * 36, torch.rand(3, generator=g) * 6

    def inside(self, x: Tensor) -> Tensor:
        local = pose.transform(self._box_from_world, x).abs()
        a, b, c = self.half
        return (local[..., 0] < a) & (local[..., 1] < b) & (local[..., 2] < c)

    def colour(self, x: Tensor) -> Tensor:
        if self.paint < 0:
            return x.new_tensor([0.8, 0.2, 0.15]).expand_as(x)
        waves, phases = self._waves
        return 0.5 + 0.4 * torch.sin(pose.transform(self._box_from_world, x) @ waves + phases)

    def moved(self, new_from_old: Tensor) -> Box:
        return replace(self, world_from_box=new_from_old @ self.world_from_box)


@dataclass(frozen=True)
class BoxWorld:
    """A Field. The floor fills z in [-0.08, 0]."""

    boxes: tuple[Box, ...]

    @cached_property
    def sampler(self) -> OccupancySampler:
        return oracle_sampler(self.density, SPACE, STEP)

    def density(self, x: Tensor) -> Tensor:
        return self._density(x, [box.inside(x) for box in self.boxes])

    def _density(self, x: Tensor, inside: Sequence[Tensor]) -> Tensor:
        flat = x.detach()
        solid = (flat[..., 2] <= 0) & (flat[..., 2] >= -0.08) & (flat[..., :2].abs().amax(-1) < FLOOR)
        for held in inside:
            solid = solid | held
        return torch.where(solid, 250.0, 0.0)

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        at = x.reshape(-1, 3)
        rgb = 0.45 + 0.2 * torch.sin(at[:, :2] @ at.new_tensor([[9.0, 14, 3], [11, -7, 16]]))
        inside = [box.inside(at) for box in self.boxes]
        for box, held in zip(self.boxes, inside):
            rows = held.nonzero()[:, 0]
            rgb = rgb.index_copy(0, rows, box.colour(at[rows]))
        return self._density(at, inside).reshape(x.shape[:-1]), rgb.reshape(x.shape)


def standing(half: tuple[float, float, float], x: float, y: float, degrees: float, paint: int = 0) -> Box:
    """A box on the floor, turned about the upright."""
    twist = torch.tensor([0, 0, 0, 0, 0, math.radians(degrees)], dtype=torch.float64)
    at = torch.tensor([x, y, half[2]], dtype=torch.float64)
    return Box(half, pose.rigid(pose.exp(twist)[:3, :3], at), paint)


def turn(centre: Tensor, degrees: float, shift: Sequence[float], axis: Sequence[float] = (0, 0, 1)) -> Tensor:
    """new_from_old: turned about an axis through ``centre`` (3,), then shifted."""
    a = torch.tensor(axis, dtype=torch.float64)
    r = pose.exp(torch.cat([torch.zeros(3, dtype=torch.float64), a * math.radians(degrees)]))[:3, :3]
    return pose.rigid(r, centre + torch.tensor(shift, dtype=torch.float64) - r @ centre)


def camera_at(azimuth: float, elevation: float, radius: float = 2.0) -> Tensor:
    """world_from_cam looking at (0, 0, 0.15); angles in degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    way = [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]
    target = torch.tensor([0, 0, 0.15], dtype=torch.float64)
    eye = target + radius * torch.tensor(way, dtype=torch.float64)
    forward = functional.normalize(target - eye, dim=0)
    right = functional.normalize(torch.linalg.cross(forward, forward.new_tensor([0, 0, 1.0])), dim=0)
    return pose.rigid(torch.stack([right, torch.linalg.cross(forward, right), forward], -1), eye)


def photograph(
    world: BoxWorld, folder: Path, poses: Sequence[Tensor], gain: float = 1.0, noise: float = 0.008
) -> list[Frame]:
    """Photos of a world, with sensor noise and an exposure of their own."""
    camera = Camera(80, 80, 96.0, 96.0, 40.0, 40.0)
    g = torch.Generator().manual_seed(len(poses))
    frames = []
    for i, world_from_cam in enumerate(poses):
        path = folder / f"{i:03d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        rgb = render_camera(world, camera, world_from_cam).rgb * gain
        write_image(path, (rgb + noise * torch.randn(rgb.shape, generator=g)).clamp(0, 1))
        frames.append(Frame(path, camera, path.name, world_from_cam))
    return frames


def capture_of(world: BoxWorld, folder: Path, count: int = 20) -> Capture:
    """Old photos from all around, at several heights."""
    poses = [camera_at(k * 137.5, 18 + 45 * ((k * 0.618) % 1)) for k in range(count)]
    return Capture(tuple(photograph(world, folder, poses)))


def new_photos(world: BoxWorld, folder: Path, gain: float = 1.08) -> list[Frame]:
    """Four photos from around."""
    return photograph(world, folder, [camera_at(20 + 90 * k, 34) for k in range(4)], gain)
