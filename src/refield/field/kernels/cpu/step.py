"""A whole training step on the CPU: what is computed for some rays is used while it is still in the cache.

March (with the encoding) → for each group of rays: networks, compositing, loss and back again → scatter into tables.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from refield.field.kernels.cpu.encoding import array, encode_backward, pairs, scratch
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
from refield.field.kernels.reference import Aim, Batch, Lattice, Networks, Space, Stepped

_ZERO, _ONE, _TWO, _THREE = np.float32(0), np.float32(1), np.float32(2), np.float32(3)


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


@njit(**JIT)
def _along_ray(first, n, at, rgb, scratch, aim, told, w, sigma, to_raw, to_rgb):  # type: ignore[no-untyped-def]
    """Composite a ray's n samples, compare, and write the gradients of the loss; returns the ray's share of the loss.

    ``rgb``, ``scratch``, ``to_raw`` and ``to_rgb`` are the block's, in which the ray begins at ``at``; w and sigma are
    the step's, in which it begins at ``first``.
    """
    radius, strength, _, rays = aim
    truth, background = told
    passes, mids, lengths, nears, deltas = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    red = green = blue = mass = moment = _ZERO
    clear = _ONE
    for i in range(n):
        j, k = first + i, at + i
        w[j] = clear * (_ONE - passes[k])
        clear *= passes[k]
        red, green, blue = red + w[j] * rgb[k, 0], green + w[j] * rgb[k, 1], blue + w[j] * rgb[k, 2]
        mass, moment = mass + w[j], moment + w[j] * mids[k]
    empty = _ONE - mass
    d0 = red + empty * background[0] - truth[0]
    d1 = green + empty * background[1] - truth[1]
    d2 = blue + empty * background[2] - truth[2]
    g = _TWO / (_THREE * rays)
    g0, g1, g2 = g * d0, g * d1, g * d2
    behind = g0 * background[0] + g1 * background[1] + g2 * background[2]
    spread = before = moment_before = total = _ZERO
    for i in range(n):  # to_raw holds dL / dw_i for now
        j, k = first + i, at + i
        mid, length = mids[k], lengths[k]
        left = mid * before - moment_before
        before, moment_before = before + w[j], moment_before + w[j] * mid
        right = (moment - moment_before) - mid * (mass - before)
        spread += _TWO * w[j] * left + w[j] * w[j] * length / _THREE
        slope = _TWO * (left + right) + _TWO * w[j] * length / _THREE
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
    return (d0 * d0 + d1 * d1 + d2 * d2) / (_THREE * rays) + strength * spread / rays


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
    directions, colours, background = batch
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
            told = (colours[q], background[q])
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
    told = (array(batch.rays[1]), array(batch.colours), array(batch.background))

    def through(*rest):  # type: ignore[no-untyped-def]
        _through(tuple(found), told, *rest)

    rays = len(batch.colours)
    return scattered(found, find_cells(found.unit, resolution), rays, field, toward(aim, space, rays), into, through)


def toward(aim: Aim, space: Space, rays: int) -> tuple[np.float32, ...]:
    """What the loops want to know of the aim."""
    radius, strength, unit, count = (np.float32(x) for x in (space[1], aim.distortion, aim.gradient_unit, rays))
    return radius, strength, unit, count


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
    to_features = scratch("to features", found.features.shape)
    outs = (w.numpy(), sigmas.numpy(), to_features)
    bounds = np.searchsorted(found.offsets, n * np.arange(len(losses) + 1) // len(losses))
    bounds[-1] = rays  # those without a sample, too
    through(sizes_of(networks), packed, aim, outs, sums, bounds, losses)
    encode_backward(found.unit, to_features.view(np.float64), np.asarray(resolutions, np.int32), pairs(into[0]))
    for total, grad in zip(into[1:], unpack(tuple(s.sum(0) for s in sums), networks)):
        total += grad
    return Stepped(float(losses.sum()), cells, w, sigmas, rays)


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
