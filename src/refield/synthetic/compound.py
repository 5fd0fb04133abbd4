"""Solids put together from others: chairs, letters, open boxes, tubes, plants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.synthetic.shapes import Mesh, Solid
from refield.synthetic.solids import Point, as_mesh

Turn = tuple[Point, Point, Point]
"""Rows of a rotation; tuples, so that equal solids compare equal"""
UPRIGHT: Turn = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Part:
    """A solid at its place in another."""

    solid: Solid
    at: Point
    """of its middle"""
    turn: Turn = UPRIGHT
    """whole_from_part"""
    cell: int = 0
    """of the whole's atlas; parts may share one"""

    @cached_property
    def _rotation(self) -> Tensor:
        return torch.tensor(self.turn, dtype=torch.float64)

    @cached_property
    def reach(self) -> float:
        """Radius of a ball about its middle that holds it."""
        return float(np.linalg.norm(self.solid.half))

    def inward(self, x: Tensor) -> Tensor:
        """Points (..., 3) of the whole in the part's axes."""
        return (x - x.new_tensor(self.at)) @ self._rotation.to(x.dtype)

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        return self.solid.hit(self.inward(origins), directions @ self._rotation.to(directions.dtype))

    def placed(self) -> tuple[NDArray[np.float64], Mesh]:
        """Its mesh, and the vertices (V, 3) in the whole's axes."""
        mesh = self.solid.mesh()
        return mesh[0].astype(float) @ np.array(self.turn).T + np.array(self.at), mesh


@dataclass(frozen=True)
class Compound:
    """The union of its parts.

    Each has a cell of the atlas. The distance is exact outside; inside, where parts meet, it is too shallow.
    """

    parts: tuple[Part, ...]
    cells: tuple[int, int]
    """Rows and columns of the atlas"""

    @staticmethod
    def of(parts: Sequence[Part], *, shared: bool = False) -> Compound:
        """Shifted so that the middle of its box is the origin; each part in a cell of its own unless ``shared``."""
        vertices = np.concatenate([part.placed()[0] for part in parts])
        middle = (vertices.min(0) + vertices.max(0)) / 2
        moved = [replace(part, at=_shifted(part.at, middle)) for part in parts]
        if not shared:
            moved = [replace(part, cell=i) for i, part in enumerate(moved)]
        count = 1 + max(part.cell for part in moved)
        columns = int(np.ceil(np.sqrt(count)))
        return Compound(tuple(moved), (int(np.ceil(count / columns)), columns))

    @cached_property
    def half(self) -> Point:
        x, y, z = np.abs(np.concatenate([part.placed()[0] for part in self.parts])).max(0).tolist()
        return (x, y, z)

    def _distances(self, x: Tensor) -> Tensor:
        return torch.stack([part.solid.distance(part.inward(x)) for part in self.parts])

    def distance(self, x: Tensor) -> Tensor:
        return self._distances(x).amin(0)

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        out = torch.full_like(origins[:, 0], torch.inf)
        near = _passing(origins, directions, (0.0, 0.0, 0.0), float(np.linalg.norm(self.half))).nonzero()[:, 0]
        o, d = origins[near], directions[near]
        for part in self.parts:
            some = _passing(o, d, part.at, part.reach).nonzero()[:, 0]
            if len(some):
                index = near[some]
                out[index] = torch.minimum(out[index], part.hit(o[some], d[some]))
        return out

    def uv(self, x: Tensor) -> Tensor:
        own = torch.stack([self._in_cell(part, part.solid.uv(part.inward(x))) for part in self.parts])
        nearest = self._distances(x).abs().argmin(0)
        return own.gather(0, nearest[None, ..., None].expand(1, *x.shape[:-1], 2))[0]

    def _in_cell(self, part: Part, uv: Tensor) -> Tensor:
        rows, columns = self.cells
        row, column = divmod(part.cell, columns)
        return (uv + uv.new_tensor([column, row])) / uv.new_tensor([columns, rows])

    def mesh(self) -> Mesh:
        vertices, uv, faces, start = [], [], [], 0
        for part in self.parts:
            placed, (_, own, triangles) = part.placed()
            vertices.append(placed)
            uv.append(self._in_cell(part, torch.from_numpy(own).double()).numpy())
            faces.append(triangles.astype(np.int64) + start)
            start += len(placed)
        return as_mesh(np.concatenate(vertices), np.concatenate(uv), np.concatenate(faces))


def _shifted(at: Point, by: NDArray[np.float64]) -> Point:
    return (at[0] - float(by[0]), at[1] - float(by[1]), at[2] - float(by[2]))


def _passing(origins: Tensor, directions: Tensor, middle: Point, radius: float) -> Tensor:
    """Which rays (N,) pass a ball: unit directions."""
    to = origins.new_tensor(middle) - origins
    along = (to * directions).sum(-1)
    return (to.square().sum(-1) - along.square() <= (radius * (1 + 1e-6)) ** 2) & (along > -radius)
