"""From where an object was photographed: its colours are asked only along directions that showed them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn import functional

from refield.field.kernels.cpu.simd import JIT
from refield.field.warp import outline
from refield.scene.change import OccupancyGrid

_Array = NDArray[Any]
_FRONTAL = 0.3  # cosine between a side's normal and the way to a camera from which on its photo shows the side well


@dataclass(frozen=True)
class Outlook:
    """The directions along which each side of an object was looked at when its field was fitted."""

    directions: Tensor
    """(C, 3) unit, from the cameras to the object"""
    reach: float
    """Radians around each of them within which the field may be asked"""
    aabb: Tensor
    """(2, 3) world box of the normals"""
    normals: Tensor
    """(X, Y, Z, 3) unit, outwards, at the nodes of a lattice; zero away from the surface"""

    @staticmethod
    def from_eyes(eyes: Tensor, grid: OccupancyGrid) -> Outlook:
        """Camera centres (C, 3), the object's grid. The reach is half the cameras' usual spacing."""
        d = functional.normalize(outline(grid).mean(0) - eyes, dim=-1)
        nearest = (d @ d.T).fill_diagonal_(-1).amax(-1).clamp(-1, 1).acos()
        reach = 0.5 * float(nearest.median()) if len(d) > 1 else 0.0
        smooth = gaussian_filter(grid.values.double().numpy(), 2.0)
        slope = torch.from_numpy(np.stack(np.gradient(smooth), -1)).float()
        return Outlook(d, reach, grid.aabb, -functional.normalize(slope, dim=-1))

    def held(self, x: Tensor, d: Tensor) -> Tensor:
        """Directions (S, 3) at points of the object at its old place (S, 3), those out of reach replaced by the
        nearest within it.

        What a fitted colour says along directions that no photo looked along is accidental: a tipped object is asked
        from below, where nobody was, a turned one's side from where nobody saw that side.
        """
        cosine, nearest = self.nearest(x.detach(), d.detach())
        out = (cosine < math.cos(self.reach)).nonzero()[:, 0]
        if len(out) == 0:
            return d
        axis = self.directions[nearest[out]]
        across = functional.normalize(d[out] - (d[out] * axis).sum(-1, keepdim=True) * axis, dim=-1)
        return d.index_copy(0, out, math.cos(self.reach) * axis + math.sin(self.reach) * across)

    def nearest(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Cosine of the angle to the nearest of the directions that show the side a point (S, 3) is on, and which it
        is; of all directions where none shows that side. (S,), (S,) int64."""
        if x.device.type != "cpu":
            return self.nearest_plainly(x, d)
        cosine, index = torch.empty(len(x)), torch.empty(len(x), dtype=torch.long)
        box, ways, normals = self.aabb.numpy(), self.directions.numpy(), self.normals.numpy()
        _find_nearest(x.float().numpy(), d.float().numpy(), box, normals, ways, cosine.numpy(), index.numpy())
        return cosine, index

    def nearest_plainly(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """`nearest`, in torch."""
        cosine = d @ self.directions.T
        frontal = -self._normal(x) @ self.directions.T > _FRONTAL
        frontal |= ~frontal.any(-1, keepdim=True)
        found = torch.where(frontal, cosine, -2.0).max(-1)
        return found.values, found.indices

    def _normal(self, x: Tensor) -> Tensor:
        """The normal at the node nearest to each point, (S, 3)."""
        size = torch.tensor(self.normals.shape[:3])
        at = ((x - self.aabb[0]) / (self.aabb[1] - self.aabb[0]) * (size - 1)).round().long()
        i, j, k = at.clamp_min(0).minimum(size - 1).unbind(-1)
        return self.normals[i, j, k]


@njit(**JIT)
def _node(x: float, ends: _Array, count: int) -> int:
    at = np.rint((x - ends[0]) / (ends[1] - ends[0]) * (count - 1))
    return int(min(max(at, 0), count - 1))


@njit(parallel=True, **JIT)
def _find_nearest(
    x: _Array, d: _Array, box: _Array, normals: _Array, ways: _Array, cosine: _Array, index: _Array
) -> None:
    nx, ny, nz = normals.shape[:3]
    for s in prange(len(x)):
        i, j, k = _node(x[s, 0], box[:, 0], nx), _node(x[s, 1], box[:, 1], ny), _node(x[s, 2], box[:, 2], nz)
        n = normals[i, j, k]
        best, which, any_best, any_which = -2.0, -1, -2.0, 0
        for w in range(len(ways)):
            along = d[s, 0] * ways[w, 0] + d[s, 1] * ways[w, 1] + d[s, 2] * ways[w, 2]
            if along > any_best:
                any_best, any_which = along, w
            if along > best and -(n[0] * ways[w, 0] + n[1] * ways[w, 1] + n[2] * ways[w, 2]) > _FRONTAL:
                best, which = along, w
        cosine[s], index[s] = (best, which) if which >= 0 else (any_best, any_which)
