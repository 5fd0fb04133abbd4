"""Where to look along rays, on the CPU: lattice, occupancy grid and, where wanted, the density network.

With the network, a thread's rays advance together in waves, each by one occupied sample: so the encoding and the
network see hundreds of samples at once, and a ray stops after the wave in which it became opaque.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from refield.field.kernels.cpu.cells import BLOCKS, grids_of
from refield.field.kernels.cpu.encoding import array, encode_part, pairs, parts_of, scratch
from refield.field.kernels.cpu.networks import padded
from refield.field.kernels.cpu.simd import JIT, exp, product
from refield.field.kernels.reference import DensityNet, Lattice, Rays3, Space

_ZERO, _ONE, _TWO, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
_BLOCK = 128  # samples whose hidden layer is held at once
_FINE = np.float32(4)  # sub-cells a side of a cell
_BLOCK_FINE = 4 * BLOCKS  # sub-cells a side of a block that is skipped
_ROOM = 32  # samples a ray that are made room for at first


@njit(forceinline=True, **JIT)
def _leave(p, inverse, size, many):  # type: ignore[no-untyped-def]
    """Distance until the coordinate p, in cells, leaves ``many`` cubes of ``size`` cells; inverse: per cell of p."""
    cube = np.float32(math.floor(p / size))  # a power of two: exact
    edge = size * (cube + many) if inverse > 0 else size * (cube + _ONE - many)
    return (edge - p) * inverse


@njit(forceinline=True, **JIT)
def _next(ray, t, far, step, grids, unit):  # type: ignore[no-untyped-def]
    """The first lattice interval at or after t whose midpoint lies where something may be: (t, dt); dt = 0 if none.

    ``ray``: see :func:`_start`; ``grids``: see `cells.grids_of`. ``unit`` (3,) is set to the midpoint in [0, 1].
    """
    grid, reaches, fine = grids
    r = grid.shape[0]
    last = 4 * r - 1
    per_unit, quarter, half = np.float32(r / 4), np.float32(0.25), step * _HALF
    u0, u1, u2, v0, v1, v2 = ray[0], ray[1], ray[2], ray[3], ray[4], ray[5]
    while t < far:
        x, y, z = u0 + v0 * t, u1 + v1 * t, u2 + v2 * t
        m = max(abs(x), max(abs(y), abs(z)))
        if m <= _ONE:
            dt = step
            x, y, z = x + v0 * half, y + v1 * half, z + v2 * half
        else:
            dt = step * m * np.float32(math.sqrt(m))
            x, y, z = x + v0 * dt * _HALF, y + v1 * dt * _HALF, z + v2 * dt * _HALF
        m = max(abs(x), max(abs(y), abs(z)))
        if m > _ONE:
            k = (_TWO - _ONE / m) / m
            x, y, z = x * k, y * k, z * k
        a, b, c = x + _TWO, y + _TWO, z + _TWO
        p, q, o = a * per_unit, b * per_unit, c * per_unit
        i, j, l = (
            min(max(int(p * _FINE), 0), last),
            min(max(int(q * _FINE), 0), last),
            min(max(int(o * _FINE), 0), last),
        )
        empty = reaches[i // _BLOCK_FINE, j // _BLOCK_FINE, l // _BLOCK_FINE]
        size, many = (np.float32(BLOCKS), np.float32(empty)) if empty > 0 else (_ONE, _ONE)
        if empty == 0 and grid[i >> 2, j >> 2, l >> 2] > 0:
            mask = fine[i >> 2, j >> 2, l >> 2] if len(fine) > 0 else 0
            if mask == 0 or (mask >> (((i & 3) * 4 + (j & 3)) * 4 + (l & 3))) & 1:
                unit[0], unit[1], unit[2] = a * quarter, b * quarter, c * quarter
                return t, dt
            size = quarter
        if m < _ONE:
            # lattice midpoints in what is empty are skipped; a hair is kept back for rounding
            leave = min(
                min(_leave(p, ray[6], size, many), _leave(q, ray[7], size, many)),
                min(_leave(o, ray[8], size, many), (_ONE - m) * ray[9]),
            )
            skip = np.float32(math.floor(leave * ray[10] - np.float32(1e-3)))
            if skip > 0:
                t += step * skip
        elif empty > 1:
            # outside the core the lattice has to be walked, but without a look at the grid; the contraction lengthens
            # nothing by more than 4/3
            safe = min(t + np.float32(empty - 1) * np.float32(0.75 * BLOCKS) / per_unit * ray[9], far)
            t += dt
            while t < safe:
                m = max(abs(u0 + v0 * t), max(abs(u1 + v1 * t), abs(u2 + v2 * t)))
                dt = step if m <= _ONE else step * m * np.float32(math.sqrt(m))
                if t + dt >= safe:
                    break
                t += dt
            continue
        t += dt
    return t, _ZERO


@njit(forceinline=True, **JIT)
def _start(rays, space, lattice, per_unit, r, ray):  # type: ignore[no-untyped-def]
    """Ray r in core radii into ``ray`` (11,); returns its first t.

    Origin (3), direction (3), its inverse in cells (3), the inverse of its fastest component, and of the step.
    """
    origins, directions, jitter = rays
    fastest = np.float32(1e-9)
    for a in range(3):
        ray[a] = (origins[r, a] - space[0][a]) / space[1]
        v = directions[r, a] / space[1]
        ray[3 + a] = v
        speed = v * per_unit
        ray[6 + a] = _ONE / speed if abs(speed) > np.float32(1e-9) else np.float32(1e9)
        fastest = max(fastest, abs(v))
    ray[9], ray[10] = _ONE / fastest, _ONE / np.float32(lattice[2])
    return np.float32(lattice[0]) + jitter[r] * np.float32(lattice[2])


@njit(**JIT)
def _march_part(begin, end, rays, space, grids, lattice, t0, t1, counts):  # type: ignore[no-untyped-def]
    far, step = np.float32(lattice[1]), np.float32(lattice[2])
    ray, unit = np.empty(11, np.float32), np.empty(3, np.float32)
    for r in range(begin, end):
        t = _start(rays, space, lattice, np.float32(grids[0].shape[0] / 4), r, ray)
        found = 0
        while True:
            t, dt = _next(ray, t, far, step, grids, unit)
            if dt == 0:
                break
            if found < t0.shape[1]:
                t0[r, found], t1[r, found] = t, t + dt
            found += 1
            t += dt
        counts[r] = found


@njit(parallel=True, **JIT)
def _march(rays, space, grids, lattice, t0, t1, counts):  # type: ignore[no-untyped-def]
    """Fills row r of t0, t1 (N, K) and counts[r]; counts may exceed K, then the caller retries with a wider K."""
    n = rays[0].shape[0]
    for b in prange((n + 63) // 64):
        _march_part(b * 64, min(n, (b + 1) * 64), rays, space, grids, lattice, t0, t1, counts)


@njit(parallel=True, **JIT)
def _pack(t0, t1, offsets, out0, out1):  # type: ignore[no-untyped-def]
    for r in prange(len(offsets) - 1):
        for i in range(offsets[r + 1] - offsets[r]):
            out0[offsets[r] + i] = t0[r, i]
            out1[offsets[r] + i] = t1[r, i]


def _offsets(counts: np.ndarray) -> np.ndarray:
    offsets = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=offsets[1:])
    return offsets


def _arrays(rays: Rays3, space: Space) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, np.float32]]:
    return tuple(array(r) for r in rays), (array(space[0].float()), np.float32(space[1]))


def march(
    rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, fine: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.march`."""
    n, room = len(rays[0]), 64
    counts = np.empty(n, np.int64)
    arrays, place = _arrays(rays, space)
    grids = grids_of(grid, fine)
    while True:
        t0, t1 = np.empty((n, room), np.float32), np.empty((n, room), np.float32)
        _march(arrays, place, grids, lattice, t0, t1, counts)
        most = int(counts.max(initial=0))
        if most <= room:
            break
        room = most
    offsets = _offsets(counts)
    out0, out1 = torch.empty(int(offsets[-1])), torch.empty(int(offsets[-1]))
    _pack(t0, t1, offsets, out0.numpy(), out1.numpy())
    return out0, out1, torch.from_numpy(offsets)


