"""Rays that are on their way, and light on surfaces, in plain torch: truths as those in `reference`.

A changed field is the old one for as long as a ray meets nothing that changed; from there on somebody else knows what
it meets. Letters: N rays, S samples packed by ray, M samples of each ray, L lattices of light.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from refield.field.kernels import reference
from refield.field.kernels.reference import TRACE, Lattice, Networks, Rays3, Space, offsets_of, truncated_exp

Shown = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""t_starts (S,), t_ends (S,), densities (S,) per world unit, colours (S, 3), offsets (N + 1,)"""


Span = tuple[Tensor, Tensor, Tensor]
"""(N,) float32 each: where rays are on the lattice; and from where to where it is of interest what they meet, infinite
and 0 where nothing is. Samples elsewhere may be left out"""


class Way(NamedTuple):
    """How far rays have come, and how far they go."""

    t: Tensor
    """(N,) float32 where each is: the lattice's next interval begins there. Overwritten by the end of the sample
    in which it became opaque, or by a place behind ``until`` or ``far`` before which there is nothing more"""
    until: Tensor
    """(N,) float32; no interval begins there or beyond"""
    depth: Tensor
    """(N,) float32 optical depth behind it. Overwritten, likewise"""
    gone: Tensor
    """(R, R, R) uint8 over contracted space: samples in cells that are not 0 are left out"""


class Lights(NamedTuple):
    """Colour factors on lattices, one after the other; see `refield.update.light.Relighting`."""

    boxes: Tensor
    """(L, 2, 3) float32 world, corner to corner of each lattice's nodes"""
    shapes: Tensor
    """(L, 3) int64"""
    firsts: Tensor
    """(L,) int64, the row of each lattice's first node"""
    logs: Tensor
    """(K, 3) float32, natural logarithms of the factors at all nodes"""


NO_LIGHTS = Lights(
    torch.zeros(0, 2, 3), torch.zeros(0, 3, dtype=torch.long), torch.zeros(0, dtype=torch.long), torch.zeros(0, 3)
)


