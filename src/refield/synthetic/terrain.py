"""Ground that is not flat: slopes, bowls, hills."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.synthetic.shapes import Mesh
from refield.synthetic.solids import Point, as_mesh, slabs, traced

Wave = tuple[float, float, float, float]
"""Angular frequency along x and along y (1/m), phase, height (m)"""
_NODES = 121  # a side of the mesh
_BELOW = 0.2  # metres of ground under its lowest place


@dataclass(frozen=True)
class Terrain:
    """Solid ground under a height z = f(x, y) on a square; f(0, 0) need not be 0. The atlas is its map, y up."""

    side: float
    """half the square's"""
    slope: tuple[float, float] = (0.0, 0.0)
    bowl: tuple[float, float] = (0.0, 1.0)
    """how deep it is in the middle, and how wide (of the Gaussian); negative = a hill"""
    waves: tuple[Wave, ...] = ()

    @property
    def highest(self) -> float:
        """What no place is higher than, nor deeper."""
        return self.side * sum(map(abs, self.slope)) + abs(self.bowl[0]) + sum(abs(w[3]) for w in self.waves)

    @property
    def half(self) -> Point:
        return (self.side, self.side, self.highest + _BELOW)

    def height(self, x: Tensor, y: Tensor) -> Tensor:
        """f, any shape."""
        depth, width = self.bowl
        z = self.slope[0] * x + self.slope[1] * y
        if depth != 0:
            z = z - depth * torch.exp(-(x * x + y * y) / (2 * width * width))
        for p, q, phase, high in self.waves:
            z = z + high * torch.sin(p * x + q * y + phase)
        return z

    def normal(self, x: float, y: float) -> NDArray[np.float64]:
        """(3,) upwards, unit."""
        at = torch.tensor([x, y], dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(self.height(at[0], at[1]), at)
        up = np.array([-float(slope[0]), -float(slope[1]), 1.0])
        return up / np.linalg.norm(up)

    @property
    def _steepest(self) -> float:
        depth, width = self.bowl
        waves = sum(abs(high) * float(np.hypot(p, q)) for p, q, _, high in self.waves)
        return float(np.hypot(*self.slope)) + abs(depth) / width * float(np.exp(-0.5)) + waves

    def distance(self, x: Tensor) -> Tensor:
        """Signed; too small by at most the steepest slope's part, never too large."""
        above = (x[..., 2] - self.height(x[..., 0], x[..., 1])) / (1 + self._steepest**2) ** 0.5
        beside = x[..., :2].abs().amax(-1) - self.side
        return torch.maximum(torch.maximum(above, beside), -self.half[2] - x[..., 2])

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        near, far = slabs(origins, directions, origins.new_tensor(self.half))
        t = traced(self.distance, (origins, directions), near, far)
        return torch.where(t > 0, t, torch.inf)

    def uv(self, x: Tensor) -> Tensor:
        unit = (x[..., :2] / self.side).clamp(-1, 1)
        return torch.stack([0.5 + 0.5 * unit[..., 0], 0.5 - 0.5 * unit[..., 1]], -1)

    def mesh(self) -> Mesh:
        line = torch.linspace(-self.side, self.side, _NODES, dtype=torch.float64)
        x, y = torch.meshgrid(line, line, indexing="ij")
        top = torch.stack([x, y, self.height(x, y)], -1).reshape(-1, 3).numpy()
        i = np.arange((_NODES - 1) * _NODES).reshape(_NODES - 1, _NODES)[:, :-1].ravel()
        upper = _triangles(np.stack([i, i + _NODES, i + _NODES + 1, i + 1], -1))
        n = np.arange(_NODES)
        last = _NODES * (_NODES - 1)
        rim = np.concatenate([n * _NODES, last + n[1:], (n[:-1] * _NODES + _NODES - 1)[::-1], n[1:-1][::-1]])
        foot = top[rim] * np.array([1, 1, 0]) - np.array([0, 0, self.half[2]])
        k, low = np.arange(len(rim)), len(top)
        after = (k + 1) % len(rim)
        walls = _triangles(np.stack([rim, low + k, low + after, rim[after]], -1))
        bottom = np.stack([np.full(len(rim) - 2, low), low + k[2:], low + k[1:-1]], -1)
        vertices = np.concatenate([top, foot])
        return as_mesh(vertices, self.uv(torch.from_numpy(vertices)).numpy(), np.concatenate([upper, walls, bottom]))


def _triangles(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
