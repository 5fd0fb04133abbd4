"""Of a scene's surface what belongs to one object."""

from __future__ import annotations

import torch
from torch import Tensor

from refield.export.surface import Points
from refield.scene.change import OccupancyGrid

_RIM = 1.5  # cells beside the grid's occupied part: its faces lie on the surface, give or take one


def points_in(points: Points, grid: OccupancyGrid) -> Points:
    """Those on an object that is where ``grid`` says."""
    return points[on_object(points.xyz, grid)]


def on_object(xyz: Tensor, grid: OccupancyGrid) -> Tensor:
    """Which surface points (P, 3) belong to an object that is where ``grid`` says, (P,) bool."""
    from scipy.spatial import cKDTree

    occupied = grid.occupied()
    if len(occupied) == 0:
        return torch.zeros(len(xyz), dtype=torch.bool)
    reach = _RIM * float(grid.cell.max())
    distance, _ = cKDTree(occupied.numpy()).query(xyz.numpy(), distance_upper_bound=reach)
    return torch.from_numpy(distance <= reach)
