"""A thing picked out of a field by a point on its surface: what is solid around it and stands on nothing but ground."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from refield.estimate.lattice import Lattice, Voxels, components, grown
from refield.estimate.look import Array, spread_out
from refield.estimate.objects import Patch, corners_of, look_around
from refield.estimate.outline import ObjectConfig, Seeds, carve_solid, outline
from refield.field.radiance import Field
from refield.field.render import render_many
from refield.scene.capture import Capture, Frame, Rays, centres
from refield.scene.change import OccupancyGrid
from refield.scene.planes import Plane, rough_planes
from refield.vision.segmenter import GrabCutSegmenter

_VIEWS, _RAYS = 24, 30_000  # of the old photos' places, from which its surroundings are looked at
_REACH, _GROWTH = 0.08, 0.6  # of the cameras' distance: half a side of the first box; of a box that is too small
_LARGEST = 1.0  # of the cameras' distance: a box that is larger holds more than a thing
_VOXELS = 40  # along a box's side
_SMALLEST = 30  # voxels
_HIGH = 4.0  # voxels: what rises less above what it lies on is that
_NEAR = 2.5  # voxels: how far from the point a thing may begin


def thing_at(field: Field, capture: Capture, x: Tensor) -> OccupancyGrid | None:
    """Where the thing is whose surface is at the world point ``x`` (3,); None if nothing there stands by itself.

    It is looked for in a box that grows on the sides that it touches, until it holds it whole. What it stands or leans
    on is found as planes, and is no part of it.
    """
    frames = spread_out(capture.train, _VIEWS)
    point = x.detach().cpu().numpy().astype(np.float32)
    distance = float((centres(frames) - x.double()).norm(dim=1).median())
    low, high = point - _REACH * distance, point + _REACH * distance
    while float((high - low).max()) < _LARGEST * distance:
        patches = look_around(field, frames, corners_of(low, high), _RAYS)
        if not patches:
            return None
        planes = _planes(patches, low, high)
        lattice = Lattice.over(low, high, _VOXELS)
        found = _component(lattice, patches, planes, point)
        # in a box that holds little more than one of its faces, that face is taken for ground
        before, beyond = (np.ones(3, bool), np.ones(3, bool)) if found is None else _touched(found)
        if found is not None and not before.any() and not beyond.any():
            return _whole(field, capture.train, lattice, found, planes)
        side = high - low
        low, high = low - _GROWTH * side * before, high + _GROWTH * side * beyond
    return None


def _touched(voxels: Voxels) -> tuple[Array, Array]:
    """(3,) bool each: on which axes voxels reach the lattice's lower sides, and its upper ones."""
    along = [np.nonzero(voxels.any(tuple({0, 1, 2} - {axis})))[0] for axis in range(3)]
    ends = [(int(at[0]) == 0, int(at[-1]) == n - 1) for at, n in zip(along, voxels.shape)]
    return np.array([a for a, _ in ends]), np.array([b for _, b in ends])


def _planes(patches: list[Patch], low: Array, high: Array) -> list[Plane]:
    """What holds things up in a box."""
    points = np.concatenate([p.points.reshape(-1, 3) for p in patches])
    points = points[np.isfinite(points).all(-1)]
    points = points[((points > low) & (points < high)).all(-1)]
    points = points[np.random.default_rng(0).permutation(len(points))[:6000]]
    middle = (low + high) / 2
    pixels = [float(np.linalg.norm(p.centre - middle)) / p.camera.fx for p in patches]
    return rough_planes(points, np.stack([p.centre for p in patches]), float(np.median(pixels)))


def _component(lattice: Lattice, patches: list[Patch], planes: list[Plane], point: Array) -> Voxels | None:
    """The connected solid part next to a point; None if there is none."""
    free = np.ones(lattice.shape, bool)
    for plane in planes:
        free &= plane.height(lattice.centres) > max(0.5 * lattice.cell, plane.noise)
    side = lattice.cell * max(lattice.shape)
    solid = carve_solid(lattice, patches, ObjectConfig().through, side) & free
    apart = np.linalg.norm(lattice.centres - point, axis=-1)
    for part in components(solid, _SMALLEST):
        if apart[part].min() < _NEAR * lattice.cell:
            high = (float(plane.height(lattice.centres[part]).max()) for plane in planes)
            return part if all(h > _HIGH * lattice.cell for h in high) else None
    return None


def _whole(
    field: Field, frames: tuple[Frame, ...], lattice: Lattice, found: Voxels, planes: list[Plane]
) -> OccupancyGrid | None:
    """Its shape by all old views, as an update finds it."""
    seeds = Seeds(lattice, changed=found, hull=grown(found, 2), unchanged=np.zeros_like(found), thing=found)
    old = outline(field, frames, seeds, planes, GrabCutSegmenter(), ObjectConfig())
    return None if old is None else old.grid


def surface_at(field: Field, origin: Tensor, direction: Tensor) -> Tensor | None:
    """Where a ray, world (3,) and (3,) unit, meets a surface of the field, (3,); None if it meets none."""
    seen = render_many(field, Rays(origin.float()[None], direction.float()[None]))
    if float(seen.opacity[0]) < 0.5:
        return None
    return (origin + direction * seen.depth[0]).float()
