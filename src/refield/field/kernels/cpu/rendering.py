"""Pictures on the CPU: what marching encodes is used at once for the colours, in the cache, and composited there."""

from __future__ import annotations

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from refield.field.kernels.cpu.encoding import array
from refield.field.kernels.cpu.lights import arrays_of, shine
from refield.field.kernels.cpu.marching import Marched, marched
from refield.field.kernels.cpu.networks import BLOCK, forward_block, pack, room_for, sizes_of
from refield.field.kernels.cpu.simd import JIT, exp
from refield.field.kernels.cpu.step import take_block
from refield.field.kernels.onward import NO_LIGHTS, Lights, summed
from refield.field.kernels.reference import TRACE, Lattice, Networks, Rays3, Space

_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_TRACE = np.float32(TRACE)


@njit(**JIT)
def _composite(first, n, at, t0, t1, raw, rgb, radius, out):  # type: ignore[no-untyped-def]
    """A ray of n samples, the step's from ``first``, the block's from ``at``: `onward.blend`'s sums into out (7,)."""
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
    out[0], out[1], out[2], out[3], out[4], out[5], out[6] = red, green, blue, reached, lit, mass, clear


@njit(**JIT)
def _light(r, first, n, at, t0, t1, lines, lights, rgb):  # type: ignore[no-untyped-def]
    """The colours of ray r's samples, as `_composite`'s, in the light of ``lights``."""
    origins, directions = lines
    for i in range(n):
        mid = (t0[first + i] + t1[first + i]) / _TWO
        x, y, z = (
            origins[r, 0] + directions[r, 0] * mid,
            origins[r, 1] + directions[r, 1] * mid,
            origins[r, 2] + directions[r, 2] * mid,
        )
        shine(x, y, z, lights, rgb[at + i])


@njit(**JIT)
def _part(begin, end, found, lines, radius, sizes, packed, lights, out):  # type: ignore[no-untyped-def]
    t0, t1, features, offsets = found
    longest = BLOCK
    for r in range(begin, end):
        longest = max(longest, offsets[r + 1] - offsets[r])
    room, d = room_for(longest, packed), np.empty((longest, 3), np.float32)
    last = begin
    while last < end:
        r, first = last, offsets[last]
        last = take_block(r, end, longest, lines[1], offsets, d)
        n = offsets[last] - first
        forward_block(features[first : first + n], d[:n], sizes, packed, room)
        for q in range(r, last):
            at, many = offsets[q] - first, offsets[q + 1] - offsets[q]
            if len(lights[0]) > 0:
                _light(q, offsets[q], many, at, t0, t1, lines, lights, room[5])
            _composite(offsets[q], many, at, t0, t1, room[2][:, 0], room[5], radius, out[q])


@njit(parallel=True, **JIT)
def _parts(bounds, found, lines, radius, sizes, packed, lights, out):  # type: ignore[no-untyped-def]
    for p in prange(len(bounds) - 1):
        _part(bounds[p], bounds[p + 1], found, lines, radius, sizes, packed, lights, out)


def composited(found: Marched, rays: Rays3, radius: float, networks: Networks, lights: Lights) -> Tensor:
    """What rays see in what marching found, in the light of ``lights``: `onward.blend`'s sums (N, 7)."""
    n, samples, parts = len(rays[0]), len(found.t_starts), 4 * get_num_threads()
    bounds = np.searchsorted(found.offsets, samples * np.arange(parts + 1) // parts)
    bounds[0], bounds[-1] = 0, n  # rays without a sample, too
    out, kept = torch.empty(n, 7), (found.t_starts, found.t_ends, found.features, found.offsets)
    lines, packed = (array(rays[0]), array(rays[1])), pack(networks)
    _parts(bounds, kept, lines, np.float32(radius), sizes_of(networks), packed, arrays_of(lights), out.numpy())
    return out


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
    return summed(composited(found, rays, space[1], networks, NO_LIGHTS))
