"""From where the photos look at the scene, and how often they see each part of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from refield.scene.capture import Capture, centres
from refield.scene.world import World, looked_at

_POINTS = 2000  # of structure from motion, that are looked at


@dataclass(frozen=True)
class Coverage:
    """Directions are those from the focus, the point that the cameras look at, to the cameras; degrees."""

    focus: Tensor
    """(3,) float64, world"""
    gap: float
    """the widest angle around the up axis without a camera"""
    lowest: float
    highest: float
    """elevation above the focus"""
    seen_by: float | None
    """photos that a point lies in (median); None without points"""

    @property
    def around(self) -> float:
        """The angle around the up axis in which there are cameras."""
        return 360.0 - self.gap


def coverage_of(capture: Capture, world: World) -> Coverage:
    """How a capture's cameras stand about what they look at."""
    at = centres(capture.frames)
    forward = torch.stack([frame.world_from_cam[:3, 2] for frame in capture.frames])
    focus = looked_at(at, forward)
    up = torch.tensor(world.up, dtype=torch.float64)
    rays = torch.nn.functional.normalize(at - focus, dim=1)
    height = (rays @ up).clamp(-1, 1).asin().rad2deg()
    return Coverage(focus, _widest_gap(rays, up), float(height.min()), float(height.max()), _seen_by(capture))


def _widest_gap(rays: Tensor, up: Tensor) -> float:
    basis = torch.linalg.svd(up[None]).Vh[1:]  # (2, 3), square to up
    turn = torch.atan2(rays @ basis[1], rays @ basis[0]).sort().values.rad2deg()
    return float(torch.cat([turn[1:], turn[:1] + 360]).sub(turn).max())


def _seen_by(capture: Capture) -> float | None:
    if len(capture.points) == 0:
        return None
    pick = torch.linspace(0, len(capture.points) - 1, min(_POINTS, len(capture.points))).long()
    points = capture.points[pick].double()
    count = torch.zeros(len(points))
    for frame in capture.frames:
        c, pose = frame.camera, frame.world_from_cam
        xy, depth = c.project((points - pose[:3, 3]) @ pose[:3, :3])
        count += (depth > 0) & (xy >= 0).all(-1) & (xy[:, 0] < c.width) & (xy[:, 1] < c.height)
    return float(count.median())
