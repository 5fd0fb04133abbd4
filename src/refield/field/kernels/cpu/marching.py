"""Where to look along rays, on the CPU: lattice, occupancy grid and, where wanted, the density network.

With the network, a thread's rays advance together in waves, each by one occupied sample: so the encoding and the
network see hundreds of samples at once, and a ray stops after the wave in which it became opaque.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from refield.field.kernels.cpu.cells import grids_of
from refield.field.kernels.cpu.encoding import array, encode_part, held, pairs, parts_of, scratch
from refield.field.kernels.cpu.lanes import new_lanes, next_samples
from refield.field.kernels.cpu.networks import padded
from refield.field.kernels.cpu.simd import JIT, exp, product
from refield.field.kernels.cpu.walk import next_sample, start
from refield.field.kernels.onward import Way
from refield.field.kernels.reference import EVERYWHERE, DensityNet, Lattice, Rays3, Space, Within
from refield.scene.inside import above

_ZERO = np.float32(0)
_BLOCK = 128  # samples whose hidden layer is held at once
_NO_WAY = (*(np.zeros(0, np.float32) for _ in range(3)), np.zeros((0, 0, 0), np.uint8))
_ROOM = 32  # samples a ray that are made room for at first


@njit(**JIT)
def _march_part(begin, end, rays, space, grids, lattice, t0, t1, counts):  # type: ignore[no-untyped-def]
    far, step = np.float32(lattice[1]), np.float32(lattice[2])
    ray, unit = np.empty(11, np.float32), np.empty(3, np.float32)
    for r in range(begin, end):
        t = start(rays, space, lattice, np.float32(grids[0].shape[0] / 4), r, ray)
        found = 0
        while True:
            t, dt = next_sample(ray, t, far, step, grids, unit)
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
def _meant(x, y, z, within):  # type: ignore[no-untyped-def]
    """Whether a sample at a place is ``within``, see `reference.Within`."""
    boxes, shapes, firsts, values, inside = within
    for g in range(len(boxes)):
        many = shapes[g, 0] * shapes[g, 1] * shapes[g, 2]
        nodes = values[firsts[g] : firsts[g] + many].reshape((shapes[g, 0], shapes[g, 1], shapes[g, 2]))
        if above(nodes, boxes[g], np.float32(0.5), x, y, z) != inside:
            return False
    return True


@njit(**JIT)
def _sift(begin, m, rays, within, alive, wave, aside):  # type: ignore[no-untyped-def]
    """Keep those of a wave's m samples that are ``within``; the rays of the others come to ``aside``. How many each."""
    t0, t1, unit = wave
    origins, directions, _ = rays
    kept, others = 0, 0
    for a in range(m):
        r, mid = alive[a], (t0[a] + t1[a]) / np.float32(2)
        x = origins[begin + r, 0] + directions[begin + r, 0] * mid
        y = origins[begin + r, 1] + directions[begin + r, 1] * mid
        z = origins[begin + r, 2] + directions[begin + r, 2] * mid
        if _meant(x, y, z, within):
            alive[kept], t0[kept], t1[kept] = r, t0[a], t1[a]
            for c in range(3):
                unit[kept, c] = unit[a, c]
            kept += 1
        else:
            aside[others] = r
            others += 1
    return kept, others


@njit(**JIT)
def _wave_part(begin, end, rays, space, grids, lattice, net, way, within, arena):  # type: ignore[no-untyped-def]
    """March rays ``begin : end``; the samples, wave by wave, into ``arena``. Returns how many, or -1 without room.

    ``way`` is what `onward.Way` says, or empty arrays; where rays came to is written over its ``t`` and ``depth``.
    ``within``: what `reference.Within` says.
    """
    tables, resolutions, w_in, w_out, stop = net
    t0, t1, owner, unit, features = arena
    under_way, until, depth, gone = way
    n, step = end - begin, np.float32(lattice[2])
    lines, t, tau = np.empty((n, 11), np.float32), np.empty(n, np.float32), np.zeros(n, np.float32)
    far = np.full(n, np.float32(lattice[1]))
    alive, aside, lanes = np.arange(n), np.empty(n if len(within[0]) > 0 else 0, np.int64), new_lanes()
    x, hidden = np.zeros((_BLOCK, features.shape[1]), np.float32), np.empty((_BLOCK, w_in.shape[1]), np.float32)
    raw = np.empty(_BLOCK, np.float32)
    pair_features = features.view(np.float64)
    for r in range(n):
        t[r] = start(rays, space, lattice, np.float32(grids[0].shape[0] / 4), begin + r, lines[r])
        if len(under_way) > 0:
            t[r], tau[r], far[r] = under_way[begin + r], depth[begin + r], min(far[r], until[begin + r])
    total, living = 0, n
    while living > 0:
        if total + living > len(t0):
            return -1
        out = (t0[total:], t1[total:], owner[total:], unit[total:])
        m, others = next_samples(alive[:living], lines, t, far, step, grids, gone, lanes, out), 0
        if len(within[0]) > 0:
            m, others = _sift(begin, m, rays, within, alive, (out[0], out[1], out[3]), aside)
        encode_part(unit, total, total + m, tables, resolutions, pair_features)
        living = 0
        for first in range(0, m, _BLOCK):
            some = min(_BLOCK, m - first)
            _raw_density(features, total + first, some, (features.shape[1], len(w_out)), w_in, w_out, x, hidden, raw)
            for a in range(some):
                r, i = alive[first + a], total + first + a
                tau[r] += exp(min(raw[a], np.float32(15))) / space[1] * (t1[i] - t0[i])
                owner[i] = begin + r
                if tau[r] < stop:
                    alive[living] = r
                    living += 1
        for a in range(others):
            alive[living + a] = aside[a]
        living += others
        total += m
    if len(under_way) > 0:
        under_way[begin:end], depth[begin:end] = t, tau
    return total


