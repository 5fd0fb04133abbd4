"""What the old photos saw: of what they never did nothing is known, though a fitted field has something there, which
shows once what hid it has left; and what they looked through is empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_camera
from refield.field.sampling import OccupancySampler
from refield.field.volrend import depths_around
from refield.scene.capture import Frame

_EYES = 24  # old photos asked at most, spread over all
_SIDE = 56  # pixels of their longer side, each about as wide as a cell of the occupancy grid
_BEHIND = 1.5  # cells; so far behind the surface a cell may still reach into what was seen
_BEFORE = 0.5  # and from so far before it on it was looked through


@dataclass(frozen=True)
class Sight:
    """Which cells of a field's sampler, in some boxes, its photos saw."""

    sampler: OccupancySampler
    """the field's"""
    cells: Tensor
    """(K,) flat indices"""
    before: Tensor
    """(K,) by how many cells each lies before the surface that a photo shows there, at most over all photos; negative
    behind it. The farthest surface of the pixel and of those around it, which may be what shows at the cell"""
    through: Tensor
    """(K,) the same, before the nearest surface of these"""

    @property
    def hidden(self) -> Tensor:
        """Flat indices of the cells that no photo saw."""
        return self.cells[self.before < -_BEHIND]

    @property
    def dark(self) -> OccupancySampler:
        """Looks into the hidden cells alone."""
        grid = torch.zeros_like(self.sampler.grid)
        grid.view(-1)[self.hidden] = 1
        return replace(self.sampler, grid=grid, fine=None)

    @property
    def possible(self) -> OccupancySampler:
        """Looks wherever something may be, for all that is known: not into empty cells that were looked through."""
        grid = torch.ones_like(self.sampler.grid)
        seen = self.cells[self.through > _BEFORE]
        grid.view(-1)[seen] = self.sampler.grid.reshape(-1)[seen]
        return replace(self.sampler, grid=grid, fine=None)


def sight_of(field: Field, frames: Sequence[Frame], boxes: Sequence[Tensor]) -> Sight:
    """What old photos saw in world boxes (2, 3)."""
    s = field.sampler
    cells = torch.cat([s.cells_in(b) for b in boxes]).unique()
    x = s.points_in(cells, jitter=False)
    side = s.width(s.distance(cells))
    before, through = (torch.full((len(cells),), -torch.inf) for _ in range(2))
    for frame in frames[:: -(-len(frames) // _EYES) or 1]:
        camera = frame.camera.shrunk(min(_SIDE / max(frame.camera.width, frame.camera.height), 1.0))
        pose = frame.world_from_cam
        uv, z = camera.project((x - pose[:3, 3].float()) @ pose[:3, :3].float())
        rows = camera.shows(uv, z).nonzero()[:, 0]
        if len(rows) == 0:
            continue
        j, i = uv[rows].long().unbind(-1)
        seen = render_camera(field, camera, pose)
        nearest, farthest = depths_around(seen.surface(0.5))  # nothing is in the way of nothing
        away = (x[rows] - frame.centre.float()).norm(dim=-1)
        for most, depth in ((before, farthest), (through, nearest)):
            most[rows] = torch.maximum(most[rows], (depth[i, j] - away) / side[rows])
    return Sight(s, cells, before, through)


def nothing_seen(field: Field) -> Sight:
    """Nothing is known of what photos saw: nothing is hidden, and something may be anywhere."""
    return Sight(field.sampler, torch.zeros(0, dtype=torch.long), torch.zeros(0), torch.zeros(0))
