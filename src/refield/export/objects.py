"""Of a scene's surface what belongs to one object."""

from __future__ import annotations

import torch

from refield.export.surface import Points
from refield.scene.change import OccupancyGrid

_RIM = 1.5  # cells beside the grid's occupied part: its faces lie on the surface, give or take one


def points_in(points: Points, grid: OccupancyGrid) -> Points:
    """Those on an object that is where ``grid`` says."""
    from scipy.spatial import cKDTree

    occupied = grid.occupied()
    if len(occupied) == 0:
        return points[torch.zeros(0, dtype=torch.long)]
    reach = _RIM * float(grid.cell.max())
    distance, _ = cKDTree(occupied.numpy()).query(points.xyz.numpy(), distance_upper_bound=reach)
    return points[torch.from_numpy(distance <= reach)]
