"""A whole training step on the CPU: what is computed for some rays is used while it is still in the cache.

March (with the encoding) → for each group of rays: networks, compositing, loss and back again → scatter into tables.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from refield.field.kernels.cpu.encoding import array, encode_backward, encode_slope, pairs, scratch
from refield.field.kernels.cpu.marching import Marched, marched
from refield.field.kernels.cpu.networks import (
    BLOCK,
    backward_block,
    forward_block,
    group_sums,
    pack,
    room_for,
    sizes_of,
    unpack,
)
from refield.field.kernels.cpu.simd import JIT, exp
from refield.field.kernels.reference import BURNT, Aim, Batch, Lattice, Networks, Space, Stepped

_ZERO, _ONE, _TWO, _THREE = np.float32(0), np.float32(1), np.float32(2), np.float32(3)
_BURNT = np.float32(BURNT)
_TO_FEATURES = "to features"  # the scratch in which a step leaves the gradients of its samples' features


@njit(**JIT)
def prepare(first, n, raw, t0, t1, radius, unit, sigma, scratch):  # type: ignore[no-untyped-def]
    """What each sample of a block needs, in straight loops: its density, and five numbers into ``scratch`` (5, n)."""
    clear, mid, length, near, delta = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    for k in range(n):
        a, b = t0[first + k], t1[first + k]
        delta[k] = b - a
        s0, s1 = a / (a + radius), b / (b + radius)
        mid[k], length[k] = (s0 + s1) / _TWO, s1 - s0
        close = min((a + b) / (_TWO * unit), _ONE)
        near[k] = close * close
        density = exp(min(raw[k], np.float32(15))) / radius
        sigma[first + k] = density
        clear[k] = exp(-density * (b - a))


@njit(forceinline=True, **JIT)
def _off(seen, truth):  # type: ignore[no-untyped-def]
    """Error of a colour; none where the photo is burnt out and what is seen is brighter."""
    return _ZERO if truth > _BURNT and seen > truth else seen - truth


@njit(**JIT)
def _along_ray(first, n, at, rgb, scratch, aim, told, w, sigma, to_raw, to_rgb):  # type: ignore[no-untyped-def]
    """Composite a ray's n samples, compare, and write the gradients of the loss; returns the ray's share of the loss.

    ``rgb``, ``scratch``, ``to_raw`` and ``to_rgb`` are the block's, in which the ray begins at ``at``; w and sigma are
    the step's, in which it begins at ``first``. ``told`` ends with where to write
    what is shown and the error, (3,) each, and the heaviest sample, (1,).
    """
    radius, strength, _, rays, nearness = aim
    truth, background, gain, trust, shown, error, heaviest = told
    passes, mids, lengths, nears, deltas = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    red = green = blue = mass = moment = most = _ZERO
    clear = _ONE
    heaviest[0] = -1
    for i in range(n):
        j, k = first + i, at + i
        w[j] = clear * (_ONE - passes[k])
        if w[j] > most or heaviest[0] < 0:
            most, heaviest[0] = w[j], j
        clear *= passes[k]
        red, green, blue = red + w[j] * rgb[k, 0], green + w[j] * rgb[k, 1], blue + w[j] * rgb[k, 2]
        mass, moment = mass + w[j], moment + w[j] * mids[k]
    empty = _ONE - mass
    d0 = _off(gain[0] * red + empty * background[0], truth[0])
    d1 = _off(gain[1] * green + empty * background[1], truth[1])
    d2 = _off(gain[2] * blue + empty * background[2], truth[2])
    shown[0], shown[1], shown[2] = red, green, blue
    error[0], error[1], error[2] = d0, d1, d2
    g = _TWO * trust / (_THREE * rays)
    g0, g1, g2 = g * d0, g * d1, g * d2
    behind = g0 * background[0] + g1 * background[1] + g2 * background[2]
    g0, g1, g2 = g0 * gain[0], g1 * gain[1], g2 * gain[2]
    spread = before = moment_before = total = _ZERO
    for i in range(n):  # to_raw holds dL / dw_i for now
        j, k = first + i, at + i
        mid, length = mids[k], lengths[k]
        left = mid * before - moment_before
        before, moment_before = before + w[j], moment_before + w[j] * mid
        right = (moment - moment_before) - mid * (mass - before)
        spread += _TWO * w[j] * left + w[j] * w[j] * length / _THREE
        slope = _TWO * (left + right) + _TWO * w[j] * length / _THREE + nearness * (_ONE - mid)
        to_raw[k] = g0 * rgb[k, 0] + g1 * rgb[k, 1] + g2 * rgb[k, 2] - behind + strength * slope / rays
        total += w[j] * to_raw[k]
        share = w[j] * nears[k]
        to_rgb[k, 0], to_rgb[k, 1], to_rgb[k, 2] = g0 * share, g1 * share, g2 * share
    clear = _ONE
    for i in range(n):  # dL / dsigma_i = delta_i (T_{i+1} g_i - sum_{j>i} w_j g_j)
        j, k = first + i, at + i
        clear *= passes[k]
        total -= w[j] * to_raw[k]
        grown = min(sigma[j], np.float32(3e4) / radius)
        to_raw[k] = deltas[k] * (clear * to_raw[k] - total) * nears[k] * grown
    spread += nearness * (mass - moment)
    return trust * (d0 * d0 + d1 * d1 + d2 * d2) / (_THREE * rays) + strength * spread / rays


@njit(**JIT)
def take_block(r, end, longest, directions, offsets, d):  # type: ignore[no-untyped-def]
    """Ray ``r`` and those behind it up to ``longest`` samples: the first that no longer fits; directions go into d."""
    first, last = offsets[r], r + 1
    while last < end and offsets[last + 1] - first <= longest:
        last += 1
    for q in range(r, last):
        for i in range(offsets[q] - first, offsets[q + 1] - first):
            d[i, 0], d[i, 1], d[i, 2] = directions[q, 0], directions[q, 1], directions[q, 2]
    return last


@njit(**JIT)
def _group(begin, end, found, batch, sizes, packed, aim, outs, sums):  # type: ignore[no-untyped-def]
    """Rays ``begin : end`` forward and back, some at a time; returns their share of the loss."""
    t0, t1, _, _, features, offsets = found
    directions, colours, background, gains, trust, shown, errors, heaviest = batch
    w, sigma, to_features = outs
    longest = BLOCK
    for r in range(begin, end):
        longest = max(longest, offsets[r + 1] - offsets[r])
    room, back = room_for(longest, packed), room_for(longest, packed)
    d, scratch = np.empty((longest, 3), np.float32), np.empty((5, longest), np.float32)
    to_raw, to_rgb = np.empty(longest, np.float32), np.empty((longest, 3), np.float32)
    loss, last = 0.0, begin
    while last < end:
        r, first = last, offsets[last]
        last = take_block(r, end, longest, directions, offsets, d)
        n = offsets[last] - first
        forward_block(features[first : first + n], d[:n], sizes, packed, room)
        prepare(first, n, room[2][:, 0], t0, t1, aim[0], aim[2], sigma, scratch)
        for q in range(r, last):
            told = (colours[q], background[q], gains[q], trust[q], shown[q], errors[q], heaviest[q : q + 1])
            loss += _along_ray(
                offsets[q], offsets[q + 1] - offsets[q], offsets[q] - first,
                room[5], scratch, aim, told, w, sigma, to_raw, to_rgb,
            )  # fmt: skip
        backward_block(to_raw[:n], to_rgb[:n], sizes, packed, room, back, sums, to_features[first : first + n])
    return loss


@njit(parallel=True, **JIT)
def _through(found, batch, sizes, packed, aim, outs, all_sums, bounds, losses):  # type: ignore[no-untyped-def]
    """Every group of rays; gradients of the networks into its own sums."""
    for g in prange(len(losses)):
        sums = (all_sums[0][g], all_sums[1][g], all_sums[2][g], all_sums[3][g], all_sums[4][g])
        losses[g] = _group(bounds[g], bounds[g + 1], found, batch, sizes, packed, aim, outs, sums)


def train_step(
    batch: Batch,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    aim: Aim,
    into: list[Tensor],
    fine: Tensor | None = None,
) -> Stepped:
    """See `reference.train_step`."""
    tables, resolutions, networks = field
    net = (tables, resolutions, networks[0], networks[1][0])
    found = marched(batch.rays, space, grid, lattice, net, aim.stop, fine)
    done = after_march(found, batch, space, grid.shape[0], field, aim, into)
    return done._replace(parts=find_parts(found.unit, grid.shape[0]))


def after_march(
    found: Marched,
    batch: Batch,
    space: Space,
    resolution: int,
    field: tuple[Tensor, tuple[int, ...], Networks],
    aim: Aim,
    into: list[Tensor],
) -> Stepped:
    """The rest of the step, for the samples that marching found; ``resolution``: cells a side of the grid."""
    rays = len(batch.colours)
    gains = np.ones((rays, 3), np.float32) if batch.gains is None else array(batch.gains)
    trust = np.ones(rays, np.float32) if batch.trust is None else array(batch.trust)
    shown, errors, heaviest = torch.empty(rays, 3), torch.empty(rays, 3), torch.empty(rays, dtype=torch.long)
    told = (array(batch.rays[1]), array(batch.colours), array(batch.background), gains, trust)

    def through(*rest):  # type: ignore[no-untyped-def]
        _through(tuple(found), (*told, shown.numpy(), errors.numpy(), heaviest.numpy()), *rest)

    cells = find_cells(found.unit, resolution)
    done = scattered(found, cells, rays, field, toward(aim, space, rays), into, through)
    to_rays = ray_gradients(found, batch, space, field[0], field[1]) if batch.moving else None
    return done._replace(shown=shown, errors=errors, heaviest=heaviest, to_rays=to_rays)


def toward(aim: Aim, space: Space, rays: int) -> tuple[np.float32, ...]:
    """What the loops want to know of the aim."""
    radius, strength, unit, count, nearness = (
        np.float32(x) for x in (space[1], aim.distortion, aim.gradient_unit, rays, float(aim.nearness))
    )
    return radius, strength, unit, count, nearness


def scattered(
    found: Marched,
    cells: Tensor,
    rays: int,
    field: tuple[Tensor, tuple[int, ...], Networks],
    aim: tuple[np.float32, ...],
    into: list[Tensor],
    through: Callable[..., None],
) -> Stepped:
    """Go ``through`` all rays, in groups of about as many samples, and add the gradients up."""
    _, resolutions, networks = field
    n = len(found.t_starts)
    packed = pack(networks)
    sums = group_sums(packed)
    w, sigmas, losses = torch.empty(n), torch.empty(n), np.zeros(sums[0].shape[0])
    to_features = scratch(_TO_FEATURES, found.features.shape)
    outs = (w.numpy(), sigmas.numpy(), to_features)
    bounds = np.searchsorted(found.offsets, n * np.arange(len(losses) + 1) // len(losses))
    bounds[-1] = rays  # those without a sample, too
    through(sizes_of(networks), packed, aim, outs, sums, bounds, losses)
    encode_backward(found.unit, to_features.view(np.float64), np.asarray(resolutions, np.int32), pairs(into[0]))
    for total, grad in zip(into[1:], unpack(tuple(s.sum(0) for s in sums), networks)):
        total += grad
    return Stepped(float(losses.sum()), cells, w, sigmas, rays)


def ray_gradients(
    found: Marched, batch: Batch, space: Space, tables: Tensor, resolutions: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """How the loss changes with origins and directions of the first rays of the step just taken, (moving, 3) each."""
    rays, ends = batch.moving, found.offsets
    n = int(ends[rays])
    to_unit = scratch("to unit", (n, 3))
    to_features = scratch(_TO_FEATURES, found.features.shape)
    res = np.asarray(resolutions, np.int32)
    encode_slope(found.unit[:n], array(tables), res, to_features[:n], to_unit)
    to_origins, to_directions = torch.empty(rays, 3), torch.empty(rays, 3)
    lines, place = (array(batch.rays[0]), array(batch.rays[1])), (array(space[0].float()), np.float32(space[1]))
    told = (found.t_starts, found.t_ends, ends)
    _to_rays(lines, place, told, to_unit, to_origins.numpy(), to_directions.numpy())
    return to_origins, to_directions


@njit(parallel=True, **JIT)
def _to_rays(lines, space, told, to_unit, to_origins, to_directions):  # type: ignore[no-untyped-def]
    for r in prange(len(to_origins)):
        _to_ray(r, lines, space, told, to_unit, to_origins[r], to_directions[r])


@njit(**JIT)
def _to_ray(r, lines, space, told, to_unit, to_origin, to_direction):  # type: ignore[no-untyped-def]
    """Sums one ray's samples: their places go through the contraction, (y + 2) / 4 of which is the unit cube."""
    t0, t1, offsets = told
    centre, radius = space
    u, g = np.empty(3, np.float32), np.empty(3, np.float32)
    to_origin[:], to_direction[:] = _ZERO, _ZERO
    for i in range(offsets[r], offsets[r + 1]):
        mid = (t0[i] + t1[i]) / _TWO
        m, axis = _ZERO, 0
        for a in range(3):
            u[a] = (lines[0][r, a] + lines[1][r, a] * mid - centre[a]) / radius
            if abs(u[a]) > m:
                m, axis = abs(u[a]), a
        scale, along = np.float32(0.25) / radius, _ZERO
        for a in range(3):
            g[a] = to_unit[i, a] * scale
            along += g[a] * u[a]
        if m > 1:
            k = (_TWO - _ONE / m) / m
            bend = (_TWO / (m * m * m) - _TWO / (m * m)) * along
            for a in range(3):
                g[a] *= k
            g[axis] += bend if u[axis] > 0 else -bend
        for a in range(3):
            to_origin[a] += g[a]
            to_direction[a] += mid * g[a]


