"""The change hull in 3-D: where something was and is not, where something is and was not.

A voxel that lies in the change mask of every view that sees it is in the hull. In the hull and solid in the old field:
something *was* there; in the hull and empty in the old field: something *is* there now. "Solid" means that no old
view looks through it, so an opaque thing's inside counts, whatever the field holds there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from refield.estimate.carve_kernels import Window, count_votes, find_behind, packed
from refield.estimate.detect import Changed, Mask
from refield.estimate.lattice import Lattice, Voxels
from refield.estimate.look import Array, View
from refield.scene.planes import Plane
from refield.vision import pixels

_RESOLVED = 2.0  # pixels; what is nearer to each other is one
_ROOM = 0.3  # of a place's largest side, around it: as much as around the box in which an old object is outlined


@dataclass(frozen=True)
class HullConfig:
    """How the change hull is carved."""

    longest: int = 128
    """voxels along the longest side of each place, with room around it; of each newcomer"""
    ray_steps: int = 64
    """samples along each changed pixel's ray when looking for where the hull is"""
    margin: int = 1
    """pixels the change masks are grown by before carving"""
    surface: float = 1.5
    """pixels; a point this close to the old surface is on it"""
    smallest: int = 40
    """voxels; smaller parts are dropped"""


@dataclass(frozen=True)
class Hull:
    """The carved change around one place."""

    lattice: Lattice
    hull: Voxels
    """in the change mask of every view that sees it"""
    solid: Voxels
    """no old view looks through it"""
    unchanged: Voxels
    """some new view shows it as it was"""
    free: Voxels
    """in front of what holds things up"""
    behind: Array
    """how far behind the old surface it is, in the view that comes nearest to it; world units"""


def tolerance(view: View, distance: Array, config: HullConfig) -> Array:
    """How far from the old surface a point may be and still be on it, world units."""
    return (config.surface * view.pixel_angle * distance).astype(np.float32)


def votes(points: Array, seen: Sequence[tuple[View, Mask]], config: HullConfig) -> tuple[Array, Array]:
    """How many views show each point (N, 3) in their mask, and how many contradict that it changed.

    A view contradicts where its mask does not hold the point and the old surface there is not in front of it.
    """
    inside_count, against = np.zeros(len(points), np.int16), np.zeros(len(points), np.int16)
    masks = np.concatenate([np.zeros(0, bool), *(mask.ravel() for _, mask in seen)], dtype=bool)
    count_votes(_rows(points), *_windows([view for view, _ in seen], config), masks, inside_count, against)
    return inside_count, against


def look_behind(points: Array, views: Sequence[View], config: HullConfig) -> tuple[NDArray[np.bool_], Array]:
    """Whether some old rendering looks through each point (N, 3), and how far behind the old surface it is, in the
    view that comes nearest to it; inf where none looks."""
    through, behind = np.zeros(len(points), bool), np.zeros(len(points), np.float32)
    find_behind(_rows(points), *_windows(views, config), through, behind)
    return through, behind


def _rows(points: Array) -> Array:
    return np.ascontiguousarray(points, np.float32)


def _windows(views: Sequence[View], config: HullConfig) -> tuple[Array, Array, Array]:
    """What the kernels know whole views by, and their tolerances per unit of distance."""
    lenses, depths = packed(Window(v.camera, v.frame.world_from_cam, v.depth) for v in views)
    return lenses, depths, np.array([config.surface * v.pixel_angle for v in views], np.float64)


def find_regions(changed: Sequence[Changed], config: HullConfig, least: float) -> list[Lattice]:
    """Lattices around what may be in the hull, apart from each other; none where fewer than the part ``least`` of every
    photo's pixels speak for it.

    Each place has its own, or a small thing would have no voxels beside a large one, or beside a poor field's errors
    that meet far away.
    """
    seen = [(c.witness(), pixels.dilate(c.mask, config.margin)) for c in changed]
    needed = min(2, len(changed))
    kept, steps = [np.zeros((0, 3), np.float32)], [0.0]
    for c in changed:
        points, step = _points_before_surface(c, config)
        if len(points):
            inside, against = votes(points, seen, config)
            kept.append(points[(inside >= needed) & (against == 0)])
            steps.append(step)
    places = [p for p in _clusters(np.concatenate(kept), max(steps)) if _share(p, changed) >= least]
    boxes = [np.quantile(p, [0.002, 0.998], axis=0) for p in places]
    return [_lattice_over(box, changed, config) for box in _apart([_padded(box) for box in boxes])]


