"""The hot loops of carving: points against views, voxels against their neighbours (numba).

Letters: N points (N, 3) in the world, V windows, P pixels of all windows together. A window is a rectangle of a view
and how far away the old field's surface is in it, known by 26 numbers: cam_from_world R (9) and t (3), fx fy cx cy,
k1 k2 p1 p2 k3, the rectangle x0 y0 x1 y1 in pixels, and the place of its first pixel among P. Depths are along unit
rays, inf where the field is empty; ``slack`` (V,) is how far from a surface a point may be and still be on it, per unit
of its distance. Every loop is parallel over what it writes, so results do not depend on the threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor

from refield.scene.camera import Camera

_F32 = NDArray[Any]
_F64 = NDArray[Any]
_Bool = NDArray[Any]
_Count = NDArray[Any]
# not all of fastmath: depths may be infinite and points not numbers
_JIT: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz", "arcp"}, "cache": True, "error_model": "numpy"}


class Window(NamedTuple):
    """A rectangle of a view."""

    camera: Camera
    world_from_cam: Tensor
    depth: _F32
    """(h, w)"""
    corner: tuple[int, int] = (0, 0)
    """x0, y0 in the camera's pixels"""


def packed(windows: Iterable[Window]) -> tuple[_F64, _F32]:
    """What the kernels know windows by: (V, 26) numbers and (P,) float32 depths."""
    rows, depths, start = [], [np.zeros(0, np.float32)], 0
    for w in windows:
        m, c = w.world_from_cam.numpy(), w.camera
        r = m[:3, :3].T
        (h, wide), (x0, y0) = w.depth.shape, w.corner
        lens = (c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.p1, c.p2, c.k3)
        rows.append([*r.ravel(), *(-r @ m[:3, 3]), *lens, x0, y0, x0 + wide, y0 + h, start])
        depths.append(w.depth.ravel())
        start += w.depth.size
    return np.array(rows, np.float64).reshape(-1, 26), np.concatenate(depths, dtype=np.float32)


@njit(**_JIT)
def _look(lens: _F64, x: float, y: float, z: float) -> tuple[int, float]:
    """A world point -> the pixel it falls on, counted among P (-1: on none), and its distance."""
    zc = lens[6] * x + lens[7] * y + lens[8] * z + lens[11]
    if not zc > 1e-6:
        return -1, 0.0
    xc = lens[0] * x + lens[1] * y + lens[2] * z + lens[9]
    yc = lens[3] * x + lens[4] * y + lens[5] * z + lens[10]
    a, b = xc / zc, yc / zc
    r2 = a * a + b * b
    radial = 1 + r2 * (lens[16] + r2 * (lens[17] + r2 * lens[20]))
    u = lens[12] * (a * radial + 2 * lens[18] * a * b + lens[19] * (r2 + 2 * a * a)) + lens[14]
    v = lens[13] * (b * radial + lens[18] * (r2 + 2 * b * b) + 2 * lens[19] * a * b) + lens[15]
    if not (u >= lens[21] and v >= lens[22] and u < lens[23] and v < lens[24]):
        return -1, 0.0
    row, column = int(v) - int(lens[22]), int(u) - int(lens[21])
    pixel = int(lens[25]) + row * (int(lens[23]) - int(lens[21])) + column
    return pixel, math.sqrt(xc * xc + yc * yc + zc * zc)