# --- waves -----------------------------------------------------------------------------------------------------------


@njit(**JIT)
def _raw_density(features, first, n, sizes, w_in, w_out, x, hidden, raw):  # type: ignore[no-untyped-def]
    """The density network's first output for n <= _BLOCK samples of features (S, F), into raw (n,)."""
    f, h = sizes
    for s in range(n):
        for i in range(f):
            x[s, i] = features[first + s, i]
    product(
        x.ctypes.data, x.shape[1], 1, w_in.ctypes.data, w_in.shape[1],
        hidden.ctypes.data, hidden.shape[1], (n + 7) // 8 * 8, w_in.shape[1], f,
    )  # fmt: skip
    for s in range(n):
        total = _ZERO
        for i in range(h):
            total += max(hidden[s, i], _ZERO) * w_out[i]
        raw[s] = total


@njit(**JIT)
def _wave_part(begin, end, rays, space, grids, lattice, net, arena):  # type: ignore[no-untyped-def]
    """March rays ``begin : end``; the samples, wave by wave, into ``arena``. Returns how many, or -1 without room."""
    tables, resolutions, w_in, w_out, stop = net
    t0, t1, owner, unit, features = arena
    n, far, step = end - begin, np.float32(lattice[1]), np.float32(lattice[2])
    lines, t, tau = np.empty((n, 11), np.float32), np.empty(n, np.float32), np.zeros(n, np.float32)
    alive = np.arange(n)
    x, hidden = np.zeros((_BLOCK, features.shape[1]), np.float32), np.empty((_BLOCK, w_in.shape[1]), np.float32)
    raw = np.empty(_BLOCK, np.float32)
    pair_features = features.view(np.float64)
    for r in range(n):
        t[r] = _start(rays, space, lattice, np.float32(grids[0].shape[0] / 4), begin + r, lines[r])
    total, living = 0, n
    while living > 0:
        if total + living > len(t0):
            return -1
        m = 0
        for a in range(living):
            r = alive[a]
            t[r], dt = _next(lines[r], t[r], far, step, grids, unit[total + m])
            if dt > 0:
                t0[total + m], t1[total + m], owner[total + m] = t[r], t[r] + dt, begin + r
                t[r] += dt
                alive[m] = r
                m += 1
        encode_part(unit, total, total + m, tables, resolutions, pair_features)
        living = 0
        for first in range(0, m, _BLOCK):
            some = min(_BLOCK, m - first)
            _raw_density(features, total + first, some, (features.shape[1], len(w_out)), w_in, w_out, x, hidden, raw)
            for a in range(some):
                r, i = alive[first + a], total + first + a
                tau[r] += exp(min(raw[a], np.float32(15))) / space[1] * (t1[i] - t0[i])
                if tau[r] < stop:
                    alive[living] = r
                    living += 1
        total += m
    return total


