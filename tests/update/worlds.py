"""Closed-form fields: balls over a chequered floor, before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from refield.field.encoding import Contraction
from refield.field.sampling import OccupancySampler
from refield.scene import pose
from refield.scene.camera import Camera
from refield.scene.capture import Rays, camera_rays
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from tests.fields import oracle_sampler

SPACE = Contraction(torch.zeros(3), 1.5)
STEP = 0.025


@dataclass(frozen=True)
class Ball:
    """A ball whose colour turns with it: ``world_from_ball`` carries its own axes."""

    world_from_ball: Tensor
    radius: float

    @cached_property
    def ball_from_world(self) -> Tensor:
        return pose.invert(self.world_from_ball)

    def inside(self, x: Tensor) -> Tensor:
        """World points (S, 3), (S,) bool."""
        return pose.transform(self.ball_from_world, x).norm(dim=-1) < self.radius

    def colour(self, x: Tensor, d: Tensor) -> Tensor:
        """At world points (S, 3), along directions (S, 3)."""
        along = pose.rotate(self.ball_from_world, d)
        return 0.5 + 0.35 * torch.sin(9 * pose.transform(self.ball_from_world, x)) + 0.1 * along


@dataclass(frozen=True)
class BallWorld:
    """A Field. The floor fills z in [-0.1, 0]; colours depend on position and a little on direction."""

    balls: tuple[Ball, ...]
    floor: bool = True

    @cached_property
    def sampler(self) -> OccupancySampler:
        return oracle_sampler(self.density, SPACE, STEP)

    def density(self, x: Tensor) -> Tensor:
        flat = x.reshape(-1, 3)
        return self._density(flat, [ball.inside(flat) for ball in self.balls]).reshape(x.shape[:-1])

    def _density(self, x: Tensor, inside: Sequence[Tensor]) -> Tensor:
        solid = self._floor(x)
        for held in inside:
            solid = solid | held
        return torch.where(solid, 200.0, 0.0)

    def _floor(self, x: Tensor) -> Tensor:
        if not self.floor:
            return torch.zeros(len(x), dtype=torch.bool)
        return (x[:, 2] <= 0) & (x[:, 2] >= -0.1) & (x[:, :2].abs().amax(-1) < 1.4)

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        flat, along = x.reshape(-1, 3), d.reshape(-1, 3)
        inside = [ball.inside(flat) for ball in self.balls]
        rows = self._floor(flat).nonzero()[:, 0]
        rgb = torch.zeros_like(flat).index_copy(0, rows, 0.5 + 0.4 * torch.sin(6 * flat[rows]))
        for ball, held in zip(self.balls, inside):
            rows = held.nonzero()[:, 0]
            rgb = rgb.index_copy(0, rows, ball.colour(flat[rows], along[rows]))
        return self._density(flat, inside).reshape(x.shape[:-1]), rgb.reshape(x.shape)


def at(x: float, y: float, z: float, yaw: float = 0.0) -> Tensor:
    """A pose (4, 4) turned about z, then put at a place."""
    turn = pose.exp(torch.tensor([0, 0, 0, 0, 0, yaw], dtype=torch.float64))
    turn[:3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return turn


def grid_of(ball: Ball, nodes: int = 61) -> OccupancyGrid:
    """The ball's true grid, its 0.5 level on the surface."""
    c, r = ball.world_from_ball[:3, 3].float(), ball.radius
    aabb = torch.stack([c - 1.3 * r, c + 1.3 * r])
    grid = OccupancyGrid(aabb, torch.zeros(nodes, nodes, nodes))
    cell = 2.6 * r / (nodes - 1)
    return OccupancyGrid(aabb, (0.5 + (r - (grid.nodes() - c).norm(dim=-1)) / (2 * cell)).clamp(0, 1))


def moved(ball: Ball, world_from_ball: Tensor) -> ObjectChange:
    new_from_old = world_from_ball @ pose.invert(ball.world_from_ball)
    return ObjectChange("moved", grid_of(ball), new_from_old)


def change_of(*objects: ObjectChange) -> SceneChange:
    return SceneChange(tuple(objects))


def views(size: int = 48, count: int = 3) -> Rays:
    """Rays of a few cameras around the world, looking at the origin from above."""
    camera = Camera(size, size, size * 1.3, size * 1.3, size / 2, size / 2)
    parts = [camera_rays(camera, looking_from(0.7 + 2 * i, 3.2, 1.6)) for i in range(count)]
    return Rays(torch.cat([p.origins for p in parts]), torch.cat([p.directions for p in parts]))


def looking_from(yaw: float, distance: float, height: float) -> Tensor:
    """world_from_cam of a camera that looks at the origin."""
    a = torch.tensor(yaw, dtype=torch.float64)
    eye = torch.stack([distance * a.cos(), distance * a.sin(), torch.tensor(height, dtype=torch.float64)])
    z = -eye / eye.norm()
    x = torch.linalg.cross(z, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    x = x / x.norm()
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], -1)
    return pose.rigid(rotation, eye)