def find_cells(unit: np.ndarray, resolution: int) -> Tensor:
    """Flat index (S,) int64 of the grid cell that holds each position (S, 3) in [0, 1]."""
    cells = torch.empty(len(unit), dtype=torch.int64)
    _find_cells(unit, resolution, cells.numpy())
    return cells


@njit(parallel=True, **JIT)
def _find_cells(unit, r, out):  # type: ignore[no-untyped-def]
    for s in prange(len(out)):
        i, j, k = int(unit[s, 0] * r), int(unit[s, 1] * r), int(unit[s, 2] * r)
        i, j, k = max(min(i, r - 1), 0), max(min(j, r - 1), 0), max(min(k, r - 1), 0)
        out[s] = (i * r + j) * r + k


def find_parts(unit: np.ndarray, resolution: int) -> Tensor:
    """Which of its cell's 4^3 sub-cells each position (S, 3) in [0, 1] is in, (S,) int64: see `reference.marked`."""
    parts = torch.empty(len(unit), dtype=torch.int64)
    _find_parts(unit, resolution, parts.numpy())
    return parts


@njit(parallel=True, **JIT)
def _find_parts(unit, r, out):  # type: ignore[no-untyped-def]
    last = 4 * r - 1
    for s in prange(len(out)):
        i, j, k = int(unit[s, 0] * r * 4), int(unit[s, 1] * r * 4), int(unit[s, 2] * r * 4)
        i, j, k = max(min(i, last), 0) & 3, max(min(j, last), 0) & 3, max(min(k, last), 0) & 3
        out[s] = (i * 4 + j) * 4 + k
