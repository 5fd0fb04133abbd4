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
from scipy import ndimage

from refield.estimate.carve_kernels import Window, count_votes, find_behind, packed
from refield.estimate.detect import Changed, Mask
from refield.estimate.lattice import EVERY_WAY, Lattice, Voxels
from refield.estimate.look import Array, View
from refield.vision import pixels


@dataclass(frozen=True)
class HullConfig:
    """How the change hull is carved."""

    longest: int = 96
    """voxels along the longest side"""
    ray_steps: int = 64
    """samples along each changed pixel's ray when looking for where the hull is"""
    margin: int = 1
    """pixels the change masks are grown by before carving"""
    surface: float = 1.5
    """pixels; a point this close to the old surface is on it"""
    convincing: float = 0.06
    """clusters for which less than this part of the strongest's difference speaks are left out"""
    smallest: int = 40
    """voxels; smaller parts are dropped"""


@dataclass(frozen=True)
class Hull:
    """The carved change."""

    lattice: Lattice
    hull: Voxels
    """in the change mask of every view that sees it"""
    solid: Voxels
    """no old view looks through it"""
    unchanged: Voxels
    """some new view shows it as it was"""
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


def find_region(changed: Sequence[Changed], config: HullConfig) -> Lattice | None:
    """The lattice that holds everything that may be in the hull; None if no point can be."""
    seen = [(c.witness(), pixels.dilate(c.mask, config.margin)) for c in changed]
    needed = min(2, len(changed))
    kept = []
    for c in changed:
        points = _points_before_surface(c, config)
        if len(points) == 0:
            continue
        inside, against = votes(points, seen, config)
        kept.append(points[(inside >= needed) & (against == 0)])
    points = np.concatenate(kept) if kept else np.zeros((0, 3), np.float32)
    if len(points) < 20:
        return None
    points = _convincing(points, changed, config)
    low, high = np.quantile(points, 0.002, axis=0), np.quantile(points, 0.998, axis=0)
    pad = 0.06 * float((high - low).max())
    return Lattice.over((low - pad).astype(np.float32), (high + pad).astype(np.float32), config.longest)


def _convincing(points: Array, changed: Sequence[Changed], config: HullConfig) -> Array:
    """The points without clusters that hardly any difference speaks for: a poor field's errors meet far away."""
    lattice = Lattice.over(points.min(0), points.max(0), 48)
    ijk, _ = lattice.index(points)
    filled = np.zeros(lattice.shape, bool)
    filled[tuple(ijk.T)] = True
    labels, count = ndimage.label(filled, EVERY_WAY)
    owner = labels[tuple(ijk.T)]
    mass = np.array([_mass(points[owner == k], changed) for k in range(1, count + 1)])
    keep = np.concatenate([[False], mass > config.convincing * mass.max()])
    return points[keep[owner]]


def _mass(points: Array, changed: Sequence[Changed]) -> float:
    """Colour difference under a cluster, summed over pixels and views, less if some views that look there see none."""
    mass, agree, asked = 0.0, 0.0, 0.0
    for c in changed:
        uv, _, inside = c.view.project(points)
        on = np.zeros(c.view.shape, bool)
        ij = uv[inside].astype(np.int64)
        on[ij[:, 1], ij[:, 0]] = True
        mass += float(c.difference[on & c.mask].sum()) / (c.view.camera.width * c.view.camera.height)
        agree += float(c.view.lookup(c.mask, uv, inside)[inside].sum())
        asked += float(inside.sum())
    return mass * (agree / max(asked, 1.0)) ** 2


def _points_before_surface(c: Changed, config: HullConfig, at_most: int = 2500) -> Array:
    ys, xs = np.nonzero(c.mask)
    if len(ys) == 0:
        return np.zeros((0, 3), np.float32)
    pick = np.linspace(0, len(ys) - 1, min(at_most, len(ys))).astype(int)
    d, depth = c.view.directions[ys[pick], xs[pick]], c.view.depth[ys[pick], xs[pick]]
    finite = c.view.depth[np.isfinite(c.view.depth)]
    far = float(np.quantile(finite, 0.95)) if len(finite) else 1.0
    reach = np.minimum(depth, far) * 1.05
    t = np.linspace(0.1, 1.0, config.ray_steps, dtype=np.float32)
    return (c.view.centre + d[:, None] * (reach[:, None] * t)[..., None]).reshape(-1, 3).astype(np.float32)


def carve(lattice: Lattice, seen: Sequence[tuple[View, Mask]], old: Sequence[View], config: HullConfig) -> Hull:
    """The hull on a lattice, from the new views' masks and the old renderings."""
    points = lattice.centres.reshape(-1, 3)
    inside, against = votes(points, [(v, pixels.dilate(m, config.margin)) for v, m in seen], config)
    hull = (inside >= min(2, len(seen))) & (against == 0)
    through, behind = look_behind(points, old, config)
    found = (hull, ~through, against > 0, behind)
    return Hull(lattice, *(a.reshape(lattice.shape) for a in found))
