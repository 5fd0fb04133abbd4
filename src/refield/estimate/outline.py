"""An object's solid shape as it was, carved by every old view (§10.2.4).

The paper asks a segmenter for the object in every old photo and keeps the grid points that fall inside. The field says
what each old view sees, so an object that stands free needs no segmenter; one that runs into others does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import ConvexHull

from refield.estimate.carve_kernels import Window, find_solid, packed
from refield.estimate.lattice import Lattice, Voxels, components, grown, some_of
from refield.estimate.look import Array, spread_out
from refield.estimate.objects import Old, Patch, corners_of, look_around, surface_cloud
from refield.field.radiance import Field
from refield.field.source import Known
from refield.scene.capture import Frame
from refield.scene.planes import Plane
from refield.vision import pixels
from refield.vision.segmenter import Segmenter, cut_out

FEWEST_POINTS = 30
"""of an object's surface; of fewer it cannot be found again"""
_MORE = 1.5  # times a piece's volume, that a whole must have to be another thing
_FOUND = 0.25  # of an object's voxels that a segmenter must leave to be believed


@dataclass(frozen=True)
class ObjectConfig:
    """How an object's shape is found."""

    longest: int = 64
    """voxels along the longest side of the box around the object"""
    box: float = 1.6
    """size of that box relative to the changed part"""
    rays: int = 60_000
    """looked along, over all old views together"""
    through: float = 0.05
    """a voxel is empty if more than this part of the old views that look at it look through it"""
    outside: float = 0.3
    """a voxel of an object that runs into others is not its own if more than this part of the old views say so"""
    changed: float = 0.5
    """part of an object's voxels that must be seeds for it to be taken whole"""
    glances: int = 24
    """old views that an object known from an earlier visit is looked at in"""
    points: int = 1500
    """on the coloured surface"""


@dataclass(frozen=True)
class Seeds:
    """What is known of an object before its shape is."""

    lattice: Lattice
    changed: Voxels
    """in the change hull and solid in the old field: certainly part of it"""
    hull: Voxels
    """in the change hull: it may be part of it"""
    unchanged: Voxels
    """some new view shows it as it was: hardly part of it"""
    thing: Voxels
    """most new views show it, or what is before it, as a thing: what is changed elsewhere may be its surroundings"""


def outline(
    field: Field,
    frames: Sequence[Frame],
    seeds: Seeds,
    planes: Sequence[Plane],
    segmenter: Segmenter,
    config: ObjectConfig,
) -> Old | None:
    """The whole object that the changed voxels belong to, or None if no old view shows one.

    Args:
        planes: what the object may stand on or lean against; not part of it.
    """
    places = seeds.lattice.centres[seeds.changed]
    middle, half = (places.min(0) + places.max(0)) / 2, (places.max(0) - places.min(0)) / 2
    half = np.maximum(half * config.box, half + 3 * seeds.lattice.cell)
    low, high = middle - half, middle + half
    patches = look_around(field, frames, corners_of(low, high), config.rays)
    if not patches:
        return None
    lattice = Lattice.over(low, high, config.longest)
    solid = carve_solid(lattice, patches, config.through, float((places.max(0) - places.min(0)).max()))
    free = free_voxels(lattice, planes)
    voxels, stands_free = _connected(lattice, solid & free, seeds, config)
    inner = None
    if voxels.any() and not stands_free:
        core = seeds.changed & seeds.thing
        if FEWEST_POINTS <= core.sum() < seeds.changed.sum():
            inner = outline(field, frames, replace(seeds, changed=core), planes, segmenter, config)
        cut = _cut_out(lattice, voxels, patches, segmenter, config)
        if cut.sum() < _FOUND * voxels.sum():  # where colours are much alike, a segmenter may find nothing of it
            sure = components(voxels & seeds.lattice.holds(grown(seeds.changed, 1), lattice.centres), 30)
            cut = sure[0] if sure else cut
        voxels = cut
    if not voxels.any():
        return inner
    old = seen_as(lattice, voxels, free, patches, planes, config)
    return old if inner is None else replace(inner, instead=old)


