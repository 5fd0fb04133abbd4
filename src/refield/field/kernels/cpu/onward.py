"""Rays that are on their way, on the CPU: see `refield.field.kernels.onward`."""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from refield.field.kernels.cpu.cells import grids_of
from refield.field.kernels.cpu.encoding import array
from refield.field.kernels.cpu.lights import arrays_of, shine
from refield.field.kernels.cpu.marching import Marched, marched
from refield.field.kernels.cpu.networks import forward_all, pack, sizes_of
from refield.field.kernels.cpu.rendering import composited
from refield.field.kernels.cpu.simd import JIT, exp
from refield.field.kernels.cpu.walk import next_sample, start
from refield.field.kernels.onward import Lights, Shown, Span, Way
from refield.field.kernels.reference import TRACE, Lattice, Networks, Rays3, Space

_ZERO, _ONE, _TWO, _TRACE = np.float32(0), np.float32(1), np.float32(2), np.float32(TRACE)
_SOME = 64  # rays that a thread takes at once


@njit(**JIT)
def _skipped(ray, t, step, enter):  # type: ignore[no-untyped-def]
    """The lattice's last place from ``t`` on that lies before ``enter``, or one somewhat before; see `walk.start`."""
    while True:
        m = max(abs(ray[0] + ray[3] * t), max(abs(ray[1] + ray[4] * t), abs(ray[2] + ray[5] * t)))
        if m > _ONE:
            dt = step * m * np.float32(math.sqrt(m))
        else:  # a hair is kept back for rounding
            clear = min(enter - t, (_ONE - m) * ray[9])
            dt = step * max(np.float32(math.floor(clear * ray[10] - np.float32(1e-3))), _ONE)
        if not t + dt < enter:
            return t
        t += dt


@njit(**JIT)
def _next_part(begin, end, rays, space, grids, lattice, span, t0, t1, counts):  # type: ignore[no-untyped-def]
    step, most = np.float32(lattice[2]), t0.shape[1]
    at, enter, leave = span
    ray, unit = np.empty(11, np.float32), np.empty(3, np.float32)
    for r in range(begin, end):
        start(rays, space, lattice, np.float32(grids[0].shape[0] / 4), r, ray)
        t, found, far = at[r], 0, min(np.float32(lattice[1]), leave[r])
        if enter[r] < far:
            t = _skipped(ray, t, step, enter[r])
        while found < most:
            t, dt = next_sample(ray, t, far, step, grids, unit)
            if dt == 0:
                break
            t0[r, found], t1[r, found] = t, t + dt
            found += 1
            t += dt
        counts[r] = found
        t0[r, found:], t1[r, found:] = np.inf, np.inf


@njit(parallel=True, **JIT)
def _next(rays, space, grids, lattice, span, t0, t1, counts):  # type: ignore[no-untyped-def]
    n = len(counts)
    for b in prange((n + _SOME - 1) // _SOME):
        _next_part(b * _SOME, min(n, (b + 1) * _SOME), rays, space, grids, lattice, span, t0, t1, counts)


def next_samples(
    rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, span: Span, most: int, fine: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """See `onward.next_samples`."""
    n = len(span[0])
    t0, t1, counts = torch.empty(n, most), torch.empty(n, most), torch.empty(n, dtype=torch.long)
    arrays, place = tuple(array(r) for r in rays), (array(space[0].float()), np.float32(space[1]))
    _next(
        arrays,
        place,
        grids_of(grid, fine),
        lattice,
        tuple(array(s) for s in span),
        t0.numpy(),
        t1.numpy(),
        counts.numpy(),
    )
    return t0, t1, counts


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
    """See `onward.render_until`."""
    found = _found(rays, space, grid, lattice, field, stop, fine, way)
    return composited(found, rays, space[1], field[2], lights)


def _found(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    stop: float,
    fine: Tensor | None,
    way: Way,
) -> Marched:
    tables, resolutions, networks = field
    return marched(rays, space, grid, lattice, (tables, resolutions, networks[0], networks[1][0]), stop, fine, way)


@njit(parallel=True, **JIT)
def _told(found, rays, radius, lights, sigma, rgb):  # type: ignore[no-untyped-def]
    """Raw densities -> densities, colours -> colours in the new light, in place."""
    t0, t1, owners = found
    origins, directions = rays
    for s in prange(len(sigma)):
        r, mid = owners[s], (t0[s] + t1[s]) / _TWO
        sigma[s] = exp(min(sigma[s], np.float32(15))) / radius
        if len(lights[0]) > 0:
            x, y, z = (
                origins[r, 0] + directions[r, 0] * mid,
                origins[r, 1] + directions[r, 1] * mid,
                origins[r, 2] + directions[r, 2] * mid,
            )
            shine(x, y, z, lights, rgb[s])


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
    """See `onward.shown_on`."""
    found = _found(rays, space, grid, lattice, field, stop, fine, way)
    n, lines = len(found.t_starts), (array(rays[0]), array(rays[1]))
    sigma, rgb = torch.empty(n), torch.empty(n, 3)
    forward_all(found.features, lines[1][found.owners], sizes_of(field[2]), pack(field[2]), sigma.numpy(), rgb.numpy())
    where = (found.t_starts, found.t_ends, found.owners)
    _told(where, lines, np.float32(space[1]), arrays_of(lights), sigma.numpy(), rgb.numpy())
    t0, t1 = torch.from_numpy(found.t_starts.copy()), torch.from_numpy(found.t_ends.copy())
    return t0, t1, sigma, rgb, torch.from_numpy(found.offsets)


@njit(**JIT)
def _blend_ray(r, a, b, out):  # type: ignore[no-untyped-def]
    """Ray r: what is seen near to far in both sets of samples, onto ``out`` (7,)."""
    i, j, last_a, last_b = a[4][r], b[4][r], a[4][r + 1], b[4][r + 1]
    clear = out[6]
    while i < last_a or j < last_b:
        if j >= last_b or (i < last_a and a[0][i] <= b[0][j]):
            s, (t0, t1, sigma, rgb, _) = i, a
            i += 1
        else:
            s, (t0, t1, sigma, rgb, _) = j, b
            j += 1
        passed = exp(-sigma[s] * (t1[s] - t0[s]))
        w = clear * (_ONE - passed)
        for c in range(3):
            out[c] += w * rgb[s, c]
        if clear > _TRACE:
            out[3] += w * (t0[s] + t1[s]) / _TWO
            out[4] += w
        out[5] += w
        clear *= passed
    out[6] = clear


@njit(parallel=True, **JIT)
def _blend(a, b, out):  # type: ignore[no-untyped-def]
    n = len(out)
    for p in prange((n + _SOME - 1) // _SOME):
        for r in range(p * _SOME, min(n, (p + 1) * _SOME)):
            _blend_ray(r, a, b, out[r])


def blend(sums: Tensor, a: Shown, b: Shown) -> Tensor:
    """See `onward.blend`."""
    out = sums.clone()
    _blend(tuple(array(t) for t in a), tuple(array(t) for t in b), out.numpy())
    return out