@njit(parallel=True, **JIT)
def _waves(rays, space, grids, lattice, net, arena, found):  # type: ignore[no-untyped-def]
    n, parts = rays[0].shape[0], len(found)
    t0, t1, owner, unit, features = arena
    for p in prange(parts):
        mine = (t0[p], t1[p], owner[p], unit[p], features[p])
        found[p] = _wave_part(n * p // parts, n * (p + 1) // parts, rays, space, grids, lattice, net, mine)


@njit(parallel=True, **JIT)
def _count(owner, found, counts):  # type: ignore[no-untyped-def]
    for p in prange(len(found)):
        for i in range(found[p]):
            counts[owner[p, i]] += 1


@njit(parallel=True, **JIT)
def _sort(arena, found, cursor, out):  # type: ignore[no-untyped-def]
    """Wave order -> ray order; a ray's samples came near to far. ``cursor`` starts as the rays' offsets."""
    for p in prange(len(found)):
        for i in range(found[p]):
            to = cursor[arena[2][p, i]]
            cursor[arena[2][p, i]] += 1
            out[0][to], out[1][to], out[2][to] = arena[0][p, i], arena[1][p, i], arena[2][p, i]
            for a in range(3):
                out[3][to, a] = arena[3][p, i, a]
            for c in range(out[4].shape[1]):
                out[4][to, c] = arena[4][p, i, c]


@njit(**JIT)
def _densities_part(unit, net, out):  # type: ignore[no-untyped-def]
    tables, resolutions, w_in, w_out = net
    n = len(out)
    features = np.empty((n, w_in.shape[0]), np.float32)
    encode_part(unit, 0, n, tables, resolutions, features.view(np.float64))
    x, hidden = np.zeros((_BLOCK, w_in.shape[0]), np.float32), np.empty((_BLOCK, w_in.shape[1]), np.float32)
    for first in range(0, n, _BLOCK):
        some = min(_BLOCK, n - first)
        sizes = (w_in.shape[0], len(w_out))
        _raw_density(features, first, some, sizes, w_in, w_out, x, hidden, out[first : first + some])


@njit(parallel=True, **JIT)
def _densities(unit, net, out, parts):  # type: ignore[no-untyped-def]
    n = len(out)
    for p in prange(parts):
        begin, end = n * p // parts, n * (p + 1) // parts
        _densities_part(unit[begin:end], net, out[begin:end])


def hash_density(unit: Tensor, net: DensityNet) -> Tensor:
    """See `reference.hash_density`."""
    out = torch.empty(len(unit))
    # features of a part are held at once
    _densities(array(unit), _network(net), out.numpy(), max(parts_of(len(unit)), len(unit) >> 14))
    return out


def _network(net: DensityNet) -> tuple[Any, ...]:
    """What the loops want of the density network: tables as pairs, first layer transposed and padded."""
    tables, resolutions, w_in, w_out = net
    w = np.zeros((w_in.shape[1], padded(w_in.shape[0])), np.float32)
    w[:, : w_in.shape[0]] = array(w_in).T
    return pairs(tables), np.asarray(resolutions, np.int32), w, array(w_out)


class Marched(NamedTuple):
    """Visible samples in ray order, with what marching had to find out about them. Valid until the next march."""

    t_starts: np.ndarray
    """(S,)"""
    t_ends: np.ndarray
    """(S,)"""
    owners: np.ndarray
    """(S,) int64, the ray of each"""
    unit: np.ndarray
    """(S, 3) midpoints in the contracted cube, scaled to [0, 1]"""
    features: np.ndarray
    """(S, F) their encoding"""
    offsets: np.ndarray
    """(N + 1,)"""


def _room(name: str, parts: int, rows: int, features: int) -> tuple[np.ndarray, ...]:
    pages = {"t0": (), "t1": (), "owner": (), "unit": (3,), "features": (features,)}
    return tuple(
        scratch(f"{name} {page}", (parts, rows, *rest), np.int64 if page == "owner" else np.float32)
        for page, rest in pages.items()
    )


def marched(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    net: DensityNet,
    stop: float,
    fine: Tensor | None = None,
) -> Marched:
    """The waves, packed."""
    arrays, place = _arrays(rays, space)
    inside = (*_network(net), float(stop))
    width = inside[2].shape[0]
    n = len(rays[0])
    parts = min(4 * get_num_threads(), n // 128 + 1)  # rays differ in length: some parts more than threads
    room = _ROOM * (n // parts + 1)
    found = np.zeros(parts, np.int64)
    grids = grids_of(grid, fine)
    while True:
        arena = _room("waves", parts, room, width)
        _waves(arrays, place, grids, lattice, inside, arena, found)
        if found.min() >= 0:
            break
        room *= 4
    counts = np.zeros(n, np.int64)
    _count(arena[2], found, counts)
    offsets = _offsets(counts)
    t0, t1, owners, unit, features = (page[0] for page in _room("sorted", 1, int(offsets[-1]), width))
    _sort(arena, found, offsets[:-1].copy(), (t0, t1, owners, unit, features))
    return Marched(t0, t1, owners, unit, features, offsets)


def march_visible(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    net: DensityNet,
    stop: float,
    fine: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.march_visible`."""
    found = marched(rays, space, grid, lattice, net, stop, fine)
    kept = (found.t_starts.copy(), found.t_ends.copy(), found.offsets)
    return torch.from_numpy(kept[0]), torch.from_numpy(kept[1]), torch.from_numpy(kept[2])
