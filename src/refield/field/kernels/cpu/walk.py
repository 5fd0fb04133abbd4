"""A ray's way through the occupancy grid, one sample after the other: what all marching on the CPU is made of."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from refield.field.kernels.cpu.simd import JIT

_ZERO, _ONE, _TWO, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
_FINE = np.float32(4)  # sub-cells a side of a cell
STRETCH = np.float32(0.75)  # the contraction lengthens nothing by more than 4/3


@njit(forceinline=True, **JIT)
def _leave(p, inverse, size, many):  # type: ignore[no-untyped-def]
    """Distance until the coordinate p, in cells, leaves ``many`` cubes of ``size`` cells; inverse: per cell of p."""
    cube = np.float32(math.floor(p / size))  # a power of two: exact
    edge = size * (cube + many) if inverse > 0 else size * (cube + _ONE - many)
    return (edge - p) * inverse


@njit(forceinline=True, **JIT)
def next_sample(ray, t, far, step, grids, unit):  # type: ignore[no-untyped-def]
    """The first lattice interval at or after t whose midpoint lies where something may be: (t, dt); dt = 0 if none.

    ``ray``: see :func:`start`; ``grids``: see `cells.grids_of`. ``unit`` (3,) is set to the midpoint in [0, 1].
    """
    near, fine = grids
    r = near.shape[0]
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
        empty = near[i >> 2, j >> 2, l >> 2]
        size, many = _ONE, np.float32(empty)
        if empty == 0:
            mask = fine[i >> 2, j >> 2, l >> 2] if len(fine) > 0 else 0
            if mask == 0 or (mask >> (((i & 3) * 4 + (j & 3)) * 4 + (l & 3))) & 1:
                unit[0], unit[1], unit[2] = a * quarter, b * quarter, c * quarter
                return t, dt
            size, many = quarter, _ONE
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
            # outside the core the lattice has to be walked, but without a look at the grid
            safe = min(t + np.float32(empty - 1) * STRETCH / per_unit * ray[9], far)
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
def start(rays, space, lattice, per_unit, r, ray):  # type: ignore[no-untyped-def]
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