def _clusters(points: Array, step: float) -> list[Array]:
    """Points (N, 3) in parts between which there is more than a ``step``."""
    cells, cell_of = np.unique(np.floor(points / max(step, 1e-9)).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.0, p=np.inf, output_type="ndarray")
    beside = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    count, label = connected_components(beside, directed=False)
    return [points[label[cell_of.ravel()] == k] for k in range(count)]


def _share(points: Array, changed: Sequence[Changed]) -> float:
    """Part of a photo's pixels that changed where points (N, 3) are, in the photo in which it is largest."""
    shares = [0.0]
    for c in changed:
        uv, _, inside = c.view.project(points)
        on = np.zeros(c.view.shape, bool)
        ij = uv[inside].astype(np.int64)
        on[ij[:, 1], ij[:, 0]] = True
        shares.append(float((pixels.close(on, 5) & c.mask).mean()))
    return max(shares)


def _padded(box: Array) -> Array:
    """A box (2, 3) with room around it for what is asked of an object's surroundings."""
    pad = _ROOM * (box[1] - box[0]).max()
    return np.stack([box[0] - pad, box[1] + pad])


def _apart(boxes: list[Array]) -> list[Array]:
    """Boxes (2, 3), those that overlap put together until none do."""
    out: list[Array] = []
    for box in boxes:
        while True:
            meets = [o for o in out if (np.maximum(box[0], o[0]) < np.minimum(box[1], o[1])).all()]
            if not meets:
                break
            out = [o for o in out if not any(o is m for m in meets)]
            box = np.stack([np.min([o[0] for o in (box, *meets)], 0), np.max([o[1] for o in (box, *meets)], 0)])
        out.append(box)
    return out


def _lattice_over(box: Array, changed: Sequence[Changed], config: HullConfig) -> Lattice:
    """A lattice over a box (2, 3), no finer than photos resolve what is in it."""
    pixel = min(float(np.linalg.norm(box.mean(0) - c.view.centre)) * c.view.pixel_angle for c in changed)
    return Lattice.over(box[0].astype(np.float32), box[1].astype(np.float32), config.longest, _RESOLVED * pixel)


def _points_before_surface(c: Changed, config: HullConfig, at_most: int = 2500) -> tuple[Array, float]:
    """Points (N, 3) along the rays of changed pixels, and how far they are from each other on most of them."""
    ys, xs = np.nonzero(c.mask)
    if len(ys) == 0:
        return np.zeros((0, 3), np.float32), 0.0
    pick = np.linspace(0, len(ys) - 1, min(at_most, len(ys))).astype(int)
    d, depth = c.view.directions[ys[pick], xs[pick]], c.view.depth[ys[pick], xs[pick]]
    finite = c.view.depth[np.isfinite(c.view.depth)]
    far = float(np.quantile(finite, 0.95)) if len(finite) else 1.0
    reach = np.minimum(depth, far) * 1.05
    t = np.linspace(0.1, 1.0, config.ray_steps, dtype=np.float32)
    points = c.view.centre + d[:, None] * (reach[:, None] * t)[..., None]
    return points.reshape(-1, 3).astype(np.float32), float(np.median(reach) * (t[1] - t[0]))


def carve(
    lattice: Lattice,
    seen: Sequence[tuple[View, Mask]],
    old: Sequence[View],
    planes: Sequence[Plane],
    config: HullConfig,
) -> Hull:
    """The hull on a lattice, from the new views' masks, the old renderings, and what holds things up."""
    points = lattice.centres.reshape(-1, 3)
    inside, against = votes(points, [(v, pixels.dilate(m, config.margin)) for v, m in seen], config)
    hull = (inside >= min(2, len(seen))) & (against == 0)
    through, behind = look_behind(points, old, config)
    free = np.ones(len(points), bool)
    for plane in planes:
        free &= plane.above(points) > max(0.5 * lattice.cell, plane.noise)
    return Hull(lattice, *(a.reshape(lattice.shape) for a in (hull, ~through, against > 0, free, behind)))
