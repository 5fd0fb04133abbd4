"""A whole training step of a helper on the CPU: as `step`, with what is fixed along each ray between its samples."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from refield.field.kernels.cpu.encoding import array
from refield.field.kernels.cpu.marching import marched
from refield.field.kernels.cpu.networks import BLOCK, backward_block, forward_block, room_for
from refield.field.kernels.cpu.simd import JIT, exp
from refield.field.kernels.cpu.step import find_cells, prepare, scattered, take_block, toward
from refield.field.kernels.reference import Aim, Batch, Fixed, Lattice, Networks, Space, Stepped, Unwanted

_ZERO, _ONE, _TWO, _THREE = np.float32(0), np.float32(1), np.float32(2), np.float32(3)


@njit(**JIT)
def _along_ray(first, n, at, rgb, scratch, fixed, wrong, aim, told, row, w, sigma, to_raw, to_rgb):  # type: ignore[no-untyped-def]
    """`step`'s for a ray's n samples and the fixed segments between them; returns the ray's share of the loss.

    ``row`` (5, M) and its places (M,) are room for the two put together: what passes, the place, the length, the
    weight and its gradient of each; ``told`` begins with the samples' ends and the ray's own segments.
    """
    radius, strength, _, rays, nearness = aim
    t0, t1, own_fixed, end_fixed, truth, background = told
    t_mid, depth, colours = fixed
    passes, mids, lengths, nears, deltas = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    (passed, place, long, weight, slope), which = row
    red = green = blue = mass = moment = _ZERO
    clear = _ONE
    i, j, m = 0, own_fixed, 0
    while i < n or j < end_fixed:
        if i < n and (j >= end_fixed or (t0[first + i] + t1[first + i]) / _TWO <= t_mid[j]):
            k = at + i
            passed[m], place[m], long[m] = passes[k], mids[k], lengths[k]
            r, g, b = rgb[k, 0], rgb[k, 1], rgb[k, 2]
            which[m] = i
            i += 1
        else:
            passed[m], place[m], long[m] = exp(-depth[j]), t_mid[j] / (t_mid[j] + radius), _ZERO
            r, g, b = colours[j, 0], colours[j, 1], colours[j, 2]
            which[m] = -1 - j
            j += 1
        weight[m] = clear * (_ONE - passed[m])
        clear *= passed[m]
        red, green, blue = red + weight[m] * r, green + weight[m] * g, blue + weight[m] * b
        mass, moment = mass + weight[m], moment + weight[m] * place[m]
        m += 1
    empty = _ONE - mass
    d0 = red + empty * background[0] - truth[0]
    d1 = green + empty * background[1] - truth[1]
    d2 = blue + empty * background[2] - truth[2]
    g = _TWO / (_THREE * rays)
    g0, g1, g2 = g * d0, g * d1, g * d2
    behind = g0 * background[0] + g1 * background[1] + g2 * background[2]
    spread = before = moment_before = total = misplaced = _ZERO
    for q in range(m):
        mid, length, here = place[q], long[q], weight[q]
        left = mid * before - moment_before
        before, moment_before = before + here, moment_before + here * mid
        right = (moment - moment_before) - mid * (mass - before)
        spread += _TWO * here * left + here * here * length / _THREE
        apart = _TWO * (left + right) + _TWO * here * length / _THREE
        steep = strength * (apart + nearness * (_ONE - mid)) / rays
        if which[q] >= 0:
            k, s = at + which[q], first + which[q]
            share = here * nears[k]
            to_rgb[k, 0], to_rgb[k, 1], to_rgb[k, 2] = g0 * share, g1 * share, g2 * share
            steep += g0 * rgb[k, 0] + g1 * rgb[k, 1] + g2 * rgb[k, 2] + wrong[s] / rays
            misplaced += here * wrong[s]
            w[s] = here
        else:
            k = -1 - which[q]
            steep += g0 * colours[k, 0] + g1 * colours[k, 1] + g2 * colours[k, 2]
        slope[q] = steep - behind
        total += here * slope[q]
    clear = _ONE
    for q in range(m):  # dL / dsigma_i = delta_i (T_{i+1} g_i - sum_{j>i} w_j g_j)
        clear *= passed[q]
        total -= weight[q] * slope[q]
        if which[q] >= 0:
            k, s = at + which[q], first + which[q]
            grown = min(sigma[s], np.float32(3e4) / radius)
            to_raw[k] = deltas[k] * (clear * slope[q] - total) * nears[k] * grown
    spread += nearness * (mass - moment)
    return (d0 * d0 + d1 * d1 + d2 * d2) / (_THREE * rays) + (strength * spread + misplaced) / rays


@njit(**JIT)
def _group(begin, end, found, batch, fixed, chosen, wrong, sizes, packed, aim, outs, sums):  # type: ignore[no-untyped-def]
    """Rays ``begin : end`` forward and back, some at a time; returns their share of the loss."""
    t0, t1, _, _, features, offsets = found
    directions, colours, background = batch
    t_mid, depth, shown, own = fixed
    w, sigma, to_features = outs
    longest, most = BLOCK, 0
    for r in range(begin, end):
        longest = max(longest, offsets[r + 1] - offsets[r])
        most = max(most, own[chosen[r] + 1] - own[chosen[r]])
    room, back = room_for(longest, packed), room_for(longest, packed)
    d, scratch = np.empty((longest, 3), np.float32), np.empty((5, longest), np.float32)
    to_raw, to_rgb = np.empty(longest, np.float32), np.empty((longest, 3), np.float32)
    row = (np.empty((5, longest + most), np.float32), np.empty(longest + most, np.int64))
    loss, last = 0.0, begin
    while last < end:
        r, first = last, offsets[last]
        last = take_block(r, end, longest, directions, offsets, d)
        n = offsets[last] - first
        forward_block(features[first : first + n], d[:n], sizes, packed, room)
        prepare(first, n, room[2][:, 0], t0, t1, aim[0], aim[2], sigma, scratch)
        for q in range(r, last):
            told = (t0, t1, own[chosen[q]], own[chosen[q] + 1], colours[q], background[q])
            parts = ((row[0][0], row[0][1], row[0][2], row[0][3], row[0][4]), row[1])
            loss += _along_ray(
                offsets[q], offsets[q + 1] - offsets[q], offsets[q] - first, room[5], scratch,
                (t_mid, depth, shown), wrong, aim, told, parts, w, sigma, to_raw, to_rgb,
            )  # fmt: skip
        backward_block(to_raw[:n], to_rgb[:n], sizes, packed, room, back, sums, to_features[first : first + n])
    return loss


@njit(parallel=True, **JIT)
def _through(found, batch, fixed, chosen, wrong, sizes, packed, aim, outs, all_sums, bounds, losses):  # type: ignore[no-untyped-def]
    """Every group of rays; gradients of the networks into its own sums."""
    for g in prange(len(losses)):
        sums = (all_sums[0][g], all_sums[1][g], all_sums[2][g], all_sums[3][g], all_sums[4][g])
        losses[g] = _group(bounds[g], bounds[g + 1], found, batch, fixed, chosen, wrong, sizes, packed, aim, outs, sums)


def woven_step(
    batch: Batch,
    fixed: Fixed,
    unwanted: Unwanted,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    aim: Aim,
    into: list[Tensor],
    fine: Tensor | None = None,
) -> Stepped:
    """See `reference.woven_step`."""
    tables, resolutions, networks = field
    net = (tables, resolutions, networks[0], networks[1][0])
    found = marched(batch.rays, space, grid, lattice, net, aim.stop, fine)
    if unwanted.taken is not None and len(found.t_starts):
        t0, t1 = torch.from_numpy(found.t_starts), torch.from_numpy(found.t_ends)
        ids = torch.from_numpy(found.owners)
        x = batch.rays[0][ids] + batch.rays[1][ids] * ((t0 + t1) / 2)[:, None]
        t1.copy_(torch.where(unwanted.taken(x), t0, t1))  # no length: no opacity, no gradient
    cells = find_cells(found.unit, grid.shape[0])
    wrong = array(unwanted.misplaced)[cells.numpy()]
    segments = tuple(array(t) for t in fixed[:4])
    told = (array(batch.rays[1]), array(batch.colours), array(batch.background))

    def through(*rest):  # type: ignore[no-untyped-def]
        _through(tuple(found), told, segments, array(fixed.chosen), wrong, *rest)

    rays = len(batch.colours)
    done = scattered(found, cells, rays, field, toward(aim, space, rays), into, through)
    if unwanted.taken is None:
        return done
    asked = torch.from_numpy(found.t_ends > found.t_starts)
    return Stepped(done.loss, cells[asked], done.weights[asked], done.sigmas[asked], rays)