def remembered(
    field: Field, frames: Sequence[Frame], known: Known, planes: Sequence[Plane], config: ObjectConfig
) -> Old | None:
    """An object whose shape an earlier visit found, where it stood before this one (§11.3.2); None if no view shows it.

    Nothing is segmented or carved; a few old views are enough to see its colours again.
    """
    low, high = known.grid.tight_aabb().numpy()
    pad = 0.2 * float((high - low).max())
    lattice = Lattice.over(low - pad, high + pad, config.longest)
    voxels = known.grid.contains(torch.from_numpy(lattice.centres)).numpy()
    some = spread_out(frames, config.glances)
    patches = look_around(field, some, corners_of(low - pad, high + pad), config.rays * config.glances // len(frames))
    if not patches or not voxels.any():
        return None
    cloud = surface_cloud(lattice, voxels, patches, config.points)
    free = free_voxels(lattice, planes)
    if len(cloud.points) < FEWEST_POINTS:
        return None
    return Old(lattice, voxels, free, cloud, tuple(patches), remembered=True, source=known.source)


def standing(
    field: Field, frames: Sequence[Frame], piece: Old, planes: Sequence[Plane], config: ObjectConfig
) -> Old | None:
    """The whole thing that an outline is a piece of, if it stands free; None if there is no more of it.

    Of a thing that slid, only what it hides and shows by that is changed: strips, about as long as it is wide.
    """
    places = piece.lattice.centres[piece.voxels]
    side = float((places.max(0) - places.min(0)).max())
    low, high = places.min(0) - side, places.max(0) + side
    patches = look_around(field, frames, corners_of(low, high), config.rays)
    if not patches:
        return None
    lattice = Lattice.over(low, high, config.longest)
    free = free_voxels(lattice, planes)
    solid = carve_solid(lattice, patches, config.through, 3 * side) & free
    start = piece.lattice.holds(piece.voxels, lattice.centres)
    parts = [p for p in components(solid, FEWEST_POINTS) if (p & start).any()]
    voxels = np.logical_or.reduce(parts) if parts else np.zeros_like(solid)
    if not parts or _at_border(voxels):
        return None
    whole = seen_as(lattice, voxels, free, patches, planes, config)
    return whole if whole is not None and whole.volume > _MORE * piece.volume else None


def seen_as(
    lattice: Lattice,
    voxels: Voxels,
    free: Voxels,
    patches: Sequence[Patch],
    planes: Sequence[Plane],
    config: ObjectConfig,
) -> Old | None:
    """Voxels without holes, and without what is not between what is seen of them, as an object; None if the patches
    show too little of its surface."""
    voxels = ndimage.binary_fill_holes(voxels)
    cloud = surface_cloud(lattice, voxels, patches, config.points)
    if len(cloud.points) >= FEWEST_POINTS:
        voxels = _between(lattice, voxels, cloud.points, planes)
        cloud = surface_cloud(lattice, voxels, patches, config.points)
    return Old(lattice, voxels, free, cloud, tuple(patches)) if len(cloud.points) >= FEWEST_POINTS else None


def as_one(
    field: Field, frames: Sequence[Frame], pieces: Sequence[Old], planes: Sequence[Plane], config: ObjectConfig
) -> Old | None:
    """Pieces of a thing put together; None if they do not touch, or old photos (``frames``) show too little of it."""
    at = np.concatenate([piece.lattice.centres[piece.voxels] for piece in pieces])
    middle, half = (at.min(0) + at.max(0)) / 2, (at.max(0) - at.min(0)) / 2
    half = np.maximum(half * config.box, half + 3 * max(piece.lattice.cell for piece in pieces))
    low, high = middle - half, middle + half
    patches = look_around(field, frames, corners_of(low, high), config.rays)
    lattice = Lattice.over(low, high, config.longest)
    voxels = np.logical_or.reduce([piece.lattice.holds(piece.voxels, lattice.centres) for piece in pieces])
    if not patches or len(components(grown(voxels, 1), 1)) > 1:
        return None
    return seen_as(lattice, voxels, free_voxels(lattice, planes), patches, planes, config)


def _between(lattice: Lattice, voxels: Voxels, seen: Array, planes: Sequence[Plane]) -> Voxels:
    """Those of an object's voxels in the convex hull of what is seen of it (N, 3) and of what is beneath that, down to
    what it stands on: where cameras look from some sides only, all that is behind it might be of it as well."""
    feet = []
    for plane in planes:
        height = plane.above(lattice.centres[voxels])
        if height.min() < 2 * max(lattice.cell, plane.noise):
            feet.append(seen - plane.height(seen)[:, None] * plane.normal)
    corners = np.concatenate([seen, *feet]).astype(np.float64)
    hull = ConvexHull(corners, qhull_options="QJ").equations.astype(np.float32)
    return some_of(voxels, (lattice.centres[voxels] @ hull[:, :3].T + hull[:, 3] <= lattice.cell).all(-1))


def free_voxels(lattice: Lattice, planes: Sequence[Plane]) -> Voxels:
    """Voxels in front of what holds things up."""
    free = np.ones(lattice.shape, bool)
    for plane in planes:
        free &= plane.above(lattice.centres) > max(0.25 * lattice.cell, plane.noise)
    return free


def _connected(lattice: Lattice, solid: Voxels, seeds: Seeds, config: ObjectConfig) -> tuple[Voxels, bool]:
    """The solid parts that the seeds belong to; less and less of them if they reach far beyond what changed.

    And whether they are all that is solid there.

    An object that stands free is taken whole, also where its change was not noticed. One that runs into others (or into
    what no old view sees) loses first what certainly did not change, then all that is not in the change hull, then all
    that is not a seed.
    """
    start = seeds.lattice.holds(grown(seeds.changed, 1), lattice.centres)
    kept = ~seeds.lattice.holds(seeds.unchanged, lattice.centres)
    hull = seeds.lattice.holds(grown(seeds.hull, 1), lattice.centres)
    for allowed in (solid, solid & kept, solid & hull, start & solid):
        here = start & allowed
        parts = [p for p in components(allowed, 30) if (p & here).sum() > min(0.3 * here.sum(), 0.4 * p.sum())]
        voxels = np.logical_or.reduce(parts) if parts else np.zeros_like(solid)
        if (voxels & here).sum() > config.changed * voxels.sum() and not _at_border(voxels):
            break
    return voxels, allowed is solid


def _cut_out(
    lattice: Lattice, voxels: Voxels, patches: Sequence[Patch], segmenter: Segmenter, config: ObjectConfig
) -> Voxels:
    """Voxels without those that too many old views show outside of the object, by a segmenter (§10.2.4)."""
    points = lattice.centres[voxels]
    thick = float((points.max(0) - points.min(0)).max())
    asked, outside = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    near = grown(voxels, 1)
    for p in patches:
        hint = pixels.close(lattice.holds(near, p.points), 3)
        if hint.sum() < 12:
            continue
        mask = cut_out(segmenter, p.rgb, hint[None])
        where, inside = p.pixel_of(torch.from_numpy(points))
        behind = p.behind_surface(torch.from_numpy(points)).numpy()
        seen = inside.numpy() & (behind < thick)
        asked += seen
        outside += seen & ~mask.ravel()[where.numpy()]
    parts = components(some_of(voxels, outside <= config.outside * asked), 30)
    return parts[0] if parts else np.zeros_like(voxels)


def _at_border(voxels: Voxels) -> bool:
    """Whether voxels reach the border of their lattice, which is well beyond what is known of the object."""
    inner = np.zeros_like(voxels)
    inner[1:-1, 1:-1, 1:-1] = True
    return bool((voxels & ~inner).any())


def restricted(old: Old, voxels: Voxels, config: ObjectConfig) -> Old:
    """The same object with other voxels."""
    cloud = surface_cloud(old.lattice, voxels, old.patches, config.points)
    return replace(old, voxels=voxels, cloud=cloud)


def carve_solid(lattice: Lattice, patches: Sequence[Patch], through: float, deepest: float) -> Voxels:
    """Voxels that at most the part ``through`` of the old views look through (§10.2.4's projection check), and that are
    at most ``deepest`` (world units) behind the surface in some view."""
    points = lattice.centres.reshape(-1, 3)
    order = np.random.default_rng(0).permutation(len(patches))  # views that differ most come soon: air is dropped early
    ordered = [patches[k] for k in order]
    lenses, depths = packed(Window(p.camera, p.frame.world_from_cam, p.depth, p.box[:2]) for p in ordered)
    solid = np.zeros(len(points), bool)
    find_solid(points, lenses, depths, 0.75 * lattice.cell, float(through * len(patches)), float(deepest), solid)
    return solid.reshape(lattice.shape)
