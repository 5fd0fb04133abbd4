"""Upright boxes around what changed: how large a thing is, how it is turned, and the ground that it covers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from refield.scene.change import OccupancyGrid
from refield.scene.pose import rigid, transform

_MOST_POINTS = 20_000


@dataclass(frozen=True)
class UprightBox:
    """A box with vertical sides, turned about the vertical until its footprint is smallest."""

    world_from_box: Tensor
    """(4, 4) float64: from axes along its sides, z up, with the origin in its middle"""
    size: tuple[float, float, float]
    """along its own axes, world units"""

    @property
    def corners(self) -> Tensor:
        """(8, 3) float64, world: the footprint's four in order, then those above them."""
        ring = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
        unit = torch.tensor([(x, y, z) for z in (-1, 1) for x, y in ring], dtype=torch.float64)
        return transform(self.world_from_box, unit * torch.tensor(self.size, dtype=torch.float64) / 2)

    @property
    def sides(self) -> tuple[float, float, float]:
        """Longer and shorter side of the footprint, and height; world units."""
        x, y, z = self.size
        return max(x, y), min(x, y), z


def across(up: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors that are level and square to each other; with ``up`` (3,) float64 they are right-handed."""
    other = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    right = torch.nn.functional.normalize(torch.linalg.cross(other, up), dim=0)
    return right, torch.linalg.cross(up, right)


def upright_box(grid: OccupancyGrid, up: Tensor) -> UprightBox:
    """The box around a grid's occupied nodes and half a cell more, as `OccupancyGrid.tight_aabb` has it.

    ``up``: (3,) float64, unit.
    """
    points = grid.occupied().double()
    points = points if len(points) else grid.aabb.double()
    points = points[:: max(len(points) // _MOST_POINTS, 1)]
    right, ahead = across(up)
    flat = torch.stack([points @ right, points @ ahead], 1)
    (x, y), (width, depth), angle = cv2.minAreaRect(flat.numpy().astype(np.float32))
    turn = math.radians(angle)
    along = math.cos(turn) * right + math.sin(turn) * ahead
    aside = -math.sin(turn) * right + math.cos(turn) * ahead
    half_cell = grid.cell.double() / 2
    width, depth = (s + 2 * float((d.abs() * half_cell).sum()) for s, d in ((width, along), (depth, aside)))
    rise = float((up.abs() * half_cell).sum())
    heights = points @ up
    low, high = float(heights.min()) - rise, float(heights.max()) + rise
    middle = x * right + y * ahead + (low + high) / 2 * up
    return UprightBox(rigid(torch.stack([along, aside, up], 1), middle), (width, depth, high - low))
