"""The updated field: the old one, looked up where things were, and a helper where they no longer are (Eqs. 4, 5).

Who answers for a point: an object that moved in (Eq. 3), else the helper inside its region, else the old field in
the new light. Without a helper the old objects are cut out: nothing is left inside them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.sampling import OccupancySampler
from refield.field.warp import Move, inside_box, move_in, moves_of
from refield.scene.change import SceneChange
from refield.update.light import Relighting
from refield.update.region import Region, carved, move_out

DILATION = 2.0
"""M_out is the object's grid, its box this many times as large (§10.1.3: 2 to 3)."""

_PROBES = 8  # points a cell looked up when the sampler is recomputed: a moved surface crosses cells at any angle


class UpdatedField:
    """A Field of the scene after a change. The old field and the change are shared, not copied."""

    def __init__(
        self,
        pretrained: Field,
        change: SceneChange,
        helper: Field | None = None,
        *,
        region: Region | None = None,
        light: Relighting | None = None,
        sampler: OccupancySampler | None = None,
    ) -> None:
        """``region`` is where the helper speaks (M_out of the change by default); with no helper it is cut out
        (the objects' own grids by default). ``sampler`` is recomputed where things changed unless it is given."""
        self.pretrained, self.change, self.helper, self.light = pretrained, change, helper, light
        if region is None:
            region = carved(change) if helper is None else move_out(change, DILATION)
        self.region = region
        self.moves: tuple[Move, ...] = moves_of(change)
        self.boxes = tuple(m.box_now for m in self.moves) + region.boxes
        if sampler is None:
            sampler = pretrained.sampler.refreshed(self.density, self.boxes, probes=_PROBES)
        self.sampler = sampler

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        flat = x.reshape(-1, 3)
        asked, _, _, old, new = self._route(flat, torch.zeros_like(flat))
        sigma = flat.new_zeros(len(flat)).index_copy(0, old, self.pretrained.density(asked[old]))
        if self.helper is not None and len(new):
            sigma = sigma.index_copy(0, new, self.helper.density(flat[new]))
        return sigma.reshape(x.shape[:-1])

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3) and unit directions (..., 3) -> sigma (...,) and rgb (..., 3) in [0, 1] (Eq. 5)."""
        flat, along = x.reshape(-1, 3), d.reshape(-1, 3)
        asked, turned, owner, old, new = self._route(flat, along)
        s, c = self.pretrained(asked[old], turned[old])
        if self.light is not None:
            c = self._relit(flat[old], c, owner[old] < 0)
        sigma = flat.new_zeros(len(flat)).index_copy(0, old, s)
        rgb = torch.zeros_like(flat).index_copy(0, old, c)
        if self.helper is not None and len(new):
            s, c = self.helper(flat[new], along[new])
            sigma, rgb = sigma.index_copy(0, new, s), rgb.index_copy(0, new, c)
        return sigma.reshape(x.shape[:-1]), rgb.reshape(x.shape)

    def _route(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Where and along what to ask (S, 3), which move did it (S,), and the rows that the old field and the
        helper answer for; rows in neither are empty space."""
        owner = torch.full(x.shape[:1], -1, dtype=torch.long, device=x.device)
        inside = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        near = self._near(x.detach()).nonzero()[:, 0]
        if len(near) == 0:
            return x, d, owner, torch.arange(len(x), device=x.device), near
        at, along, mover = move_in(x[near], d[near], self.moves)
        owner[near] = mover
        inside[near] = (mover < 0) & self.region.contains(x[near])
        asked, turned = x.index_copy(0, near, at), d.index_copy(0, near, along)
        return asked, turned, owner, (~inside).nonzero()[:, 0], inside.nonzero()[:, 0]

    def _near(self, x: Tensor) -> Tensor:
        near = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        for box in self.boxes:
            near |= inside_box(x, box)
        return near

    def _relit(self, x: Tensor, rgb: Tensor, still: Tensor) -> Tensor:
        """The new light on what did not move."""
        assert self.light is not None
        return torch.where(still[:, None], self.light.applied(x, rgb), rgb)
