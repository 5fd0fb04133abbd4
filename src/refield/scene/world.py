"""What is known of a capture's world beside its coordinates: which way is up, how large it is, how long a unit.

For showing and telling only. The coordinates are the capture's own and are never turned, shifted or scaled by it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refield.scene.capture import Capture, centres
from refield.scene.errors import InputError


@dataclass(frozen=True)
class World:
    """A capture's world."""

    up: tuple[float, float, float]
    """unit vector, as the photos were held"""
    size: float
    """the largest distance between two cameras, in the world's units: what "of the scene" refers to"""
    metres_per_unit: float | None = None
    """None where it is not known, as always from photos alone"""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    @staticmethod
    def from_dict(data: dict[str, Any], where: Path) -> World:
        """What `to_dict` gave.

        Raises:
            InputError: it is not that.
        """
        try:
            x, y, z = (float(v) for v in data["up"])
            metres = data.get("metres_per_unit")
            world = World((x, y, z), float(data["size"]), None if metres is None else float(metres))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(where, f"does not describe a world ({error})", "train again") from None
        if not (math.isfinite(world.size) and world.size >= 0 and (world.metres_per_unit or 1) > 0):
            raise InputError(where, "holds a size or scale that is none", "train again")
        return world


def world_of(capture: Capture, metres_per_unit: float | None = None) -> World:
    """Up and size, from where the cameras stand and how they are held.

    People hold cameras level: up is the direction that all cameras' x axes are most nearly square to.
    """
    turns = torch.stack([frame.world_from_cam[:3, :3] for frame in capture.frames])
    across, down = turns[:, :, 0], turns[:, :, 1].mean(0)
    vectors = torch.linalg.eigh(across.T @ across).eigenvectors
    up = vectors[:, 0] * -torch.sign(vectors[:, 0] @ down)
    # cameras that all look one way leave a choice: then their own mean decides
    if float((up @ -down) / down.norm().clamp_min(1e-12)) < 0.5:
        up = -down / down.norm().clamp_min(1e-12)
    at = centres(capture.frames)
    x, y, z = (float(v) for v in up)
    return World((x, y, z), float(torch.cdist(at, at).max()), metres_per_unit)


def looked_at(at: Tensor, forward: Tensor) -> Tensor:
    """What cameras with centres (F, 3) and unit optical axes (F, 3) look at, (3,): the point nearest to all axes. What
    lies behind half of the cameras is not looked at: then their middle."""
    across = torch.eye(3, dtype=at.dtype) - forward[:, :, None] * forward[:, None, :]
    normal = across.sum(0) + 1e-6 * len(at) * torch.eye(3, dtype=at.dtype)
    focus = torch.linalg.solve(normal, (across @ at[:, :, None])[..., 0].sum(0) + 1e-6 * at.sum(0))
    ahead = ((focus - at) * forward).sum(1) > 0
    return focus if ahead.double().mean() > 0.5 else at.mean(0)
