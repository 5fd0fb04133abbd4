"""Cells of the sampler's grid in which an updated field says anything, at its own visit or at one before."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from refield.field.radiance import Field
from refield.field.sampling import OccupancySampler
from refield.scene.pose import transform
from refield.update.routing import Routing


@dataclass(frozen=True)
class Cells:
    """Each (R, R, R) uint8, but for ``empty``."""

    own: Tensor
    """whose centre is answered for by a move, a helper or nobody, at this visit"""
    own_small: Tensor
    """that hold some of what this visit says, be it so small that their centres lie beside it"""
    told: Tensor
    """as ``own``, at this visit or before"""
    small: Tensor
    """as ``own_small``, at this visit or before"""
    empty: Tensor
    """flat indices of those in which the state that knows an earlier place shows nothing"""

    @cached_property
    def said(self) -> Tensor:
        """In which this visit says anything."""
        return _widened(self.own) | self.own_small

    @cached_property
    def retold(self) -> Tensor:
        """In which any visit does."""
        return _widened(self.told) | self.small


def cells_of(routing: Routing, ground: Field | None, sampler: OccupancySampler, before: Cells | None) -> Cells:
    """The cells of an update; ``ground`` shows earlier places without the objects that left them, ``before`` are those
    of the update before."""
    (own, empty), small = _told(routing, ground, sampler), _small(routing, sampler)
    if before is None:
        return Cells(own, small, own, small, empty)
    return Cells(own, small, own | before.told, small | before.small, empty)


def _told(routing: Routing, ground: Field | None, sampler: OccupancySampler) -> tuple[Tensor, Tensor]:
    """(R, R, R) uint8: cells whose centre is answered for by a move, a helper or nobody, at this visit. And those
    (flat indices) in which the state that knows an earlier place shows nothing."""
    empty = [sampler.grid.new_zeros(0, dtype=torch.long)]
    grid = torch.zeros_like(sampler.grid)
    for box in routing.boxes:
        cells = sampler.cells_in(box)
        x = sampler.points_in(cells, jitter=False)
        to = routing.of(x)
        told = to.owner >= 0
        for rows in (to.helper, to.ground, to.textured):
            told[rows] = True
        grid.view(-1)[cells[told]] = 1
        if ground is not None:
            empty.append(cells[to.ground[~ground.sampler.occupied(x[to.ground])]])
    return grid, torch.cat(empty).unique()


def _small(routing: Routing, sampler: OccupancySampler) -> Tensor:
    """(R, R, R) uint8: cells that hold some of what this visit says, be it so small that their centres lie beside
    it."""
    x = [transform(move.new_from_old, move.grid.occupied()) for move in routing.shells]
    x += [grid.occupied() for grid in (*routing.region.grids, *routing.places.grids)]
    x += [plane.nodes[plane.known.reshape(-1)] for plane in routing.region.planes]
    grid = torch.zeros_like(sampler.grid)
    grid.view(-1)[sampler.cells(torch.cat(x)) if x else []] = 1
    return grid


def _widened(cells: Tensor) -> Tensor:
    """Cells (R, R, R) uint8 and those beside them: one whose centre is outside may hold a corner that is inside."""
    return functional.max_pool3d(cells[None, None].float(), 3, 1, 1)[0, 0].to(torch.uint8)
