"""Marching rays through the occupancy grid in Triton: count, prefix sum, fill.

Two walks over each ray, because a ray's room is known only after the first, and a fixed room a ray would be either too
small while the grid is still full or mostly empty later. The second walk needs no density even where the first one
ended at an opaque surface: it stops at the count. One lane walks one ray, and a program is one warp, so that only 32
rays wait for the longest of them, and 16 where densities are looked up on the way.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from refield.field.kernels.gpu.encoding import encoded, level_table, words
from refield.field.kernels.gpu.networks import density_shape, matrix, raw_density
from refield.field.kernels.reference import DensityNet, Lattice, Rays3, Space

_RAYS = {"BLOCK": 32, "num_warps": 1}
# with more rays more wait for the longest; 32 a warp do not fit into its registers
_SEEING = {"BLOCK": 16, "num_warps": 1}


@triton.jit
def _lane(origins, directions, centre, radius, r, mine):  # type: ignore[no-untyped-def]
    """Origins and directions of rays ``r`` in core radii around the centre, (B,) x 6."""
    ux = (tl.load(origins + 3 * r, mask=mine, other=0.0) - tl.load(centre)) / radius
    uy = (tl.load(origins + 3 * r + 1, mask=mine, other=0.0) - tl.load(centre + 1)) / radius
    uz = (tl.load(origins + 3 * r + 2, mask=mine, other=0.0) - tl.load(centre + 2)) / radius
    vx = tl.load(directions + 3 * r, mask=mine, other=0.0) / radius
    vy = tl.load(directions + 3 * r + 1, mask=mine, other=0.0) / radius
    vz = tl.load(directions + 3 * r + 2, mask=mine, other=0.0) / radius
    return ux, uy, uz, vx, vy, vz


@triton.jit
def _largest(x, y, z):  # type: ignore[no-untyped-def]
    return tl.maximum(tl.abs(x), tl.maximum(tl.abs(y), tl.abs(z)))


@triton.jit
def _contracted(x, y, z):  # type: ignore[no-untyped-def]
    """Normalised places -> the contracted cube, of side 4 around zero."""
    far = tl.maximum(_largest(x, y, z), 1.0)
    k = (2 - 1 / far) / far
    return x * k, y * k, z * k


@triton.jit
def _leaves(x, v, cells):  # type: ignore[no-untyped-def]
    """World distance until a place moving ``v`` a unit leaves its cell along this axis (core cube only)."""
    p = (x + 2) * cells
    edge = tl.floor(p) + tl.where(v > 0, 1.0, 0.0)
    moves = tl.abs(v) * cells > 1e-9
    return tl.where(moves, (edge - p) / tl.where(moves, v * cells, 1.0), 1e9)


@triton.jit
def _look(t, ux, uy, uz, vx, vy, vz, grid, fine, side, step, going, FINE: tl.constexpr):  # type: ignore[no-untyped-def]
    """The lattice interval at ``t``: its length, whether something may be at its middle, and how far to skip if not."""
    m = tl.maximum(_largest(ux + vx * t, uy + vy * t, uz + vz * t), 1.0)
    dt = step * m * tl.sqrt(m)
    t = t + dt / 2
    x, y, z = ux + vx * t, uy + vy * t, uz + vz * t
    cx, cy, cz = _contracted(x, y, z)
    cells = side / 4
    i = tl.minimum(tl.maximum(((cx + 2) * cells * 4).to(tl.int32), 0), 4 * side - 1)
    j = tl.minimum(tl.maximum(((cy + 2) * cells * 4).to(tl.int32), 0), 4 * side - 1)
    k = tl.minimum(tl.maximum(((cz + 2) * cells * 4).to(tl.int32), 0), 4 * side - 1)
    cell = ((i >> 2) * side + (j >> 2)) * side + (k >> 2)
    full = tl.load(grid + cell, mask=going, other=0) > 0
    if FINE:
        mask = tl.load(fine + cell, mask=going & full, other=0)
        bit = (((i & 3) * 4 + (j & 3)) * 4 + (k & 3)).to(tl.int64)
        closed = full & (mask != 0) & (((mask >> bit) & 1) == 0)
        full = full & ~closed
        cells = tl.where(closed, cells * 4, cells)
    # all lattice midpoints inside an empty cell (or part) of the core can be skipped; one is kept back for rounding
    leaves = tl.minimum(_leaves(x, vx, cells), tl.minimum(_leaves(y, vy, cells), _leaves(z, vz, cells)))
    m = _largest(x, y, z)
    core = (1 - m) / (step * tl.maximum(_largest(vx, vy, vz), 1e-20)) - 1
    skip = step * tl.floor(tl.maximum(tl.minimum(tl.floor(leaves / step) - 1, core), 0.0))
    return dt, full, tl.where((m < 1) & ~full, skip, 0.0)


@triton.jit
def _count(origins, directions, jitter, centre, radius, near, far, step, grid, fine, side, counts, n,  # type: ignore[no-untyped-def]
           FINE: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    ux, uy, uz, vx, vy, vz = _lane(origins, directions, centre, radius, r, r < n)
    t = near + tl.load(jitter + r, mask=r < n, other=0.0) * step
    found = tl.zeros((BLOCK,), tl.int32)
    going = (r < n) & (t < far)
    while tl.max(going.to(tl.int32), 0) > 0:
        dt, full, skip = _look(t, ux, uy, uz, vx, vy, vz, grid, fine, side, step, going, FINE)
        found += (going & full).to(tl.int32)
        t = tl.where(going, t + (skip + dt), t)
        going = going & (t < far)
    tl.store(counts + r, found.to(tl.int64), mask=r < n)


@triton.jit
def _fill(origins, directions, jitter, centre, radius, near, far, step, grid, fine, side, offsets, t0, t1, n,  # type: ignore[no-untyped-def]
          FINE: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    """Each ray's first samples, as many as its offsets leave room for."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    ux, uy, uz, vx, vy, vz = _lane(origins, directions, centre, radius, r, r < n)
    t = near + tl.load(jitter + r, mask=r < n, other=0.0) * step
    at = tl.load(offsets + r, mask=r < n, other=0)
    end = tl.load(offsets + r + 1, mask=r < n, other=0)
    going = (at < end) & (t < far)
    while tl.max(going.to(tl.int32), 0) > 0:
        dt, full, skip = _look(t, ux, uy, uz, vx, vy, vz, grid, fine, side, step, going, FINE)
        tl.store(t0 + at, t, mask=going & full)
        tl.store(t1 + at, t + dt, mask=going & full)
        at += (going & full).to(tl.int64)
        t = tl.where(going, t + (skip + dt), t)
        going = going & (at < end) & (t < far)


