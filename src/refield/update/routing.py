"""Who answers for a point of an updated field, and where and along what it is asked (Eqs. 3, 5).

An object that moved in, else the helper inside its region, else an earlier state that knows what is there
(`refield.update.recall`), else the old field.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from refield.field.outlook import Outlook
from refield.field.source import Source
from refield.field.warp import Move, looked_up, owners
from refield.scene.inside import in_boxes
from refield.scene.pose import transform
from refield.update.learnt import NOWHERE
from refield.update.region import carved, grown
from refield.update.textured import TexturedPlane

if TYPE_CHECKING:
    from refield.update.composite import UpdatedField

SKIN = 1.5
"""How much further than its grid a moved object reaches, in samples of the old field"""
_SKIN_VACATED = 1.0  # the same where something left that was solid
_SOLID = 0.05  # opacity of a sample that was not empty before
_LAYER = 10  # nodes of a grid that make a layer


@dataclass(frozen=True)
class Sourced:
    """Points that an object's source answers for."""

    source: Source
    rows: Tensor
    """(K,) int64"""
    x: Tensor
    """(K, 3) where the source has them"""


@dataclass(frozen=True)
class Routed:
    """Who answers for S points."""

    asked: Tensor
    """(S, 3) world: where the old field is asked"""
    turned: Tensor
    """(S, 3) unit: along what"""
    owner: Tensor
    """(S,) int64: the move that brought what is there; -1 for none"""
    old: Tensor
    """rows, int64, that the old field answers for"""
    helper: Tensor
    """rows of the helper; of nobody where there is none"""
    ground: Tensor
    """rows of the earlier state that knows the place"""
    sourced: tuple[Sourced, ...]
    """what moved before, and is looked up where it first was"""
    planes: tuple[tuple[TexturedPlane, Tensor], ...]
    """planes whose texture is known, each with its rows"""

    @property
    def textured(self) -> Tensor:
        """rows of all planes"""
        return torch.cat([self.helper[:0], *(rows for _, rows in self.planes)])