def next_samples(
    rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, span: Span, most: int, fine: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """As `reference.march`, but from where each ray is, and the next M = ``most`` samples at most.

    Returns t_starts (N, M) and t_ends (N, M), infinite where a ray has no more, and how many each has, (N,) int64. A
    ray goes on from the end of its last sample.
    """
    near, _, step = lattice
    t, enter, leave = span
    t0, t1, offsets = reference.march((rays[0], rays[1], (t - near) / step), space, grid, lattice, fine)
    ids = reference._ray_ids(offsets)
    kept = (t1 > enter[ids]) & (t0 < leave[ids])
    counts = torch.zeros_like(offsets[1:]).index_add(0, ids, kept.long())
    t0, t1, offsets = t0[kept], t1[kept], offsets_of(counts)
    counts = counts.clamp(max=most)
    out = torch.full((2, len(t), most), torch.inf, device=t.device)
    for m in range(most):
        rows = (counts > m).nonzero()[:, 0]
        out[0, rows, m], out[1, rows, m] = t0[offsets[rows] + m], t1[offsets[rows] + m]
    return out[0], out[1], counts


def relight(x: Tensor, rgb: Tensor, lights: Lights) -> Tensor:
    """Colours (S, 3) at world points (S, 3), times the factor of one light after the other, each time within [0, 1]."""
    for box, shape, first in zip(lights.boxes, lights.shapes.tolist(), lights.firsts.tolist()):
        nodes = lights.logs[first : first + shape[0] * shape[1] * shape[2]].reshape(*shape, 3)
        unit = (x - box[0]) / (box[1] - box[0]) * 2 - 1
        at = unit.flip(-1)[None, :, None, None]  # grid_sample's first coordinate runs along the last axis
        volume = nodes.permute(3, 0, 1, 2)[None].contiguous()
        logs = functional.grid_sample(volume, at, padding_mode="border", align_corners=True).reshape(3, -1).T
        inside = ((x >= box[0]) & (x <= box[1])).all(-1, keepdim=True)
        rgb = torch.where(inside, (rgb * logs.exp()).clamp(0, 1), rgb)
    return rgb


def shown_on(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    stop: float,
    fine: Tensor | None,
    way: Way,
    lights: Lights,
) -> Shown:
    """The samples of a hash field in the light of ``lights`` that rays on their ``way`` meet: as `march_visible`, with
    what is there."""
    tables, resolutions, networks = field
    origins, directions, _ = rays
    t0, t1, offsets = reference.march(
        (origins, directions, (way.t - lattice[0]) / lattice[2]), space, grid, lattice, fine
    )
    ids = reference._ray_ids(offsets)
    mid = origins[ids] + directions[ids] * ((t0 + t1) / 2)[:, None]
    unit = (reference.contract(mid, *space) + 2) / 4
    raw, rgb = reference.hash_field(unit, directions[ids], tables, resolutions, networks)
    sigma = truncated_exp(raw) / space[1]
    until = way.until.clamp(max=lattice[1])
    kept = t0 < until[ids]
    i, j, k = (unit * way.gone.shape[0]).long().clamp(0, way.gone.shape[0] - 1).unbind(-1)
    kept &= way.gone[i, j, k] == 0
    tau = torch.where(kept, sigma * (t1 - t0), 0.0)
    kept &= way.depth[ids] + reference._exclusive_sum(tau, offsets) < stop
    counts = torch.zeros_like(offsets[1:]).index_add(0, ids, kept.long())
    way.depth.index_add_(0, ids, torch.where(kept, tau, 0.0))
    rgb = relight(mid, rgb, lights)
    t0, t1, offsets = t0[kept], t1[kept], offsets_of(counts)
    rows = ((counts > 0) & (way.depth >= stop)).nonzero()[:, 0]
    way.t.copy_(until.index_copy(0, rows, t1[offsets[1:][rows] - 1]))
    return t0, t1, sigma[kept], rgb[kept], offsets


def render_until(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    stop: float,
    fine: Tensor | None,
    way: Way,
    lights: Lights,
) -> Tensor:
    """What rays have seen of a hash field by the end of their ``way``: sums (N, 7) that `blend` adds to and `summed`
    reads. Without gradients."""
    with torch.no_grad():
        shown = shown_on(rays, space, grid, lattice, field, stop, fine, way, lights)
        start = torch.zeros(len(way.t), 7, device=way.t.device)
        start[:, 6] = 1
        t0, t1, sigma, rgb, offsets = shown
        return blend(start, shown, (t0[:0], t1[:0], sigma[:0], rgb[:0], torch.zeros_like(offsets)))


def blend(sums: Tensor, a: Shown, b: Shown) -> Tensor:
    """Sums (N, 7) of what rays have seen, and what they see behind it in two sets of samples -> the sums of all.

    Of each ray: colour (3), distance and weight of what is not in the last `TRACE` of the light, opacity, and what
    light still passes (1 where a ray has seen nothing).
    """
    ids = torch.cat([reference._ray_ids(a[4]), reference._ray_ids(b[4])])
    t0, t1, sigma, rgb = (torch.cat([a[i], b[i]]) for i in range(4))
    order = torch.argsort(t0.double(), stable=True)
    order = order[torch.argsort(ids[order], stable=True)]
    t0, t1, sigma, rgb, ids, offsets = t0[order], t1[order], sigma[order], rgb[order], ids[order], a[4] + b[4]
    before = sums[ids, 6] * torch.exp(-reference._exclusive_sum(sigma * (t1 - t0), offsets))
    w = before * -torch.expm1(-sigma * (t1 - t0))
    lit = w * (before > TRACE)
    each = torch.cat([w[:, None] * rgb, torch.stack([lit * (t0 + t1) / 2, lit, w], -1)], -1)
    out = sums.clone()
    out[:, :6].index_add_(0, ids, each)
    tau = torch.zeros_like(sums[:, 6]).index_add(0, ids, sigma * (t1 - t0))
    out[:, 6] *= torch.exp(-tau)
    return out


def summed(sums: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums (N, 7) -> rgb (N, 3) on black, depth (N,), opacity (N,)."""
    return reference.seen(sums[:, :6])