@njit(parallel=True, **_JIT)
def count_votes(
    points: _F32, lenses: _F64, depths: _F32, slack: _F64, masks: _Bool, shown: _Count, against: _Count
) -> None:
    """Add to ``shown`` (N,) the windows whose mask holds each point, to ``against`` (N,) those that see it outside of
    their mask, with no old surface before it. masks: (P,).
    """
    for n in prange(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for v in range(len(lenses)):
            at, distance = _look(lenses[v], x, y, z)
            if at >= 0:
                if masks[at]:
                    shown[n] += 1
                elif distance < depths[at] + slack[v] * distance:
                    against[n] += 1


@njit(parallel=True, **_JIT)
def find_behind(points: _F32, lenses: _F64, depths: _F32, slack: _F64, through: _Bool, behind: _F32) -> None:
    """``through`` (N,): whether some window looks through a point; ``behind`` (N,): how far behind the surface it is in
    the window that comes nearest to it, inf if none shows a surface there."""
    for n in prange(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        passed, least = False, np.inf
        for v in range(len(lenses)):
            at, distance = _look(lenses[v], x, y, z)
            if at >= 0:
                front = depths[at]
                passed |= distance < front - slack[v] * distance
                if front < np.inf:
                    least = min(least, distance - front)
        through[n], behind[n] = passed, least


@njit(parallel=True, **_JIT)
def count_on_surface(points: _F32, lenses: _F64, depths: _F32, slack: _F64, far: float, out: _Count) -> None:
    """``out`` (N,): the windows that show a surface where each point lies; of points beyond ``far``, those that show
    nothing there."""
    for n in prange(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for v in range(len(lenses)):
            at, distance = _look(lenses[v], x, y, z)
            if at >= 0:
                front = depths[at]
                out[n] += abs(front - distance) < slack[v] * distance or (front == np.inf and distance > far)


@njit(parallel=True, **_JIT)
def find_solid(
    points: _F32, lenses: _F64, depths: _F32, margin: float, allowed: float, deepest: float, out: _Bool
) -> None:
    """``out`` (N,): whether at most ``allowed`` windows look through a point, with their surface more than ``margin``
    behind it, and it is less than ``deepest`` behind the surface in some window."""
    for n in prange(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        passed, least = 0, np.inf
        for v in range(len(lenses)):
            at, distance = _look(lenses[v], x, y, z)
            if at >= 0:
                behind = distance - depths[at]
                passed += behind < -margin
                least = min(least, behind)
                if passed > allowed:
                    break
        out[n] = passed <= allowed and least < deepest


@njit(parallel=True, **_JIT)
def find_held(points: _F32, voxels: _Bool, low: _F32, cell: float, out: _Bool) -> None:
    """``out`` (N,): whether a point lies in one of the voxels (X, Y, Z); the first has its centre at ``low``."""
    nx, ny, nz = voxels.shape
    for n in prange(len(points)):
        i = (points[n, 0] - low[0]) / cell + 0.5
        j = (points[n, 1] - low[1]) / cell + 0.5
        k = (points[n, 2] - low[2]) / cell + 0.5
        if i >= 0 and j >= 0 and k >= 0 and i < nx and j < ny and k < nz:
            out[n] = voxels[int(i), int(j), int(k)]


@njit(parallel=True, **_JIT)
def spread(voxels: _Bool, steps: int, out: _Bool) -> None:
    """Voxels (X, Y, Z) and all that are at most ``steps`` from one along every axis -> out, false at first."""
    nx, ny, nz = voxels.shape
    slabs = np.zeros(nx, np.bool_)
    flat = np.zeros((nx, ny, nz), np.bool_)
    for i in prange(nx):  # one axis after the other: the last two within a slab, then across slabs
        for j in range(ny):
            if not voxels[i, j].any():
                continue
            slabs[i] = True
            row = np.zeros(nz, np.bool_)
            for k in range(nz):
                if voxels[i, j, k]:
                    row[max(k - steps, 0) : k + steps + 1] = True
            for other in range(max(j - steps, 0), min(j + steps + 1, ny)):
                for k in range(nz):
                    flat[i, other, k] |= row[k]
    for i in prange(nx):
        for other in range(max(i - steps, 0), min(i + steps + 1, nx)):
            if slabs[other]:
                for j in range(ny):
                    for k in range(nz):
                        out[i, j, k] |= flat[other, j, k]


@njit(parallel=True, **_JIT)
def draw_points(
    points: _F64, normals: _F64, colours: _F32, lenses: _F64, eyes: _F64, thickness: float, depth: _F32, total: _F32
) -> None:
    """``depth`` (P,), inf at first: the nearest of the points on each pixel that face it; ``total`` (P, 4), 0 at first:
    the colours (N, 3) and the number of those that are no more than ``thickness`` behind it. eyes (V, 3): where windows
    look from; normals (N, 3).
    """
    for v in prange(len(lenses)):
        for nearest in (True, False):
            for n in range(len(points)):
                x, y, z = points[n, 0], points[n, 1], points[n, 2]
                ex, ey, ez = x - eyes[v, 0], y - eyes[v, 1], z - eyes[v, 2]
                if ex * normals[n, 0] + ey * normals[n, 1] + ez * normals[n, 2] >= 0:
                    continue
                at, distance = _look(lenses[v], x, y, z)
                if at < 0:
                    continue
                if nearest:
                    depth[at] = min(depth[at], distance)
                elif distance <= depth[at] + thickness:
                    for k in range(3):
                        total[at, k] += colours[n, k]
                    total[at, 3] += 1
