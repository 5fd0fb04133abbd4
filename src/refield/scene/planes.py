"""Planes that hold things up: floors, table tops, walls to lean against."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_FEWEST = 50  # points


@dataclass(frozen=True)
class Plane:
    """Points x with ``normal @ x == offset``; the cameras are on the positive side."""

    normal: Array
    offset: float
    noise: float
    """rms distance of its points, world units"""

    def height(self, points: Array) -> Array:
        return points @ self.normal - np.float32(self.offset)


def rough_planes(points: Array, cameras: Array, resolved: float) -> list[Plane]:
    """`support_planes` of points that are exact to ``resolved`` (world units), or up to four times less exact."""
    if len(points) < _FEWEST:
        return []
    for rough in (1, 2, 4):  # a fitted surface may be uneven
        planes = support_planes(points, cameras, rough * 0.7 * resolved)
        if planes:
            return planes
    return []


def support_planes(points: Array, cameras: Array, tol: float, seed: int = 0) -> list[Plane]:
    """Planes that hold up what stands on them: many points on it, hardly any behind, the cameras in front."""
    rng = np.random.default_rng(seed)
    rest, planes, total = points, [], len(points)
    for _ in range(3):
        if len(rest) < max(50, 0.12 * total):
            break
        plane, on = _best_plane(rest, points, cameras, tol, rng)
        if plane is None or on.sum() < 0.12 * total:
            break
        planes.append(plane)
        rest = rest[~on]
    return planes


def _best_plane(
    rest: Array, points: Array, cameras: Array, tol: float, rng: np.random.Generator
) -> tuple[Plane | None, NDArray[np.bool_]]:
    triples = rest[rng.integers(len(rest), size=(400, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=-1)
    normals, triples = normals[length > 1e-12] / length[length > 1e-12, None], triples[length > 1e-12]
    offsets = (normals * triples[:, 0]).sum(-1)
    side = np.sign(np.median(cameras @ normals.T - offsets, axis=0))
    normals, offsets = normals * side[:, None], offsets * side
    heights = points @ normals.T - offsets
    behind = (heights < -2.5 * tol).mean(0)
    on_count = (np.abs(rest @ normals.T - offsets) < tol).sum(0)
    allowed = (behind < 0.03) & ((cameras @ normals.T - offsets) > 0).all(0)
    if not allowed.any():
        return None, np.zeros(len(rest), bool)
    best = int(np.where(allowed, on_count, -1).argmax())
    normal, offset = normals[best], float(offsets[best])
    for _ in range(3):
        on = np.abs(rest @ normal - offset) < tol
        centre = rest[on].mean(0)
        axis = np.linalg.svd(rest[on] - centre, full_matrices=False)[2][2]
        normal = axis if axis @ normal > 0 else -axis
        offset = float(normal @ centre)
    on = np.abs(rest @ normal - offset) < tol
    noise = float(np.sqrt(((rest[on] @ normal - offset) ** 2).mean()))
    return Plane(normal.astype(np.float32), offset, noise), on
