"""The browser's coordinates: the world shifted and scaled, so that every scene has about the same size there.

A graphics card computes with few digits, and splats come as half floats: worlds of a millimetre or of kilometres would
flicker. What is told and kept stays in the world's own coordinates; this is for drawing alone. Axes are not turned.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.export.gltf import quaternion
from refield.scene.capture import Frame, centres
from refield.scene.pose import invert, nearest_rotation, rigid, transform
from refield.scene.world import World, looked_at

Array = NDArray[np.float32]
Vector = tuple[float, float, float]
_BACK = 1.25  # times as far away as the photographer stood
_REACH = 4.0  # units from the middle to the farthest camera: a far dome at 30 times as much is still drawn


@dataclass(frozen=True)
class Stage:
    """Where the world is drawn."""

    middle: Tensor
    """(3,) float64, world: what the cameras look at; the origin there"""
    scale: float
    """units there for one of the world's"""

    @staticmethod
    def around(frames: Sequence[Frame]) -> Stage:
        """For a scene that these photos show."""
        at = centres(frames)
        middle = looked_at(at, torch.stack([f.world_from_cam[:3, 2] for f in frames]))
        reach = float((at - middle).norm(dim=1).max())
        return Stage(middle, _REACH / reach if reach > 0 else 1.0)

    def points(self, xyz: Tensor) -> Array:
        """World (..., 3) -> drawn (..., 3)."""
        return ((xyz.double() - self.middle) * self.scale).float().numpy()

    def point(self, x: Tensor) -> Vector:
        """One world point (3,)."""
        at = self.points(x)
        return float(at[0]), float(at[1]), float(at[2])

    def pose(self, world_from_thing: Tensor) -> dict[str, Any]:
        """``wxyz`` and ``position`` of what has a pose (4, 4) in the world."""
        x, y, z, w = quaternion(world_from_thing[:3, :3])
        return {"wxyz": (w, x, y, z), "position": self.point(world_from_thing[:3, 3])}

    def seen_from(self, world_from_thing: Tensor) -> dict[str, Any]:
        """``wxyz`` and ``position``, below a node with that pose, of what is drawn in the world's place."""
        back = invert(world_from_thing)
        x, y, z, w = quaternion(back[:3, :3])
        at = -back[:3, :3] @ torch.from_numpy(self.points(world_from_thing[:3, 3])).double()
        return {"wxyz": (w, x, y, z), "position": tuple(at.tolist())}

    def world_points(self, xyz: Any) -> Tensor:
        """Drawn (..., 3) -> world (..., 3) float64."""
        return torch.as_tensor(np.asarray(xyz), dtype=torch.float64) / self.scale + self.middle

    def world_pose(self, wxyz: Any, position: Any) -> Tensor:
        """Of a drawn pose, (4, 4) float64."""
        w, x, y, z = torch.as_tensor(np.asarray(wxyz), dtype=torch.float64).tolist()
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return rigid(nearest_rotation(torch.tensor(rows, dtype=torch.float64)), self.world_points(position))


@dataclass(frozen=True)
class Look:
    """From where a browser looks at first, in units of the stage."""

    position: Vector
    look_at: Vector
    up: Vector
    fov: float
    """from the upper to the lower edge, radians"""


def first_look(stage: Stage, frames: Sequence[Frame], world: World, aspect: float = 1.0) -> Look:
    """Where a photographer stood, rather above the others, with what they look at before the eye; farther off on
    screens that are higher than wide (``aspect``: width over height)."""
    heights = centres(frames) @ torch.tensor(world.up, dtype=torch.float64)
    frame = frames[int((heights - heights.quantile(0.6)).abs().argmin())]
    ahead = float(transform(invert(frame.world_from_cam), stage.middle)[2]) > 0
    target = stage.middle if ahead else frame.centre + frame.world_from_cam[:3, 2] / stage.scale
    fov = 2 * math.atan(frame.camera.height / 2 / frame.camera.fy)
    back = target + _BACK / min(max(aspect, 0.5), 1.0) * (frame.centre - target)
    return Look(stage.point(back), stage.point(target), world.up, fov)