@njit(parallel=True, **JIT)
def _waves(rays, space, grids, lattice, net, way, within, arena, found):  # type: ignore[no-untyped-def]
    n, parts = rays[0].shape[0], len(found)
    t0, t1, owner, unit, features = arena
    for p in prange(parts):
        mine = (t0[p], t1[p], owner[p], unit[p], features[p])
        found[p] = _wave_part(n * p // parts, n * (p + 1) // parts, rays, space, grids, lattice, net, way, within, mine)


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
def _raw_densities(features, begin, end, net, out):  # type: ignore[no-untyped-def]
    """The density network's first output for features[begin:end], into out[begin:end]."""
    _, _, w_in, w_out = net
    x, hidden = np.zeros((_BLOCK, w_in.shape[0]), np.float32), np.empty((_BLOCK, w_in.shape[1]), np.float32)
    sizes = (w_in.shape[0], len(w_out))
    for first in range(begin, end, _BLOCK):
        some = min(_BLOCK, end - first)
        _raw_density(features, first, some, sizes, w_in, w_out, x, hidden, out[first : first + some])


@njit(**JIT)
def _densities_part(unit, net, out):  # type: ignore[no-untyped-def]
    features = np.empty((len(out), net[2].shape[0]), np.float32)
    encode_part(unit, 0, len(out), net[0], net[1], features.view(np.float64))
    _raw_densities(features, 0, len(out), net, out)


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
    way: Way | None = None,
    within: Within = EVERYWHERE,
) -> Marched:
    """The waves, packed. Where rays came to is written over the ``t`` and ``depth`` of a ``way``."""
    arrays, place = _arrays(rays, space)
    inside = (*_network(net), float(stop))
    width = inside[2].shape[0]
    n = len(rays[0])
    parts = min(4 * get_num_threads(), n // 128 + 1)  # rays differ in length: some parts more than threads
    room = max(_ROOM * (n // parts + 1), held("waves owner") // parts)  # a march that needed more is not the last
    found = np.zeros(parts, np.int64)
    grids = grids_of(grid, fine)
    meant = (*(array(a) for a in within[:4]), within.inside)
    while True:
        arena = _room("waves", parts, room, width)
        on = _NO_WAY if way is None else (*(array(a).copy() for a in way[:3]), array(way.gone))
        _waves(arrays, place, grids, lattice, inside, on, meant, arena, found)
        if found.min() >= 0:
            break
        room *= 4
    counts = np.zeros(n, np.int64)
    _count(arena[2], found, counts)
    if way is not None:
        way.t.copy_(torch.from_numpy(on[0]))
        way.depth.copy_(torch.from_numpy(on[2]))
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


@njit(parallel=True, **JIT)
def _densities_at(features, net, radius, out, parts):  # type: ignore[no-untyped-def]
    """The densities of features (S, F), per world unit, into out (S,)."""
    n = len(out)
    for p in prange(parts):
        begin, end = n * p // parts, n * (p + 1) // parts
        _raw_densities(features, begin, end, net, out)
        for s in range(begin, end):
            out[s] = exp(min(out[s], np.float32(15))) / radius


def march_within(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    net: DensityNet,
    stop: float,
    fine: Tensor | None,
    within: Within,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `reference.march_within`."""
    found = marched(rays, space, grid, lattice, net, stop, fine, within=within)
    sigmas = torch.empty(len(found.t_starts))
    _densities_at(found.features, _network(net), np.float32(space[1]), sigmas.numpy(), parts_of(len(sigmas)))
    t0, t1 = torch.from_numpy(found.t_starts.copy()), torch.from_numpy(found.t_ends.copy())
    return t0, t1, sigmas, torch.from_numpy(found.offsets)
