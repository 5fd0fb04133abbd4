"""The hot loop of registration: coloured points against photos, many poses at once (numba).

Letters: V views, N points, K poses. A pose is R (3, 3) and c (3,): a point p of the old object is now at
``R (p - p0) + c``, p0 the old centre. A view's lens is 26 numbers: cam_from_world R (9) and t (3), fx fy cx cy,
k1 k2 p1 p2 k3, height, width, and its centre in the world (see `lens_of`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

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
def _sample(image: _F32, u: float, v: float, out: _F64) -> None:
    """Bilinear values of all channels at pixel position (u, v), centres at +0.5."""
    x, y = u - 0.5, v - 0.5
    i, j = int(y), int(x)
    fy, fx = y - i, x - j
    for c in range(image.shape[2]):
        top = image[i, j, c] * (1 - fx) + image[i, j + 1, c] * fx
        bottom = image[i + 1, j, c] * (1 - fx) + image[i + 1, j + 1, c] * fx
        out[c] = top * (1 - fy) + bottom * fy


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
def _gains(
    points: _F64, sides: _I64, colours: _F32, lenses: _F64, images: _F32, depths: _F32, r: _F64, c: _F64, radius: float
) -> _F64:
    """How much brighter each side of the object is where it is now: grey factors, held near 1 where little is seen."""
    count = 0
    for n in range(sides.shape[0]):
        count = max(count, sides[n] + 1)
    num, den = np.zeros(count), np.zeros(count)
    p, at, px = np.zeros(9), np.zeros(6), np.zeros(9)
    for n in range(points.shape[0]):
        _place(points, n, r, c, p)
        for v in range(lenses.shape[0]):
            cosine = _seen(lenses[v], depths[v], p, radius, at)
            if cosine == 0.0:
                continue
            _sample(images[v], at[0], at[1], px)
            for k in range(3):
                num[sides[n]] += cosine * px[k] * colours[n, k]
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
) -> bool:
    """One damped Gauss–Newton step on the photos' colours at the points; changes r and c in place."""
    gains = _gains(points, sides, colours, lenses, images, depths, r, c, radius)
    h, g = np.zeros((6, 6)), np.zeros(6)
    p, at, px, row, e = np.zeros(9), np.zeros(6), np.zeros(9), np.zeros(6), np.zeros(3)
    for n in range(points.shape[0]):
        _place(points, n, r, c, p)
        for v in range(lenses.shape[0]):
            lens = lenses[v]
            cosine = _seen(lens, depths[v], p, radius, at)
            if cosine == 0.0:
                continue
            _sample(images[v], at[0], at[1], px)
            size = 0.0
            for k in range(3):
                e[k] = px[k] - gains[sides[n]] * colours[n, k]
                size += e[k] * e[k]
            weight = cosine / (1 + size / scale**2) ** 2
            zi = 1 / at[4]
            # d(u, v)/d(point in camera axes), the lens' distortion left out of the derivative
            ux, uz = lens[12] * zi, -lens[12] * at[2] * zi * zi
            wy, wz = lens[13] * zi, -lens[13] * at[3] * zi * zi
            for k in range(3):
                gu, gv = px[3 + 2 * k], px[4 + 2 * k]
                a, b, d = gu * ux, gv * wy, gu * uz + gv * wz
                jx = a * lens[0] + b * lens[3] + d * lens[6]
                jy = a * lens[1] + b * lens[4] + d * lens[7]
                jz = a * lens[2] + b * lens[5] + d * lens[8]
                row[0], row[1], row[2] = jx * radius, jy * radius, jz * radius
                row[3], row[4], row[5] = p[4] * jz - p[5] * jy, p[5] * jx - p[3] * jz, p[3] * jy - p[4] * jx
                for i in range(6):
                    g[i] += weight * row[i] * e[k]
                    for j in range(i + 1):
                        h[i, j] += weight * row[i] * row[j]
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
    r: _F64,
    c: _F64,
    cap: float,
    radius: float,
    block: int,
) -> float:
    """Mean capped colour error of the points that face the views plus the part of the target that stays uncovered.

    A point that something hides, or that lies beyond the photo, speaks neither for the pose nor against it: it counts
    half. Else a pose of which next to nothing can be seen would be as good as any.
    """
    gains = _gains(points, sides, colours, lenses, images, depths, r, c, radius)
    error, total, uncovered, wanted = 0.0, 0.0, 0.0, 0.0
    p, at, px = np.zeros(9), np.zeros(6), np.zeros(9)
    for v in range(lenses.shape[0]):
        lens = lenses[v]
        covered = np.zeros((int(lens[21]) // block + 1, int(lens[22]) // block + 1), np.uint8)
        for n in range(points.shape[0]):
            _place(points, n, r, c, p)
            cosine, distance = _facing(lens, p)
            if cosine < 0.1:
                continue
            shown = _project(lens, p[0], p[1], p[2], at)
            i, j = int(at[1]), int(at[0])
            if shown:
                covered[i // block, j // block] = 1
            if cosine < 0.2:
                continue
            total += cosine
            if not shown or distance > depths[v, i, j] + 0.3 * radius:
                error += 0.5 * cosine
                continue
            if targets[v, i, j] < 0:  # certainly unchanged: nothing can be in front here
                error += cosine
                continue
            _sample(images[v], at[0], at[1], px)
            e, gain = 0.0, gains[sides[n]]
            for k in range(3):
                e += (px[k] - gain * colours[n, k]) ** 2
            # a side may be lit differently, but the less the better
            error += cosine * min(1.0, e / cap**2 + 0.25 * math.log(gain) ** 2)
        for i in range(int(lens[21])):
            for j in range(int(lens[22])):
                t = targets[v, i, j]
                if t > 0:
                    wanted += t
                    if covered[i // block, j // block] == 0:
                        uncovered += t
    if total < 5:
        return 2.0
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
    (V, H, W, 9): colour and its derivatives; depths, targets (V, H, W).
    """
    out = np.zeros(rotations.shape[0])
    for k in prange(rotations.shape[0]):
        r, c = rotations[k], centres[k]
        for _ in range(steps):
            if not _step(points, sides, colours, lenses, images, depths, r, c, scale, radius):
                break
        out[k] = _score(points, sides, colours, lenses, images, depths, targets, r, c, cap, radius, block)
    return out
