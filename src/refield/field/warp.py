"""Look a moved object up where it used to be (Eqs. 3, 16).

A field that was fitted before the move still holds the object, at its old place. A sample at the new place therefore
asks at ``old_from_new @ x``, along the direction turned back by the same rotation. Everything is in the world frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from refield.scene.capture import Rays
from refield.scene.change import OccupancyGrid, SceneChange
from refield.scene.inside import in_boxes
from refield.scene.pose import invert, rotate, transform


@dataclass(frozen=True)
class Move:
    """One rigid motion of what a grid holds."""

    grid: OccupancyGrid
    """M: where the object was"""
    new_from_old: Tensor
    """(4, 4) float64, the paper's T"""

    @cached_property
    def old_from_new(self) -> Tensor:
        """T⁻¹, (4, 4) float64."""
        return invert(self.new_from_old)

    @cached_property
    def box_now(self) -> Tensor:
        """(2, 3) float32, a world box around M at its new place."""
        corners = transform(self.new_from_old, torch.cartesian_prod(*outline(self.grid).T.double()))
        return torch.stack([corners.amin(0), corners.amax(0)]).float()

    def arrived(self, x: Tensor) -> Tensor:
        """M(T⁻¹ x): world points (..., 3) -> (...,) bool, whether the object is there now."""
        flat = x.detach().reshape(-1, 3)
        found = torch.zeros(len(flat), dtype=torch.bool, device=x.device)
        near = inside_box(flat, self.box_now).nonzero()[:, 0]
        if len(near):
            found[near] = self.grid.contains(transform(self.old_from_new, flat[near]))
        return found.reshape(x.shape[:-1])


def moves_of(change: SceneChange) -> tuple[Move, ...]:
    """The motions of a change, in the order of its objects."""
    return tuple(Move(o.grid, o.new_from_old) for o in change.objects if o.new_from_old is not None)


def move_in(x: Tensor, d: Tensor, moves: tuple[Move, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Eq. 3 for any number of objects; where two claim a point, the first has it.

    World points and directions (S, 3) -> where and along what to ask, (S, 3) each, and which move did it, (S,)
    int64, -1 where nothing moved in. Differentiable in x, d and ``new_from_old``.
    """
    owner = owners(x, moves)
    return *looked_up(x, d, owner, [m.old_from_new for m in moves]), owner


def owners(x: Tensor, moves: tuple[Move, ...]) -> Tensor:
    """The first move that brought something to each world point (S, 3), (S,) int64; -1 where none did."""
    owner = torch.full(x.shape[:1], -1, dtype=torch.long, device=x.device)
    for i, move in enumerate(moves):
        owner[move.arrived(x) & (owner < 0)] = i
    return owner


def two_way(x: Tensor, d: Tensor, moves: tuple[Move, ...]) -> tuple[Tensor, Tensor]:
    """Eq. 16 for any number of objects: a new place asks at the old one, and an old place at the new one (§10.1.2).

    Move-in wins, and of two objects the first. World points and directions (S, 3) -> (S, 3), (S, 3). Its own inverse
    where no places overlap.
    """
    x, d, came = move_in(x, d, moves)
    left = torch.full_like(came, -1)
    for i, move in enumerate(moves):
        left[move.grid.contains(x) & (came < 0) & (left < 0)] = i
    return looked_up(x, d, left, [m.new_from_old for m in moves])


def looked_up(x: Tensor, d: Tensor, owner: Tensor, poses: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Points and directions (S, 3) of each owner moved by its pose; the others are left as they are."""
    for i, pose in enumerate(poses):
        mine = (owner == i).nonzero()[:, 0]
        if len(mine):
            x = x.index_copy(0, mine, transform(pose, x[mine]))
            d = d.index_copy(0, mine, rotate(pose, d[mine]))
    return x, d


def outline(grid: OccupancyGrid) -> Tensor:
    """(2, 3) float32, a world box that holds every point the grid contains: its occupied nodes and one cell more."""
    box = grid.tight_aabb()
    half_cell = (grid.aabb[1] - grid.aabb[0]) / (torch.tensor(grid.values.shape) - 1) / 2
    return torch.stack([box[0] - half_cell, box[1] + half_cell])


def inside_box(x: Tensor, box: Tensor) -> Tensor:
    """World points (..., 3), world box (2, 3) -> (...,) bool."""
    return in_boxes(x.reshape(-1, 3), box[None]).reshape(x.shape[:-1])


def crosses(rays: Rays, boxes: Iterable[Tensor]) -> Tensor:
    """Whether each of N rays crosses any of some world boxes (2, 3), (N,) bool."""
    out = torch.zeros(len(rays), dtype=torch.bool, device=rays.origins.device)
    for box in boxes:
        enter, leave = crossing(rays, box)
        out |= leave > enter
    return out


def crossing(rays: Rays, box: Tensor) -> tuple[Tensor, Tensor]:
    """Distances (N,) at which rays enter and leave a world box (2, 3); a ray misses it if it does not enter first."""
    inverse = 1 / torch.where(rays.directions.abs() < 1e-9, 1e-9, rays.directions)
    a, b = (box[0] - rays.origins) * inverse, (box[1] - rays.origins) * inverse
    return torch.minimum(a, b).amax(-1).clamp_min(0), torch.maximum(a, b).amin(-1)


def leaving(rays: Rays, box: Tensor) -> Tensor:
    """Distance at which each ray leaves a world box, (N,); 0 if it does not meet it."""
    enter, leave = crossing(rays, box)
    return torch.where(leave > enter, leave, 0.0)
