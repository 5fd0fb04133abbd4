"""Small captures on disk: cameras on a ring around a box of coloured noise, photographed by formula."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.images import write_image
from refield.scene.pose import rigid
from refield.scene.transforms_json import save_transforms

CAMERA = Camera(width=32, height=24, fx=40.0, fy=40.0, cx=16.0, cy=12.0)
DISTORTED = Camera(32, 24, 40.0, 41.0, 16.5, 11.5, k1=0.06, k2=-0.08, p1=-0.001, p2=0.0002)


def looking_at(eye: Tensor, target: Tensor) -> Tensor:
    """world_from_cam (4, 4) of a camera at ``eye`` with the world's z up."""
    forward = target - eye
    forward = forward / forward.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)
    return rigid(torch.stack([right, down, forward], -1), eye)


def ring(count: int, turn: float = 0.0) -> list[Tensor]:
    """Poses around the origin, 3 units away and 1.2 up."""
    angles = torch.arange(count, dtype=torch.float64) * (2 * torch.pi / count) + turn
    eyes = [torch.tensor([3 * torch.cos(a), 3 * torch.sin(a), 1.2], dtype=torch.float64) for a in angles]
    return [looking_at(eye, torch.zeros(3, dtype=torch.float64)) for eye in eyes]


def picture(camera: Camera, world_from_cam: Tensor) -> Tensor:
    """A floor with stripes and a dark sky, (H, W, 3) in [0, 1]."""
    rays = camera_rays(camera, world_from_cam)
    t = (-0.3 - rays.origins[:, 2]) / rays.directions[:, 2].clamp(max=-1e-6)
    hit = rays.origins + t[:, None] * rays.directions
    colour = 0.5 + 0.4 * torch.sin(hit * torch.tensor([2.0, 3.0, 1.0]))
    sky = torch.full_like(colour, 0.1)
    seen = (rays.directions[:, 2] < 0) & (t < 12)
    return torch.where(seen[:, None], colour, sky).reshape(camera.height, camera.width, 3)


def write_capture(folder: Path, count: int = 12, camera: Camera = CAMERA, turn: float = 0.0) -> Capture:
    """``folder/transforms.json`` and ``folder/images``; what they describe."""
    frames = []
    for i, pose in enumerate(ring(count, turn)):
        name = f"images/{i:03d}.png"
        write_image(folder / name, picture(camera, pose))
        frames.append(Frame(folder / name, camera, name, pose))
    capture = Capture(tuple(frames))
    save_transforms(folder / "transforms.json", capture)
    return capture
