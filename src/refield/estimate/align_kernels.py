"""The hot loop of registration: coloured points against photos, many poses at once (numba).

Letters: V views, N points, K poses. A pose is R (3, 3) and c (3,): a point p of the old object is now at
``R (p - p0) + c``, p0 the old centre. A view's lens is 26 numbers: cam_from_world R (9) and t (3), fx fy cx cy,
k1 k2 p1 p2 k3, height, width, and its centre in the world (see `lens_of`).

What the views show of the points at a pose is looked up once (`_look`) and kept in rows, one for each view that sees a
point: ``seen`` (M, 4 + C) holds the cosine, the point in camera axes (3) and the view's first C channels, ``of`` (M, 2)
which point and view it is, ``row_of`` (N, V) which row, or -1; ``placed`` (N, 9) the points as `_place` puts them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

NOT_SHOWN = 2.0
"""the score of a pose at which the photos show next to nothing of the object"""

_F32 = NDArray[Any]
_F64 = NDArray[Any]
_I64 = NDArray[Any]


@njit(cache=True, fastmath=True)
def _project(lens: _F64, x: float, y: float, z: float, out: _F64) -> bool:
    """World point -> out = (u, v, X, Y, Z, distance) with X Y Z in camera axes; False if outside the image."""
    xc = lens[0] * x + lens[1] * y + lens[2] * z + lens[9]
    yc = lens[3] * x + lens[4] * y + lens[5] * z + lens[10]
    zc = lens[6] * x + lens[7] * y + lens[8] * z + lens[11]
    if zc <= 1e-6:
        return False
    a, b = xc / zc, yc / zc
    r2 = a * a + b * b
    radial = 1 + r2 * (lens[16] + r2 * (lens[17] + r2 * lens[20]))
    da = a * radial + 2 * lens[18] * a * b + lens[19] * (r2 + 2 * a * a)
    db = b * radial + lens[18] * (r2 + 2 * b * b) + 2 * lens[19] * a * b
    u, v = lens[12] * da + lens[14], lens[13] * db + lens[15]
    out[0], out[1], out[2], out[3], out[4] = u, v, xc, yc, zc
    out[5] = math.sqrt(xc * xc + yc * yc + zc * zc)
    return 1.0 < u < lens[22] - 1.0 and 1.0 < v < lens[21] - 1.0


@njit(cache=True, fastmath=True)
def _sample(image: _F32, u: float, v: float, row: _F64) -> None:
    """Bilinear values at pixel position (u, v), centres at +0.5, of as many channels as a row of ``seen`` has."""
    x, y = u - 0.5, v - 0.5
    i, j = int(y), int(x)
    fy, fx = y - i, x - j
    a, b, c, d = (1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx
    for k in range(row.shape[0] - 4):
        row[4 + k] = a * image[i, j, k] + b * image[i, j + 1, k] + c * image[i + 1, j, k] + d * image[i + 1, j + 1, k]


@njit(cache=True, fastmath=True)
def _rodrigues(w: _F64) -> _F64:
    angle = math.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    a, b = 1.0, 0.5
    if angle > 1e-6:
        a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = b * w[i] * w[j]
        out[i, i] += 1 - b * angle**2
    out[0, 1] -= a * w[2]
    out[0, 2] += a * w[1]
    out[1, 0] += a * w[2]
    out[1, 2] -= a * w[0]
    out[2, 0] -= a * w[1]
    out[2, 1] += a * w[0]
    return out


@njit(cache=True, fastmath=True)
def _place(points: _F64, n: int, r: _F64, c: _F64, out: _F64) -> None:
    """Point n at its new place: out = position (3), offset from the centre (3), normal (3)."""
    for i in range(3):
        q = r[i, 0] * points[n, 0] + r[i, 1] * points[n, 1] + r[i, 2] * points[n, 2]
        out[i], out[3 + i] = q + c[i], q
        out[6 + i] = r[i, 0] * points[n, 3] + r[i, 1] * points[n, 4] + r[i, 2] * points[n, 5]


@njit(cache=True, fastmath=True)
def _facing(lens: _F64, p: _F64) -> tuple[float, float]:
    """Cosine between a placed point's normal and the way to a view, and the distance to it."""
    x, y, z = p[0] - lens[23], p[1] - lens[24], p[2] - lens[25]
    distance = math.sqrt(x * x + y * y + z * z)
    return -(p[6] * x + p[7] * y + p[8] * z) / distance, distance


@njit(cache=True, fastmath=True)
def _seen(lens: _F64, depth: _F32, p: _F64, radius: float, at: _F64) -> float:
    """How squarely a view sees a placed point (the cosine), with `_project`'s ``at``; 0 if not well or not at all."""
    cosine, distance = _facing(lens, p)
    if cosine < 0.2 or not _project(lens, p[0], p[1], p[2], at):
        return 0.0
    return cosine if distance <= depth[int(at[1]), int(at[0])] + 0.3 * radius else 0.0


