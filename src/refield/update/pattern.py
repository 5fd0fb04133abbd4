"""What a texture goes on as where nobody has seen it: its own pattern, if it has one.

A floor of bricks, tiles or planks looks like itself some way further on (He and Sun 2012, Statistics of patch offsets
for image completion). How far on, and how much like itself, is found by correlating what is known with itself; the less
alike, the less of it is believed. What has no pattern stays as smooth as it was.

Letters: (U, V) texels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Array = NDArray[Any]
_MEAN = 0.25  # of the hidden part's side, over which a mean is taken that pattern is a difference from
_ALIKE = 0.3  # correlation of what is further on, from which it is believed to be of a pattern
_COMMON = 0.2  # of what is known, at least, tells how much alike it is
_COVERED = 0.3  # of what is hidden, at least, lies where something is known further on
_MOST = 8  # ways to go on, the best of them


def continued(picture: Array, known: Array, hidden: Array) -> Array:
    """The texture (U, V, 3) in [0, 1] with its pattern in its ``hidden`` part, as it is where it is ``known``.

    Both are (U, V) bool, and somewhere true.
    """
    scale = max(_MEAN * math.sqrt(hidden.sum()), 1.0)
    mean = _mean(picture, known, scale)
    detail = np.where(known[..., None], picture - mean, 0.0)
    found = _ways_on(detail, known, hidden, scale)
    if not found:
        return picture
    alike = float(np.mean([c for c, _ in found]))
    rows, columns = np.nonzero(hidden)
    total, count = np.zeros((len(rows), 3)), np.zeros(len(rows))
    for _, (du, dv) in found:
        u, v = rows + du, columns + dv
        inside = (u >= 0) & (u < known.shape[0]) & (v >= 0) & (v < known.shape[1])
        inside[inside] = known[u[inside], v[inside]]
        total[inside] += detail[u[inside], v[inside]]
        count += inside
    # the best linear guess from so many places that are as much alike to each other as to what is sought
    guess = mean[rows, columns] + total * (alike / (1 + (count - 1).clip(0) * alike))[:, None]
    told = count > 0
    out = picture.copy()
    out[rows[told], columns[told]] = guess[told].clip(0, 1)
    return out


def _mean(picture: Array, known: Array, scale: float) -> Array:
    """Of the known texels around each, (U, V, 3)."""
    weight = ndimage.gaussian_filter(known.astype(float), scale)
    summed = [ndimage.gaussian_filter(np.where(known, picture[..., c], 0.0), scale) for c in range(3)]
    return np.stack(summed, -1) / np.maximum(weight, 1e-9)[..., None]


def _ways_on(detail: Array, known: Array, hidden: Array, scale: float) -> list[tuple[float, tuple[int, int]]]:
    """How much alike the texture is so many texels further on, the best ways first; none if it has no pattern."""
    shape = [fft.next_fast_len(2 * n, real=True) for n in known.shape]

    def spectrum(values: Array) -> Array:
        return np.asarray(fft.rfft2(values, shape))

    def correlated(a: Array, b: Array) -> Array:
        """sum over x of a(x) b(x + s), for every way on s."""
        return np.asarray(fft.irfft2(a.conj() * b, shape))

    there, power = spectrum(known.astype(float)), spectrum((detail**2).sum(-1))
    common = correlated(there, there)
    product = sum(correlated(s := spectrum(detail[..., c]), s) for c in range(3))
    both = correlated(power, there).clip(0) * correlated(there, power).clip(0)
    alike = product / np.sqrt(both + 1e-12)
    covered = correlated(spectrum(hidden.astype(float)), there) / hidden.sum()
    near = int(scale)
    best = (alike >= ndimage.maximum_filter(alike, 2 * near + 1, mode="wrap")) & (alike > _ALIKE)
    best &= (common > _COMMON * known.sum()) & (covered > _COVERED)
    best[0, 0] = False
    ways = [(float(alike[u, v]), (u, v)) for u, v in zip(*np.nonzero(best))]
    signed = [(c, (_signed(u, shape[0]), _signed(v, shape[1]))) for c, (u, v) in ways]
    return sorted(signed, reverse=True)[:_MOST]


def _signed(shift: int, length: int) -> int:
    return int(shift) if shift <= length // 2 else int(shift) - length
