"""A regular lattice of voxels over a box of the world, and components on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from refield.estimate.carve_kernels import find_held, spread
from refield.estimate.look import Array
from refield.scene.change import OccupancyGrid

Voxels = NDArray[np.bool_]
EVERY_WAY = np.ones((3, 3, 3), bool)


@dataclass(frozen=True)
class Lattice:
    """Voxel (i, j, k) has its centre at ``low + (i, j, k) * cell``; world units."""

    low: Array
    """(3,) centre of the first voxel"""
    cell: float
    shape: tuple[int, int, int]

    @staticmethod
    def over(low: Array, high: Array, longest: int, cell_floor: float = 0.0) -> Lattice:
        """Cubic voxels over a box, ``longest`` of them along its longest side, none smaller than ``cell_floor``."""
        extent = np.maximum(high - low, 1e-6)
        cell = max(float(extent.max()) / longest, cell_floor)
        n = np.ceil(extent / cell).astype(int) + 1
        start = (low + high) / 2 - (n - 1) * cell / 2
        return Lattice(start.astype(np.float32), cell, (int(n[0]), int(n[1]), int(n[2])))

    @cached_property
    def centres(self) -> Array:
        """(X, Y, Z, 3) float32."""
        axes = [self.low[a] + self.cell * np.arange(self.shape[a]) for a in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)

    def index(self, points: Array) -> tuple[Array, Array]:
        """Voxel of each point (N, 3) -> (N, 3), and whether it lies in the lattice."""
        with np.errstate(invalid="ignore"):
            ijk = np.nan_to_num(np.round((points - self.low) / self.cell), nan=-1, posinf=-1, neginf=-1)
        ijk = np.clip(ijk, -1, max(self.shape)).astype(np.int64)
        inside = np.all((ijk >= 0) & (ijk < np.array(self.shape)), axis=-1)
        return np.where(inside[..., None], ijk, 0), inside

    def holds(self, voxels: Voxels, points: Array) -> NDArray[np.bool_]:
        """Whether each point (..., 3) lies in one of the voxels."""
        out = np.zeros(points.shape[:-1], bool)
        rows = np.ascontiguousarray(points.reshape(-1, 3), np.float32)
        find_held(rows, np.ascontiguousarray(voxels, bool), self.low, self.cell, out.reshape(-1))
        return out

    def grid(self, values: Array) -> OccupancyGrid:
        """Values on this lattice as an occupancy grid (nodes at the voxels' centres)."""
        high = self.low + self.cell * (np.array(self.shape) - 1)
        aabb = torch.from_numpy(np.stack([self.low, high]).astype(np.float32))
        return OccupancyGrid(aabb, torch.from_numpy(np.ascontiguousarray(values, np.float32)))


@dataclass(frozen=True)
class Body:
    """Voxels of a lattice of their own."""

    lattice: Lattice
    voxels: Voxels

    @cached_property
    def places(self) -> Array:
        """(K, 3) the voxels' centres"""
        return self.lattice.centres[self.voxels]

    @property
    def volume(self) -> float:
        return int(self.voxels.sum()) * self.lattice.cell**3


def components(voxels: Voxels, smallest: int) -> list[Voxels]:
    """Connected parts (26 neighbours) of at least ``smallest`` voxels, the largest first."""
    labels, count = ndimage.label(voxels, EVERY_WAY)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    order = [int(k) for k in np.argsort(-sizes) if sizes[k] >= smallest]
    return [labels == k for k in order]


def some_of(voxels: Voxels, which: NDArray[np.bool_]) -> Voxels:
    """Those of the voxels that are named, in the order of ``voxels.nonzero()``, (K,)."""
    out = voxels.copy()
    out[voxels] = which
    return out


def grown(voxels: Voxels, steps: int, within: Voxels | None = None) -> Voxels:
    """Dilated by ``steps`` in every direction, staying ``within``; steps < 0 grow until nothing is left to reach."""
    if steps == 0:
        return voxels
    if steps < 0:
        labels, count = ndimage.label(voxels | (True if within is None else within), EVERY_WAY)
        reached = np.zeros(count + 1, bool)
        reached[labels[voxels]] = True
        return reached[labels]
    if within is None:
        return _spread(voxels, steps)
    for _ in range(steps):
        voxels = voxels | (_spread(voxels, 1) & within)
    return voxels


def _spread(voxels: Voxels, steps: int) -> Voxels:
    out = np.zeros(voxels.shape, bool)
    spread(np.ascontiguousarray(voxels, bool), steps, out)
    return out