@njit(cache=True, fastmath=True)
def _look(
    points: _F64,
    lenses: _F64,
    images: _F32,
    depths: _F32,
    r: _F64,
    c: _F64,
    radius: float,
    placed: _F64,
    of: _I64,
    row_of: _I64,
    seen: _F64,
) -> int:
    """Fill ``placed``, ``of``, ``row_of`` and ``seen`` for a pose; how many rows it is."""
    rows, at = 0, np.zeros(6)
    for n in range(points.shape[0]):
        p = placed[n]
        _place(points, n, r, c, p)
        for v in range(lenses.shape[0]):
            row_of[n, v] = -1
            cosine = _seen(lenses[v], depths[v], p, radius, at)
            if cosine == 0.0:
                continue
            row = seen[rows]
            row[0], row[1], row[2], row[3] = cosine, at[2], at[3], at[4]
            _sample(images[v], at[0], at[1], row)
            of[rows, 0], of[rows, 1], row_of[n, v] = n, v, rows
            rows += 1
    return rows


@njit(cache=True, fastmath=True)
def _gains(rows: int, of: _I64, seen: _F64, sides: _I64, colours: _F32) -> _F64:
    """How much brighter each side of the object is where it is now: grey factors, held near 1 where little is seen."""
    count = 0
    for n in range(sides.shape[0]):
        count = max(count, sides[n] + 1)
    num, den = np.zeros(count), np.zeros(count)
    for m in range(rows):
        n, cosine = of[m, 0], seen[m, 0]
        for k in range(3):
            num[sides[n]] += cosine * seen[m, 4 + k] * colours[n, k]
            den[sides[n]] += cosine * colours[n, k] ** 2
    out = np.ones(count)
    hold = 0.1 * den.sum() / count + 1e-9
    for b in range(count):
        out[b] = min(2.2, max(0.45, (num[b] + hold) / (den[b] + hold)))
    return out


@njit(cache=True, fastmath=True)
def _step(
    points: _F64,
    sides: _I64,
    colours: _F32,
    lenses: _F64,
    images: _F32,
    depths: _F32,
    r: _F64,
    c: _F64,
    scale: float,
    radius: float,
    placed: _F64,
    of: _I64,
    row_of: _I64,
    seen: _F64,
) -> bool:
    """One damped Gauss–Newton step on the photos' colours at the points; changes r and c in place."""
    rows = _look(points, lenses, images, depths, r, c, radius, placed, of, row_of, seen)
    gains = _gains(rows, of, seen, sides, colours)
    h, g = np.zeros((6, 6)), np.zeros(6)
    ju, jv, e = np.zeros(6), np.zeros(6), np.zeros(3)
    for m in range(rows):
        n, lens, at, p = of[m, 0], lenses[of[m, 1]], seen[m], placed[of[m, 0]]
        size = 0.0
        for k in range(3):
            e[k] = at[4 + k] - gains[sides[n]] * colours[n, k]
            size += e[k] * e[k]
        weight = at[0] / (1 + size / scale**2) ** 2
        zi = 1 / at[3]
        # d(u, v)/d(point in camera axes), the lens' distortion left out of the derivative
        ux, uz = lens[12] * zi, -lens[12] * at[1] * zi * zi
        wy, wz = lens[13] * zi, -lens[13] * at[2] * zi * zi
        suu = svv = suv = su = sv = 0.0  # sums over the channels
        for k in range(3):
            gu, gv = at[7 + 2 * k], at[8 + 2 * k]
            suu += gu * gu
            suv += gu * gv
            svv += gv * gv
            su += gu * e[k]
            sv += gv * e[k]
        for i in range(3):
            ju[i] = (ux * lens[i] + uz * lens[6 + i]) * radius
            jv[i] = (wy * lens[3 + i] + wz * lens[6 + i]) * radius
        for slope in (ju, jv):
            slope[3] = (p[4] * slope[2] - p[5] * slope[1]) / radius
            slope[4] = (p[5] * slope[0] - p[3] * slope[2]) / radius
            slope[5] = (p[3] * slope[1] - p[4] * slope[0]) / radius
        for i in range(6):
            g[i] += weight * (ju[i] * su + jv[i] * sv)
            a, b = weight * (suu * ju[i] + suv * jv[i]), weight * (suv * ju[i] + svv * jv[i])
            for j in range(i + 1):
                h[i, j] += a * ju[j] + b * jv[j]
    return _solved(h, g, r, c, radius)


