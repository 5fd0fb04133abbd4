"""Planes that hold things up: floors, table tops, walls to lean against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, cKDTree

Array = NDArray[Any]
EXACT = 0.7  # of what cameras resolve; surfaces that are to be one plane keep to it
_FEWEST = 50  # points
_PART = 0.12  # of all points that a plane holds at least
_FEW = 0.03  # of all points that may lie where they could not be seen, if it were one
_PEAK = 0.4  # of as many as a plane holds may be within as much again of it: of what fills space it is half, or all
_OFF = 2.5  # tolerances from a plane, from which on a point is not on it
_DEVIATION = 1.48  # times the median absolute deviation
_CORNERS = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
_BESIDE = 3.0  # times the distance from point to point; further apart they are of two pieces


@dataclass(frozen=True)
class Plane:
    """Points x with ``normal @ x == offset``; the cameras are on the positive side."""

    normal: Array
    offset: float
    noise: float
    """rms distance of its points, world units"""
    edges: Array = field(default_factory=lambda: np.zeros((0, 4)))
    """(K, 4) world: beside it are points x with ``edges[k, :3] @ x > edges[k, 3]`` for any k, as beside a table top; of
    one that goes on everywhere there are none"""

    def height(self, points: Array) -> Array:
        """How far points (..., 3) are on the cameras' side, (...,), the plane taken as endless."""
        return points @ self.normal - np.float32(self.offset)

    def above(self, points: Array) -> Array:
        """The same for what is above or beneath it; of points beside it there is nothing to say: infinite."""
        out = self.height(points)
        for edge in self.edges.astype(points.dtype):
            out = np.where(points @ edge[:3] > edge[3], np.inf, out)
        return out


def rough_planes(points: Array, cameras: Array, resolved: float) -> list[Plane]:
    """`support_planes` of points that are exact to ``resolved`` (world units), or up to four times less exact: the
    planes of the least tolerance at which there are any; a fitted surface may be uneven."""
    return next(filter(None, (support_planes(points, cameras, rough * EXACT * resolved) for rough in (1, 2, 4))), [])


def support_planes(points: Array, cameras: Array, tol: float) -> list[Plane]:
    """Planes that hold up what stands on them: many points on it, hardly any behind, the cameras in front."""

    def possible(plane: Plane) -> bool:
        return (plane.height(points) < -_OFF * tol).mean() < _FEW and bool((plane.height(cameras) > 0).all())

    return _planes(points, cameras, tol, possible)


def support_tops(points: Array, eyes: Array, still: NDArray[np.bool_], tol: float) -> list[Plane]:
    """Planes that end, as table tops and shelves do, and that are known to have stayed where they are.

    Hardly anything is seen through what is known of one, and it is more than a slice of what fills space. So may be the
    side of a thing, which holds nothing up; but that of one which moved is no plane that stayed.

    Args:
        points: (N, 3) of surfaces.
        eyes: (N, 3) from where each was seen.
        still: (N,) those that are known to be where they were.
    """

    def possible(plane: Plane) -> bool:
        height, before = plane.height(points), plane.height(eyes)
        on = np.abs(height) < tol
        if (np.abs(height) < 2 * tol).sum() > (1 + _PEAK) * on.sum():
            return False
        if (before[on] <= 0).mean() > _FEW:
            return False
        through = np.flatnonzero((height < -_OFF * tol) & (before > 0) | (before < 0) & (height > _OFF * tol))
        part = (before[through] / (before[through] - height[through]))[:, None]
        met = eyes[through] + part * (points[through] - eyes[through])
        beside = cKDTree(points[on]).query(met, distance_upper_bound=_apart(points[on]))[0]
        return bool(np.isfinite(beside).sum() < _FEW * len(points))

    found = _planes(points[still], eyes, tol, possible)
    return [_ended(p, points, tol) for p in found]