class Routing:
    """Of one update."""

    def __init__(self, field: UpdatedField) -> None:
        """``field`` knows its moves and their sources by then, and its region."""
        self.pretrained, self.moves, self.sources = field.pretrained, field.moves, field.sources
        self.region, self.bare, self.places = field.region, field.bare, field.earlier.places
        self.untaught, change, eyes = field.untaught, field.change, field.eyes
        self.step = self.pretrained.sampler.step
        self._was = carved(change, SKIN * self.step) if self.untaught.grids else NOWHERE
        self.shells, self._inner_shells = (
            tuple(Move(grown(m.grid, skin * self.step), m.new_from_old) for m in self.moves)
            for skin in (SKIN, _SKIN_VACATED)
        )
        self._ups = tuple(self._up_of(move, shell) for move, shell in zip(self.moves, self.shells))
        self.outlooks = tuple(None if eyes is None else Outlook.from_eyes(eyes, m.grid) for m in self.moves)
        self.boxes = tuple(m.box_now for m in self.shells) + self.region.boxes + self.places.boxes
        """(2, 3) each, world: outside of them the old field answers"""

    def of(self, x: Tensor, d: Tensor | None = None) -> Routed:
        """Who answers for world points (S, 3) and directions (S, 3); which, where only densities are asked for, may be
        left out."""
        held, d = d is not None, torch.zeros_like(x) if d is None else d
        owner = torch.full(x.shape[:1], -1, dtype=torch.long, device=x.device)
        near = self._near(x.detach()).nonzero()[:, 0]
        if len(near) == 0:
            return Routed(x, d, owner, torch.arange(len(x), device=x.device), near, near, (), ())
        mover = self.arrived(x[near])
        owner[near] = mover
        free = mover < 0
        if self.untaught.grids:
            free &= ~self.untaught.contains(x[near]) | self._was.contains(x[near])
        planes, textured = [], torch.zeros_like(free)
        for plane in self.region.planes:
            mine = free & ~textured & plane.contains(x[near])
            planes.append((plane, near[mine]))
            textured |= mine
        helped = free & ~textured & self.region.contains(x[near])
        grounded = (mover < 0) & ~textured & ~helped & self.places.contains(x[near])
        at, along = looked_up(x[near], d[near], mover, [m.old_from_new for m in self.moves])
        sourced = []
        for i, (outlook, source) in enumerate(zip(self.outlooks, self.sources)):
            mine = (mover == i).nonzero()[:, 0]
            if source is not None:
                then = transform(source.then_from_now, at[mine])
                held_there = source.grid.contains(then)
                sourced.append(Sourced(source, near[mine[held_there]], then[held_there]))
                mine = mine[~held_there]
            if held and outlook is not None:
                along = along.index_copy(0, mine, outlook.held(at[mine], along[mine]))
        asked, turned = x.index_copy(0, near, at), d.index_copy(0, near, along)
        old = torch.ones(len(x), dtype=torch.bool, device=x.device)
        old[near] = ~(helped | grounded | textured)
        for found in sourced:
            old[found.rows] = False
        return Routed(
            asked, turned, owner, old.nonzero()[:, 0], near[helped], near[grounded], tuple(sourced), tuple(planes)
        )

    def arrived(self, x: Tensor) -> Tensor:
        """Which move each world point (S, 3) is answered by, (S,) int64, -1 for none.

        A fitted surface is a step or so thick: the moved object takes its skin along, to places that were empty and
        are nobody else's; less of it to where something left, since ground is being learnt there. What was solid
        stays (the ground beside it), but for what is right beneath it: a ray that enters the object above its lower
        edge takes its first sample there.
        """
        owner = owners(x, self.moves)
        skin = torch.where(owner < 0, owners(x, self.shells), -1)
        rows = (skin >= 0).nonzero()[:, 0]
        if len(rows):
            at = x[rows].detach()
            free = ~self._was_solid(at) | (self._vacated(at) & (owners(at, self._inner_shells) >= 0))
            for i, (move, up) in enumerate(zip(self.moves, self._ups)):
                if up is not None:
                    free |= (skin[rows] == i) & move.arrived(at + up)
            owner[rows[free]] = skin[rows[free]]
        return torch.where(self.bare.contains(x), -1, owner) if self.bare.grids else owner

    def _was_solid(self, x: Tensor) -> Tensor:
        """Whether something was at world points (S, 3) before, (S,) bool."""
        return self.pretrained.density(x) * self.step > _SOLID

    def _vacated(self, x: Tensor) -> Tensor:
        """Whether world points (S, 3) are around where something left, now or at an earlier visit, (S,) bool."""
        return self.region.contains(x) | self.places.contains(x)

    def _up_of(self, move: Move, shell: Move) -> Tensor | None:
        """(3,) world: a sample's length away from what a moved object stands on now; None if on nothing.

        What is solid in its skin is a layer of that: the normal is the direction in which it is thinnest.
        """
        skin = shell.grid.nodes().reshape(-1, 3)
        skin = skin[shell.grid.contains(skin) & ~move.grid.contains(skin)]
        at = transform(move.new_from_old, skin)
        with torch.no_grad():
            touched = at[self._was_solid(at) & ~self._vacated(at)].double()
        if len(touched) < _LAYER:
            return None
        normal = torch.linalg.eigh(torch.cov(touched.T)).eigenvectors[:, 0]
        middle = transform(move.new_from_old, move.grid.occupied().double().mean(0)[None])[0]
        side = torch.sign(normal @ (middle - touched.mean(0)))
        return (side * self.step * normal).float()

    def _near(self, x: Tensor) -> Tensor:
        return in_boxes(x, torch.stack(self.boxes)) if self.boxes else torch.zeros_like(x[:, 0], dtype=torch.bool)
