"""A room in closed form, photographed from a ring: something to find exposures, poses and strangers in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.images import write_image
from refield.scene.pose import exp
from tests.captures import looking_at

CAMERA = Camera(48, 48, 40.0, 40.0, 24.0, 24.0)
"""of every photo"""
Change = Callable[[Tensor, int], Tensor]
"""A photo (H, W, 3) in [0, 1] and its number -> the photo that is taken instead"""


def poses(count: int) -> list[Tensor]:
    """Cameras around a ball, in the room, at three heights, that look here and there."""
    out, g = [], torch.Generator().manual_seed(0)
    for i in range(count):
        a, height = torch.tensor(i * 2.4, dtype=torch.float64), -0.5 + 0.5 * (i % 3)
        eye = torch.stack([2 * a.cos(), 2 * a.sin(), torch.tensor(height, dtype=torch.float64)])
        out.append(looking_at(eye, torch.rand(3, generator=g, dtype=torch.float64) * 1.6 - 0.8))
    return out


def photograph(camera: Camera, pose: Tensor) -> Tensor:
    """A ball in a room, both with waves of colour, (H, W, 3) in [0, 1]: the mean of four rays a pixel."""
    fine = camera.scaled(2 * camera.width, 2 * camera.height)
    rays = camera_rays(fine, pose)
    o, d = rays.origins, rays.directions
    along = (o * d).sum(-1)
    inside = along * along - (o.square().sum(-1) - 0.7**2)
    ball = o + d * (-along - inside.clamp_min(0).sqrt())[:, None]
    wall = o + d * ((3.0 * d.sign() - o) / d).amin(-1, keepdim=True)
    shown = torch.where((inside > 0)[:, None], waves(ball, 5.0), waves(wall, 1.7))
    return shown.reshape(camera.height, 2, camera.width, 2, 3).mean((1, 3))


def waves(x: Tensor, often: float) -> Tensor:
    """Colours (S, 3) between 0.15 and 0.65 at points (S, 3)."""
    first = torch.sin(often * x + torch.tensor([0.3, 1.1, 2.0]))
    return 0.4 + 0.15 * first + 0.1 * torch.sin(1.7 * often * x.roll(1, -1))


def room(folder: Path, count: int = 40, change: Change | None = None) -> Capture:
    """Photos of the room on disk, and where they were taken."""
    frames = []
    for i, pose in enumerate(poses(count)):
        photo = photograph(CAMERA, pose)
        write_image(folder / f"{i:03d}.png", photo if change is None else change(photo, i).clamp(0, 1))
        frames.append(Frame(folder / f"{i:03d}.png", CAMERA, f"{i:03d}.png", pose))
    return Capture(tuple(frames))


def turned(pose: Tensor, by: Tensor, shift: Tensor) -> Tensor:
    """A pose with its camera turned about its own place by a rotation vector (3,), and moved, both in world axes."""
    out = pose.clone()
    out[:3, :3] = exp(torch.cat([torch.zeros(3), by]).double())[:3, :3] @ pose[:3, :3]
    out[:3, 3] += shift.double()
    return out
