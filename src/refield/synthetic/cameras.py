"""Where a world is photographed from (§11.1)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.pose import rigid

RADIUS = 2.1
"""metres from the cameras to what they look at"""
HEIGHTS = 10
FIELD_OF_VIEW = 46.0
"""degrees; 1.8 m across at the distance of the middle"""
_LOWEST, _HIGHEST = 0.2, 0.94  # sine of the elevation
NEW_ELEVATION = 36.0
"""degrees, of the new photos"""


def square_camera(size: int) -> Camera:
    """An undistorted camera of ``size`` x ``size`` pixels."""
    focal = size / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    return Camera(size, size, focal, focal, size / 2, size / 2)


def looking_at(eye: Tensor, target: Tensor) -> Tensor:
    """world_from_cam (4, 4) float64 of an upright camera at ``eye`` (3,), z up in the world, OpenCV axes."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, forward.new_tensor([0, 0, 1.0])), dim=0)
    down = torch.linalg.cross(forward, right)
    return rigid(torch.stack([right, down, forward], -1), eye)


def _on_sphere(target: Tensor, elevation: float, azimuth: float) -> Tensor:
    out = [
        math.cos(elevation) * math.cos(azimuth),
        math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    ]
    return looking_at(target + RADIUS * target.new_tensor(out), target)


def hemisphere(count: int, target: tuple[float, float, float]) -> list[Tensor]:
    """``count`` poses at 10 heights of the upper hemisphere, evenly around on each, all looking inward."""
    middle = torch.tensor(target, dtype=torch.float64)
    poses = []
    for level in range(HEIGHTS):
        here = count * (level + 1) // HEIGHTS - count * level // HEIGHTS
        elevation = math.asin(_LOWEST + (_HIGHEST - _LOWEST) * level / (HEIGHTS - 1))
        for k in range(here):
            # the golden ratio keeps the cameras of different heights from standing above each other
            turn = (k + (level * 0.618) % 1) / here
            poses.append(_on_sphere(middle, elevation, 2 * math.pi * turn))
    return poses


def ring(
    target: tuple[float, float, float], count: int = 8, elevation: float = NEW_ELEVATION, turn: float = 0.0
) -> list[Tensor]:
    """The new views: ``count`` poses at one ``elevation`` (degrees), 360 / count degrees apart, turned by ``turn``."""
    middle = torch.tensor(target, dtype=torch.float64)
    angle, first = math.radians(elevation), math.radians(turn)
    return [_on_sphere(middle, angle, first + 2 * math.pi * (k + 0.3) / count) for k in range(count)]
