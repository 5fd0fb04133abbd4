"""The texture of a plane by least squares, and how far the plane is off: a pixel is an equation in four texels.

Letters: (U, V) texels, N pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg
from torch.nn import functional

from refield.scene.capture import Rays
from refield.update.textured import TexturedPlane

Array = NDArray[Any]
_SMOOTH = 0.3  # weight of a difference between neighbouring texels, where a pixel has 1
_ROUNDS = 6  # of texture, trust and plane
_ROUGH, _FINE = 1e-3, 1e-4  # of what the equations miss at first; texels that no photo shows hardly count in it
_OFF = 0.5  # samples of the old field; so far off a plane may well be
_SPREAD = 3.0  # typical errors; as wrong as this is half trusted
_ERROR = (0.03, 0.05)  # what a typical error is at least and at most, of an RGB colour in [0, 1]


@dataclass(frozen=True)
class Guide:
    """What the old field shows of a plane."""

    rgb: Array
    """(U * V, 3) float64"""
    known: Array
    """(U, V) bool"""


def fitted(plane: TexturedPlane, rays: Rays, colours: Array, guide: Guide) -> tuple[TexturedPlane, Array]:
    """The plane that shows colours (N, 3) best to rays that come to it, and where these do, (N, 2) texels.

    Least squares, reweighted as for Cauchy's errors, for the texture, and in turns with it a Gauss-Newton step for how
    far the plane is off: its height and its two tilts. Several photos say that, and a little the old field's texture.
    """
    shape = tuple(plane.known.shape)
    first = plane.texels(rays.origins + plane.met(rays)[:, None] * rays.directions).double().numpy()
    slide = (rays.directions @ plane.axes.T / (rays.directions @ plane.normal)[:, None]).double().numpy()
    levers = np.concatenate([np.ones((len(first), 1)), first / max(shape) - 0.5], 1)
    off, places, trust = np.zeros(3), first, np.ones(len(first))  # off: height in the middle and at the sides, texels
    mean = colours.mean(0)
    texture = np.where(guide.known.reshape(-1, 1), guide.rgb - mean, 0.0)
    smooth, wanted = _smoothness(guide)
    for k in range(_ROUNDS):
        rows = _bilinear(places, shape)
        exact = _FINE if k == _ROUNDS - 1 else _ROUGH
        texture = _solved(rows, colours - mean, trust, (smooth, wanted), texture, exact)
        error = rows @ texture + mean - colours
        size = np.linalg.norm(error, axis=1)
        typical = float(np.clip(np.median(size), *_ERROR))
        trust = 1 / (1 + (size / (_SPREAD * typical)) ** 2)
        if k < _ROUNDS - 1:
            gradients = [np.gradient(texture.reshape(*shape, 3), axis=axis) for axis in (0, 1)]
            across = np.stack(gradients, 2).reshape(-1, 6)
            by_height = np.einsum("na,nac->nc", slide, (rows @ across).reshape(-1, 2, 3))
            lever = (by_height[:, :, None] * levers[:, None, :]).reshape(-1, 3)
            pull = (lever * np.repeat(trust, 3)[:, None]).T
            stay = (typical * plane.texel / (_OFF * plane.clear)) ** 2
            off = off - np.linalg.solve(pull @ lever + stay * np.eye(3), pull @ error.reshape(-1) + stay * off)
            corner = plane.texel * (abs(off[0]) + abs(off[1]) / 2 + abs(off[2]) / 2)
            off *= min(1.0, plane.clear / max(corner, 1e-12))  # on plain ground anything fits
            places = first + slide * (levers @ off)[:, None]
    picture = torch.from_numpy((texture + mean).reshape(*shape, 3)).float().clamp(0, 1)
    return replace(_raised(plane, off), rgb=picture), places


def _raised(plane: TexturedPlane, off: Array) -> TexturedPlane:
    """A plane higher by off[0] texels in its middle; off[1] and off[2]: from a side to the one opposite."""
    tilt = torch.from_numpy(off[1:]).float() / max(plane.known.shape)
    axes = plane.axes + tilt[:, None] * plane.normal  # longer by half of the tilt's square, which is nothing
    normal = functional.normalize(torch.linalg.cross(axes[0], axes[1]), dim=0)
    up = plane.texel * float(off[0] - off[1:].sum() / 2)
    return replace(plane, origin=plane.origin + up * plane.normal, axes=axes, normal=normal)


def _bilinear(places: Array, shape: tuple[int, ...]) -> Any:
    """Sparse (N, U * V): the weights of the texels around each place (N, 2)."""
    corner = np.clip(np.floor(places).astype(np.int64), 0, np.array(shape) - 2)
    f = np.clip(places - corner, 0, 1)
    columns = [(corner[:, 0] + a) * shape[1] + corner[:, 1] + b for a in (0, 1) for b in (0, 1)]
    values = [(f[:, 0] if a else 1 - f[:, 0]) * (f[:, 1] if b else 1 - f[:, 1]) for a in (0, 1) for b in (0, 1)]
    parts = np.stack(values, 1).ravel(), np.stack(columns, 1).ravel(), np.arange(0, 4 * len(places) + 1, 4)
    return sparse.csr_array(parts, shape=(len(places), shape[0] * shape[1]))


def _smoothness(guide: Guide) -> tuple[Any, Array]:
    """Normal equations for gradients as the guide's, 0 where it has none: (U * V, U * V) sparse, (U * V, 3)."""
    u, v = guide.known.shape
    lines = [sparse.diags_array([-np.ones(n - 1), np.ones(n - 1)], offsets=[0, 1], shape=(n - 1, n)) for n in (u, v)]
    across = [sparse.kron(lines[0], sparse.eye_array(v)), sparse.kron(sparse.eye_array(u), lines[1])]
    gradient = sparse.vstack(across).tocsr()
    both = abs(gradient) @ guide.known.reshape(-1).astype(float) > 1.5
    wanted = gradient.T @ (both[:, None] * (gradient @ guide.rgb))
    return _SMOOTH**2 * (gradient.T @ gradient), _SMOOTH**2 * wanted


def _solved(
    rows: Any, colours: Array, trust: Array, smoothness: tuple[Any, Array], start: Array, exact: float
) -> Array:
    """The texture (U * V, 3) that shows colours (N, 3), each trusted so far (N,), from ``start``; as exact as asked."""
    smooth, wanted = smoothness
    weighted = rows.multiply(trust[:, None]).tocsr()
    system = (rows.T @ weighted + smooth).tocsr()
    diagonal = sparse.diags_array(1 / system.diagonal())
    told = weighted.T @ colours + wanted
    found = [cg(system, told[:, c], x0=start[:, c], M=diagonal, rtol=exact, maxiter=1000)[0] for c in range(3)]
    return np.stack(found, 1)