def holds_up(plane: Plane, surfaces: Array, tol: float) -> bool:
    """Whether surfaces (N, 3) are on a plane and before it rather than beneath it.

    Asked of what changed: the side of a large thing that stayed is a plane that stayed, too, and what is behind that
    does not stand on it.
    """
    height = plane.above(surfaces)
    beneath = height < -_OFF * tol
    return bool(beneath.sum() <= (np.isfinite(height) & ~beneath).sum())


def _ended(plane: Plane, points: Array, tol: float) -> Plane:
    """The plane as far as its points reach, and as uneven as they are around it."""
    on = points[np.abs(plane.height(points)) < tol]
    ended = replace(plane, edges=_edges(plane, on, max(_apart(on), tol)))
    off = np.abs(ended.above(points))
    return replace(ended, noise=_DEVIATION * float(np.median(off[off < 4 * tol])))


def _apart(points: Array) -> float:
    """How far from each other points of one piece of surface may be."""
    return _BESIDE * float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))


def _edges(plane: Plane, points: Array, cell: float) -> Array:
    """What the largest piece of a plane's points lies within, and a cell more, as `Plane.edges`."""
    axes = np.linalg.svd(plane.normal[None].astype(np.float64))[2][1:]
    at = points @ axes.T
    cells, of = np.unique(np.floor((at - at.min(0)) / cell), axis=0, return_inverse=True)
    beside = cKDTree(cells).query_pairs(1.5, output_type="ndarray")  # at a side or a corner
    graph = coo_matrix((np.ones(len(beside)), beside.T), (len(cells), len(cells)))
    piece = connected_components(graph, directed=False)[1][of.ravel()]
    largest = at[piece == np.bincount(piece).argmax()]
    sides = ConvexHull((largest[:, None] + cell * _CORNERS).reshape(-1, 2)).equations
    return np.concatenate([sides[:, :2] @ axes, -sides[:, 2:]], -1)


def _planes(points: Array, eyes: Array, tol: float, possible: Callable[[Plane], bool]) -> list[Plane]:
    rng = np.random.default_rng(0)
    rest, planes, total = points, [], len(points)
    for _ in range(3):
        if len(rest) < max(_FEWEST, _PART * total):
            break
        plane = _best_plane(rest, eyes, tol, int(_PART * total), possible, rng)
        if plane is None:
            break
        planes.append(plane)
        rest = rest[np.abs(plane.height(rest)) >= _OFF * tol]
    return planes


def _best_plane(
    rest: Array, eyes: Array, tol: float, fewest: int, possible: Callable[[Plane], bool], rng: np.random.Generator
) -> Plane | None:
    """The possible plane through three of the points that holds most of them, and at least ``fewest``."""
    triples = rest[rng.integers(len(rest), size=(400, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=-1)
    normals, triples = normals[length > 1e-12] / length[length > 1e-12, None], triples[length > 1e-12]
    offsets = (normals * triples[:, 0]).sum(-1)
    side = np.sign(np.median(eyes @ normals.T - offsets, axis=0))
    normals, offsets = normals * side[:, None], offsets * side
    holds = (np.abs(rest @ normals.T - offsets) < tol).sum(0)
    for k in np.argsort(-holds):
        if holds[k] < fewest:
            return None
        if possible(Plane(normals[k], float(offsets[k]), tol)):
            return _settled(rest, normals[k], float(offsets[k]), tol, fewest)
    return None


def _settled(rest: Array, normal: Array, offset: float, tol: float, fewest: int) -> Plane | None:
    """The plane that fits the points on a rough one best; None if it loses them."""
    for _ in range(3):
        on = np.abs(rest @ normal - offset) < tol
        centre = rest[on].mean(0)
        axis = np.linalg.svd(rest[on] - centre, full_matrices=False)[2][2]
        normal = axis if axis @ normal > 0 else -axis
        offset = float(normal @ centre)
    on = np.abs(rest @ normal - offset) < tol
    if on.sum() < fewest:
        return None
    noise = float(np.sqrt(((rest[on] @ normal - offset) ** 2).mean()))
    return Plane(normal.astype(np.float32), offset, noise)