@njit(cache=True, fastmath=True)
def _minus_solution(h: _F64, g: _F64) -> _F64:
    """-h⁻¹ g for a positive h (6, 6), by Gauss's elimination; numpy's costs seconds to compile."""
    s = -g
    for i in range(6):
        for j in range(i + 1, 6):
            f = h[j, i] / h[i, i]
            for k in range(i, 6):
                h[j, k] -= f * h[i, k]
            s[j] -= f * s[i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            s[i] -= h[i, k] * s[k]
        s[i] /= h[i, i]
    return s


@njit(cache=True, fastmath=True)
def _solved(h: _F64, g: _F64, r: _F64, c: _F64, radius: float) -> bool:
    """Take the damped step of a normal equation; False if it is negligible or nothing holds it."""
    trace = 0.0
    for i in range(6):
        trace += h[i, i]
        for j in range(i):
            h[j, i] = h[i, j]
    if trace <= 1e-12:
        return False
    for i in range(6):
        h[i, i] += 0.02 * h[i, i] + 1e-3 * trace
    s = _minus_solution(h, g)
    size = math.sqrt(s[0] ** 2 + s[1] ** 2 + s[2] ** 2 + s[3] ** 2 + s[4] ** 2 + s[5] ** 2)
    if size > 0.35:
        s *= 0.35 / size
    for i in range(3):
        c[i] += s[i] * radius
    turn, old = _rodrigues(s[3:]), r.copy()
    for i in range(3):
        for j in range(3):
            r[i, j] = turn[i, 0] * old[0, j] + turn[i, 1] * old[1, j] + turn[i, 2] * old[2, j]
    return size > 1e-4


@njit(cache=True, fastmath=True)
def _score(
    points: _F64,
    sides: _I64,
    colours: _F32,
    lenses: _F64,
    images: _F32,
    depths: _F32,
    targets: _F32,
    boxes: _I64,
    r: _F64,
    c: _F64,
    cap: float,
    radius: float,
    block: int,
    placed: _F64,
    of: _I64,
    row_of: _I64,
    seen: _F64,
) -> float:
    """Mean capped colour error of the points that face the views plus the part of the target that stays uncovered.

    A point that something hides, or that lies beyond the photo, speaks neither for the pose nor against it: it counts
    half. Else a pose of which next to nothing can be seen would be as good as any.
    """
    rows = _look(points, lenses, images, depths, r, c, radius, placed, of, row_of, seen)
    gains = _gains(rows, of, seen, sides, colours)
    error, total, uncovered, wanted = 0.0, 0.0, 0.0, 0.0
    at = np.zeros(6)
    for v in range(lenses.shape[0]):
        lens = lenses[v]
        covered = np.zeros((int(lens[21]) // block + 1, int(lens[22]) // block + 1), np.uint8)
        for n in range(points.shape[0]):
            p, m = placed[n], row_of[n, v]
            cosine, _ = _facing(lens, p)
            if cosine < 0.1:
                continue
            shown = _project(lens, p[0], p[1], p[2], at)
            i, j = int(at[1]), int(at[0])
            if shown:
                covered[i // block, j // block] = 1
            if cosine < 0.2:
                continue
            total += cosine
            if m < 0:
                error += 0.5 * cosine
                continue
            if targets[v, i, j] < 0:  # certainly unchanged: nothing can be in front here
                error += cosine
                continue
            e, gain = 0.0, gains[sides[n]]
            for k in range(3):
                e += (seen[m, 4 + k] - gain * colours[n, k]) ** 2
            # a side may be lit differently, but the less the better
            error += cosine * min(1.0, e / cap**2 + 0.25 * math.log(gain) ** 2)
        for i in range(boxes[v, 1], boxes[v, 3]):
            for j in range(boxes[v, 0], boxes[v, 2]):
                t = targets[v, i, j]
                if t > 0:
                    wanted += t
                    if covered[i // block, j // block] == 0:
                        uncovered += t
    if total < 5:
        return NOT_SHOWN
    return error / total + 0.7 * uncovered / max(wanted, 1.0)


@njit(cache=True, parallel=True, fastmath=True)
def register_all(
    points: _F64,
    sides: _I64,
    colours: _F32,
    lenses: _F64,
    images: _F32,
    depths: _F32,
    targets: _F32,
    boxes: _I64,
    rotations: _F64,
    centres: _F64,
    steps: int,
    scale: float,
    cap: float,
    radius: float,
    block: int,
) -> _F64:
    """Improve K poses by ``steps`` steps each and score them: rotations (K, 3, 3), centres (K, 3) in place -> (K,).

    points (N, 6): position and normal; sides (N,) the side of the object each is on; colours (N, 3); images
    (V, H, W, 9): colour and its derivatives; depths, targets (V, H, W); boxes (V, 4): x0, y0, x1, y1 of a box around
    all pixels of a target that should be covered.
    """
    out, n, v = np.zeros(rotations.shape[0]), points.shape[0], lenses.shape[0]
    for k in prange(rotations.shape[0]):
        r, c = rotations[k], centres[k]
        placed, of, row_of = np.empty((n, 9)), np.empty((n * v, 2), np.int64), np.empty((n, v), np.int64)
        seen = np.empty((n * v, 13))
        for _ in range(steps):
            if not _step(points, sides, colours, lenses, images, depths, r, c, scale, radius, placed, of, row_of, seen):
                break
        out[k] = _score(
            points, sides, colours, lenses, images, depths, targets, boxes, r, c, cap, radius, block, placed, of,
            row_of, seen[:, :7],
        )  # fmt: skip
    return out
