"""A textured corner of a room, photographed by formula: enough to find camera poses by."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.images import write_image
from tests.captures import looking_at

CAMERA = Camera(width=200, height=150, fx=190.0, fy=190.0, cx=100.0, cy=75.0)


@cache
def texture(seed: int) -> np.ndarray:
    """(512, 512, 3) in [0, 1], with detail at every scale."""
    random = np.random.default_rng(seed)
    total = np.zeros((512, 512, 3), np.float32)
    for size in (8, 24, 64, 160):
        total += cv2.resize(random.random((size, size, 3), np.float32), (512, 512), interpolation=cv2.INTER_CUBIC)
    return (total - total.min()) / (total.max() - total.min())


def photo(camera: Camera, world_from_cam: Tensor, seed: int = 0) -> Tensor:
    """A floor at z = 0 and two walls behind it, (H, W, 3) in [0, 1]."""
    rays = camera_rays(camera, world_from_cam)
    o, d = rays.origins.double(), rays.directions.double()
    best = torch.full((len(d),), torch.inf, dtype=torch.float64)
    colour = torch.full((len(d), 3), 0.5)
    for k, axis in enumerate((2, 1, 0)):
        t = ((-2.0 if axis < 2 else 0.0) - o[:, axis]) / d[:, axis]
        at = (o + t[:, None] * d)[:, [a for a in range(3) if a != axis]]
        pixels = ((at + 4) / 8 * 511).float().numpy()
        x, y = (pixels[:, i].reshape(camera.height, camera.width) for i in (0, 1))
        seen = cv2.remap(texture(seed * 3 + k), x, y, cv2.INTER_LINEAR).reshape(-1, 3)
        nearer = (t > 0) & (t < best) & (at.abs() < 4).all(1)
        best = torch.where(nearer, t, best)
        colour = torch.where(nearer[:, None], torch.from_numpy(seen), colour)
    return colour.reshape(camera.height, camera.width, 3)


def poses(count: int, turn: float = 0.0) -> list[Tensor]:
    """On an arc before the corner, all looking into it."""
    out = []
    for k in range(count):
        angle = 0.35 + 0.9 * (k + turn) / count
        eye = torch.tensor([2.4 * np.cos(angle), 2.4 * np.sin(angle), 1.2 + 0.3 * np.sin(3 * angle)])
        out.append(looking_at(eye.double(), torch.tensor([-0.9, -0.9, 0.5], dtype=torch.float64)))
    return out


def write_photos(folder: Path, count: int, turn: float = 0.0, camera: Camera = CAMERA, seed: int = 0) -> Capture:
    """``folder/0.png`` and on; what they show."""
    frames = []
    for i, pose in enumerate(poses(count, turn)):
        path = folder / f"{i}.png"
        write_image(path, photo(camera, pose, seed))
        frames.append(Frame(path, camera, path.name, pose))
    return Capture(tuple(frames))


def turned(camera: Camera) -> Camera:
    """Held upright in place of across."""
    w, h = camera.height, camera.width
    return replace(camera, width=w, height=h, cx=w / 2, cy=h / 2)
