"""Pictures on the CPU: what marching encodes is used at once for the colours, in the cache, and composited there."""

from __future__ import annotations

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from refield.field.kernels.cpu.encoding import array
from refield.field.kernels.cpu.marching import marched
from refield.field.kernels.cpu.networks import BLOCK, forward_block, pack, room_for, sizes_of
from refield.field.kernels.cpu.simd import JIT, exp
from refield.field.kernels.cpu.step import take_block
from refield.field.kernels.reference import TRACE, Lattice, Networks, Rays3, Space

_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_TRACE, _LEAST = np.float32(TRACE), np.float32(1e-6)


@njit(**JIT)
def _composite(first, n, at, t0, t1, raw, rgb, radius, out):  # type: ignore[no-untyped-def]
    """A ray of n samples, the step's from ``first``, the block's from ``at``: colour, depth, opacity into out (5,)."""
    red = green = blue = mass = lit = reached = _ZERO
    clear = _ONE
    for i in range(n):
        j, k = first + i, at + i
        passed = exp(-exp(min(raw[k], np.float32(15))) / radius * (t1[j] - t0[j]))
        w = clear * (_ONE - passed)
        red, green, blue, mass = red + w * rgb[k, 0], green + w * rgb[k, 1], blue + w * rgb[k, 2], mass + w
        if clear > _TRACE:
            lit += w
            reached += w * (t0[j] + t1[j]) / _TWO
        clear *= passed
    out[0], out[1], out[2], out[3], out[4] = red, green, blue, reached / max(lit, _LEAST), mass


@njit(**JIT)
def _part(begin, end, found, directions, radius, sizes, packed, out):  # type: ignore[no-untyped-def]
    t0, t1, features, offsets = found
    longest = BLOCK
    for r in range(begin, end):
        longest = max(longest, offsets[r + 1] - offsets[r])
    room, d = room_for(longest, packed), np.empty((longest, 3), np.float32)
    last = begin
    while last < end:
        r, first = last, offsets[last]
        last = take_block(r, end, longest, directions, offsets, d)
        n = offsets[last] - first
        forward_block(features[first : first + n], d[:n], sizes, packed, room)
        for q in range(r, last):
            at = offsets[q] - first
            _composite(offsets[q], offsets[q + 1] - offsets[q], at, t0, t1, room[2][:, 0], room[5], radius, out[q])


@njit(parallel=True, **JIT)
def _parts(bounds, found, directions, radius, sizes, packed, out):  # type: ignore[no-untyped-def]
    for p in prange(len(bounds) - 1):
        _part(bounds[p], bounds[p + 1], found, directions, radius, sizes, packed, out)


def render(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    stop: float,
    fine: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.render`."""
    tables, resolutions, networks = field
    found = marched(rays, space, grid, lattice, (tables, resolutions, networks[0], networks[1][0]), stop, fine)
    n, samples, parts = len(rays[0]), len(found.t_starts), 4 * get_num_threads()
    bounds = np.searchsorted(found.offsets, samples * np.arange(parts + 1) // parts)
    bounds[0], bounds[-1] = 0, n  # rays without a sample, too
    out = torch.empty(n, 5)
    kept = (found.t_starts, found.t_ends, found.features, found.offsets)
    radius = np.float32(space[1])
    _parts(bounds, kept, array(rays[1]), radius, sizes_of(networks), pack(networks), out.numpy())
    return out[:, :3].contiguous(), out[:, 3].contiguous(), out[:, 4].contiguous()
