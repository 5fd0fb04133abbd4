"""The paper's updated field (Fig. 11): old field and helper over samples that fine-tuned proposal networks choose.

Samples along rays: the old field's piecewise sampler, then copies of its proposal networks, asked by the two-way
mapping (Eq. 16). Each sample is then the helper's within the move-out region, else the old field's at the coordinates
of Eq. 3 (Eqs. 4, 5). Letters: S points, N rays, K intervals a ray.
"""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor, nn

from refield.field.nerfacto import NerfactoField
from refield.field.proposal import Density, Histogram
from refield.field.sampling import OccupancySampler
from refield.field.volrend import Samples
from refield.field.warp import Move, move_in, moves_of, two_way
from refield.scene.capture import Rays
from refield.scene.change import SceneChange
from refield.scene.notebook import facts
from refield.update.paper.helper import HelperField
from refield.update.region import Region, move_out


class PaperField:
    """A Field of the scene after a change. The old field and the change are shared, not copied."""

    def __init__(
        self,
        pretrained: NerfactoField | PaperField,
        change: SceneChange,
        helper: HelperField,
        proposals: nn.ModuleList,
        region: Region,
        *,
        sampler: OccupancySampler | None = None,
    ) -> None:
        """``region`` is M_out, ``proposals`` are copies of the old ones. ``sampler``, for those who march
        through the field, is looked up where things changed unless it is given."""
        self.pretrained, self.change, self.helper, self.proposals = pretrained, change, helper, proposals
        self.region = region
        self.moves: tuple[Move, ...] = moves_of(change)
        self.base = base_of(pretrained)
        self.boxes: tuple[Tensor, ...] = tuple(m.box_now for m in self.moves) + region.boxes
        self.why_stopped = ""
        """what ended its training, in words; empty if it was not trained here"""
        self.notes: tuple[str, ...] = ()
        """what the user should know of it, in words"""
        if sampler is None:
            sampler = pretrained.sampler.refreshed(self.density, self.boxes)
        self.sampler: OccupancySampler = sampler

    def __repr__(self) -> str:
        return f"PaperField({self.change.kinds}; before: {self.pretrained!r})"

    def _repr_html_(self) -> str:
        rows: list[tuple[str, object]] = [("this change", self.change.kinds), ("before", self.pretrained)]
        return facts("PaperField", rows + [("note", note) for note in (self.why_stopped, *self.notes) if note])

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        flat = x.reshape(-1, 3)
        asked, _, owner = move_in(flat, torch.zeros_like(flat), self.moves)
        helped = self._helped(flat, owner)
        rows, rest = helped.nonzero()[:, 0], (~helped).nonzero()[:, 0]
        sigma = flat.new_zeros(len(flat)).index_copy(0, rest, self.pretrained.density(asked[rest]))
        return sigma.index_copy(0, rows, self.helper.density(flat[rows])).reshape(x.shape[:-1])

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3) and unit directions (..., 3) -> sigma (...,) and rgb (..., 3) in [0, 1], in the mean
        of all photos' looks."""
        sigma, rgb = self.seen_in(None, x.reshape(-1, 3), d.reshape(-1, 3))
        return sigma.reshape(x.shape[:-1]), rgb.reshape(x.shape)

    def seen_in(self, photo: Tensor | None, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Eq. 5 with Eq. 3, the helper's colours as in photos (S,): world points and directions (S, 3) -> sigma (S,),
        rgb (S, 3). The photos are counted as the helper's looks."""
        asked, along, owner = move_in(x, d, self.moves)
        helped = self._helped(x, owner)
        rows, rest = helped.nonzero()[:, 0], (~helped).nonzero()[:, 0]
        s, c = self.pretrained(asked[rest], along[rest])
        sigma = x.new_zeros(len(x)).index_copy(0, rest, s)
        rgb = torch.zeros_like(x).index_copy(0, rest, c)
        s, c = self.helper(x[rows], d[rows], None if photo is None else photo[rows])
        return sigma.index_copy(0, rows, s), rgb.index_copy(0, rows, c)

    def _helped(self, x: Tensor, owner: Tensor) -> Tensor:
        """M_out without where anything moved in, which wins (§10.1.2), (S,) bool."""
        return (owner < 0) & self.region.contains(x)

    def propose(
        self, rays: Rays, jitter: bool = False, draw: torch.Generator | None = None
    ) -> tuple[tuple[Histogram, ...], Tensor]:
        """The fine-tuned proposals' histograms of N rays, and the edges (N, K + 1) in s at which to ask the field."""
        return self.base.propose(rays, jitter, densities=tuple(map(self._mapped, self.proposals)), draw=draw)

    def samples(self, rays: Rays, jitter: bool = False) -> Samples:
        """Where to evaluate the field along rays: where the fine-tuned proposals expect something to be seen."""
        with torch.no_grad():
            return self.base.span.samples(self.propose(rays, jitter)[1])

    def _mapped(self, network: nn.Module) -> Density:
        told = self.base.told_by(network)
        return lambda x: told(self.proposed_at(x))

    def proposed_at(self, x: Tensor) -> Tensor:
        """Where the first field's proposal networks are asked about world points (S, 3): what moved where it was, and
        where it was, where it is now (Eq. 16), at this visit and then at each before."""
        x = two_way(x, torch.zeros_like(x), self.moves)[0]
        return self.pretrained.proposed_at(x) if isinstance(self.pretrained, PaperField) else x


def base_of(field: NerfactoField | PaperField) -> NerfactoField:
    """The field before any update."""
    return field.base if isinstance(field, PaperField) else field


def begun(
    pretrained: NerfactoField | PaperField, change: SceneChange, looks: tuple[int, int], dilation: float, seed: int
) -> PaperField:
    """The field before training: a helper from scratch with P photos' looks of E numbers, and the proposal networks as
    they were, ready to be trained. Those who march through it see the old field yet."""
    base = base_of(pretrained)
    helper = HelperField(base.config, base.contraction, looks, seed)
    proposals = deepcopy(pretrained.proposals)
    for p in proposals.parameters():
        p.requires_grad_(True)
    return PaperField(pretrained, change, helper, proposals, move_out(change, dilation), sampler=pretrained.sampler)


def ready(field: PaperField) -> PaperField:
    """The field for use, after training: nothing of it learns any more, and others know where to look."""
    for part in (field.helper, field.proposals):
        part.eval().requires_grad_(False)
    return PaperField(field.pretrained, field.change, field.helper, field.proposals, field.region)
