"""Pictures of an updated field, without gradients: what shows the first visit's field is left to its compiled loop.

A ray is the old field's, in the new light, until it comes to a cell that changed; most are opaque before. From there on
what changed is asked for a few samples at a time, until it is opaque, and then what never changed in front of that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.kernels.onward import Lights, Shown, Way, summed
from refield.field.kernels.reference import Lattice, Networks, Rays3, Space, offsets_of
from refield.field.radiance import HashField
from refield.field.sampling import STOP, OccupancySampler
from refield.field.volrend import Rendering
from refield.scene.capture import Rays
from refield.scene.inside import spans

_SOME = 4  # samples of what changed that are asked for at once on a ray; a surface is about so many thick


@dataclass(frozen=True)
class View:
    """What an updated field is to those who look at it."""

    base: HashField
    """shows what never changed"""
    gone: Tensor
    """(R, R, R) uint8: cells of which the base does not know, or knows no longer, what is in them"""
    told: OccupancySampler
    """looks into those that changed"""
    boxes: Tensor
    """(B, 2, 3) world, which hold all cells that changed"""
    lights: Lights
    """on what never changed"""
    field: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    """knows what is in cells that changed, as a `refield.field.radiance.Field`"""

    def rendered(self, rays: Rays, chunk: int) -> Rendering:
        """What N rays see; ``chunk`` of them are worked on at once."""
        with torch.no_grad():
            begun = [self._begun(rays[i : i + chunk]) for i in range(0, max(len(rays), 1), chunk)]
            sums, first = (torch.cat(parts) for parts in ([b[0] for b in begun], [b[2] for b in begun]))
            t, depth = (torch.cat(parts) for parts in ([b[1].t for b in begun], [b[1].depth for b in begun]))
            under_way = first.isfinite() & (depth < STOP)
            for rows in under_way.nonzero()[:, 0].split(chunk):
                way = Way(t[rows], torch.full_like(t[rows], torch.inf), depth[rows], self.gone)
                sums[rows] = self._ended(rays[rows], sums[rows], way, first[rows])
        return Rendering(*summed(sums))

    def _begun(self, rays: Rays) -> tuple[Tensor, Way, Tensor]:
        """As far as the base alone shows anything: sums (N, 7), the rays' way to there, and where the first sample of
        what changed begins, (N,), infinite where there is none."""
        enter, leave = spans(rays, self.boxes)
        near = (leave > 0).nonzero()[:, 0]
        first = torch.full_like(leave, torch.inf)
        first[near] = self.told.first(rays[near], enter[near], leave[near])
        way = Way(torch.full_like(first, self.base.sampler.near), first, torch.zeros_like(first), self.gone)
        return kernels.render_until(*self._asked(rays), way, self.lights), way, first

    def _ended(self, rays: Rays, sums: Tensor, way: Way, first: Tensor) -> Tensor:
        """The sums (N, 7) of rays that have come to what changed, when they are opaque or see nothing more."""
        told, until = self._told_on(rays, first, way.depth)
        return kernels.blend(sums, kernels.shown_on(*self._asked(rays), way._replace(until=until), self.lights), told)

    def _told_on(self, rays: Rays, first: Tensor, depth: Tensor) -> tuple[Shown, Tensor]:
        """What changed along rays with an optical depth (N,) behind them, from its first sample on until it alone is
        opaque; and from where on nothing else is seen, (N,)."""
        t, depth, until = first.clone(), depth.clone(), torch.full_like(first, torch.inf)
        rows = first.isfinite().nonzero()[:, 0]
        leave, found = spans(rays, self.boxes)[1], []
        while len(rows):
            some = rays[rows]
            t0, t1, counts = self.told.onward(some, (t[rows], first[rows], leave[rows]), _SOME)
            here = t0.isfinite()
            ids = torch.repeat_interleave(torch.arange(len(rows)), counts)
            s0, s1, d = t0[here], t1[here], some.directions[ids]
            sigma, rgb = self.field(some.origins[ids] + d * ((s0 + s1) / 2)[:, None], d)
            found.append((s0, s1, sigma, rgb, rows[ids]))
            depth.index_add_(0, rows[ids], sigma * (s1 - s0))
            t[rows] = t1[:, -1]
            opaque, more = depth[rows] >= STOP, counts == _SOME
            until[rows[opaque]] = t1.where(here, -torch.inf).amax(-1)[opaque]
            rows = rows[more & ~opaque]
        return _in_order(found, len(first)), until

    def _asked(
        self, rays: Rays
    ) -> tuple[Rays3, Space, Tensor, Lattice, tuple[Tensor, tuple[int, ...], Networks], float, Tensor | None]:
        """What kernels want to know of rays and the base."""
        base, sampler = self.base, self.base.sampler
        space = (sampler.contraction.centre, sampler.contraction.radius)
        net = (base.encoding.tables, base.encoding.resolutions, base.networks)
        lines = (rays.origins, rays.directions, rays.origins.new_zeros(len(rays)))
        return lines, space, sampler.grid, sampler.lattice, net, STOP, sampler.fine


def boxes_around(sampler: OccupancySampler, boxes: Sequence[Tensor]) -> Tensor:
    """World boxes (B, 2, 3) around the occupied cells of a sampler in each of some others that holds any."""
    out = []
    for box in boxes:
        cells = sampler.cells_in(box)
        cells = cells[sampler.grid.view(-1)[cells] > 0]
        if len(cells):
            x, half = sampler.points_in(cells, jitter=False), sampler.width(sampler.distance(cells))[:, None]
            out.append(torch.stack([(x - half).amin(0), (x + half).amax(0)]))
    return torch.stack(out) if out else torch.zeros(0, 2, 3)


def _in_order(found: Sequence[tuple[Tensor, ...]], count: int) -> Shown:
    """Samples (starts, ends, densities, colours, rays) found in rounds, packed by ray."""
    if not found:
        none = torch.zeros(0)
        return none, none, none, torch.zeros(0, 3), torch.zeros(count + 1, dtype=torch.long)
    t0, t1, sigma, rgb, ids = (torch.cat(parts) for parts in zip(*found))
    order = torch.argsort(ids, stable=True)
    counts = torch.bincount(ids, minlength=count)
    return t0[order], t1[order], sigma[order], rgb[order], offsets_of(counts)