@triton.jit
def _count_visible(origins, directions, jitter, centre, radius, near, far, step, grid, fine, side,  # type: ignore[no-untyped-def]
                   tables, levels, size, w_in, w_out, stop, counts, n, L: tl.constexpr, LP: tl.constexpr,
                   H: tl.constexpr, HP: tl.constexpr, FINE: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    """Each lane goes on to its next occupied interval; then all lanes have their densities looked up together."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    ux, uy, uz, vx, vy, vz = _lane(origins, directions, centre, radius, r, r < n)
    t = near + tl.load(jitter + r, mask=r < n, other=0.0) * step
    hidden_in = matrix(w_in, 2 * L, H, 2 * L, HP, 2 * LP)
    h = tl.arange(0, HP)
    out = tl.load(w_out + h, mask=h < H, other=0.0)[None, :]
    found = tl.zeros((BLOCK,), tl.int32)
    depth = tl.zeros((BLOCK,), tl.float32)
    length = tl.zeros((BLOCK,), tl.float32)
    going = (r < n) & (t < far)
    while tl.max(going.to(tl.int32), 0) > 0:
        seeking = going
        while tl.max(seeking.to(tl.int32), 0) > 0:
            dt, full, skip = _look(t, ux, uy, uz, vx, vy, vz, grid, fine, side, step, seeking, FINE)
            length = tl.where(seeking & full, dt, length)
            t = tl.where(seeking & ~full, t + (skip + dt), t)
            seeking = seeking & ~full & (t < far)
        going = going & (t < far)
        mid = t + length / 2
        x, y, z = _contracted(ux + vx * mid, uy + vy * mid, uz + vz * mid)
        features = encoded((x + 2) / 4, (y + 2) / 4, (z + 2) / 4, going, tables, levels, size, L, LP)
        raw = raw_density(features, hidden_in, out)
        depth += tl.where(going, tl.exp(tl.minimum(raw, 15.0)) / radius * length, 0.0)
        found += going.to(tl.int32)
        t = tl.where(going, t + length, t)
        going = going & (t < far) & (depth < stop)
    tl.store(counts + r, found.to(tl.int64), mask=r < n)


def _walk(rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, fine: Tensor | None) -> tuple[Any, ...]:
    """What every walk takes: rays, space, lattice, grid, masks (the grid in their place if there are none), side."""
    arrays = (r.detach().float().contiguous() for r in rays)
    place = (space[0].float().contiguous(), float(space[1]))
    grid = grid.contiguous()
    return *arrays, *place, *map(float, lattice), grid, grid if fine is None else fine.contiguous(), len(grid)


def _masked(walk: tuple[Any, ...]) -> bool:
    return walk[-2] is not walk[-3]


def _filled(walk: tuple[Any, ...], counts: Tensor, capacity: int | None) -> tuple[Tensor, Tensor, Tensor]:
    """Starts, ends and offsets for the wanted counts (N,); this alone asks the device, if there is no capacity."""
    n = len(counts)
    offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    if capacity is None:
        capacity = int(offsets[-1])
    else:
        offsets.clamp_(max=capacity)
    t0, t1 = walk[0].new_zeros(capacity), walk[0].new_zeros(capacity)
    _fill[(triton.cdiv(n, _RAYS["BLOCK"]),)](*walk, offsets, t0, t1, n, FINE=_masked(walk), **_RAYS)
    return t0, t1, offsets


def march(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    fine: Tensor | None = None,
    *,
    capacity: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.march`.

    With a ``capacity`` nothing is asked of the device: t_starts and t_ends are (capacity,), zeros where unused, and
    rays beyond it get fewer samples or none.
    """
    walk, n = _walk(rays, space, grid, lattice, fine), len(rays[0])
    counts = torch.empty(n, dtype=torch.int64, device=grid.device)
    _count[(triton.cdiv(n, _RAYS["BLOCK"]),)](*walk, counts, n, FINE=fine is not None, **_RAYS)
    return _filled(walk, counts, capacity)


def march_visible(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    net: DensityNet,
    stop: float,
    fine: Tensor | None = None,
    *,
    capacity: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.march_visible`, and :func:`march` for the capacity."""
    tables, resolutions, w_in, w_out = net
    walk, n, size, width = _walk(rays, space, grid, lattice, fine), len(rays[0]), tables.shape[1], len(w_out)
    counts = torch.empty(n, dtype=torch.int64, device=grid.device)
    levels = level_table(tuple(resolutions), size, grid.device)
    matrices = (w_in.detach().contiguous(), w_out.detach().contiguous(), float(stop))
    shape = density_shape(len(resolutions), width)
    _count_visible[(triton.cdiv(n, _SEEING["BLOCK"]),)](
        *walk, words(tables), levels, size, *matrices, counts, n, **shape, FINE=fine is not None, **_SEEING
    )
    return _filled(walk, counts, capacity)
