"""Two placements of the same photos compared: the similarity between their worlds, and what remains.

Structure from motion knows the world up to a turn, a shift and a scale (Umeyama 1991 gives the best of them).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from refield.scene.capture import Frame, centres
from refield.scene.pose import angle_between


@dataclass(frozen=True)
class Similarity:
    """``there = scale * rotation @ here + shift``."""

    scale: float
    rotation: Tensor
    """(3, 3) float64"""
    shift: Tensor
    """(3,) float64"""

    def point(self, here: Tensor) -> Tensor:
        """(..., 3) -> (..., 3)."""
        return self.scale * here @ self.rotation.T + self.shift

    def pose(self, here: Tensor) -> Tensor:
        """A rigid pose (4, 4) that leads into this world -> the same that leads into the other."""
        out = here.clone()
        out[:3, :3] = self.rotation @ here[:3, :3]
        out[:3, 3] = self.point(here[:3, 3])
        return out

    def motion(self, here: Tensor) -> Tensor:
        """A motion within this world (4, 4), such as a pose change -> the same motion within the other."""
        out = here.clone()
        out[:3, :3] = self.rotation @ here[:3, :3] @ self.rotation.T
        out[:3, 3] = self.scale * self.rotation @ here[:3, 3] + self.shift - out[:3, :3] @ self.shift
        return out


def similarity(here: Tensor, there: Tensor) -> Similarity:
    """The best similarity in the least squares from points (N, 3) float64 to points (N, 3), three or more.

    Raises:
        ValueError: the points lie in one place.
    """
    a, b = here - here.mean(0), there - there.mean(0)
    spread = float(a.square().sum())
    if len(here) < 3 or spread < 1e-18:
        raise ValueError("a similarity needs three points or more that do not lie in one place")
    u, s, vh = torch.linalg.svd(b.T @ a)
    keep = torch.ones(3, dtype=a.dtype)
    keep[2] = torch.sign(torch.linalg.det(u @ vh))
    rotation = u @ torch.diag(keep) @ vh
    scale = float((s * keep).sum()) / spread
    return Similarity(scale, rotation, there.mean(0) - scale * rotation @ here.mean(0))


def between(here: Sequence[Frame], there: Sequence[Frame]) -> Similarity:
    """From one placement's world to the other's, by the camera centres; the frames go together."""
    return similarity(centres(here), centres(there))


def pose_errors(here: Sequence[Frame], there: Sequence[Frame], known: Similarity) -> tuple[Tensor, Tensor]:
    """What remains: distances of the centres (F,), in the other world's units, and angles (F,), degrees."""
    moved = [known.pose(frame.world_from_cam) for frame in here]
    distances = torch.stack([(m[:3, 3] - f.centre).norm() for m, f in zip(moved, there)])
    angles = torch.stack([angle_between(m, f.world_from_cam) for m, f in zip(moved, there)])
    return distances, angles
