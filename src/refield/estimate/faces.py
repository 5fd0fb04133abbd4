"""The old surfaces under the changed pixels, one per thing: cut by colour and where the depth jumps, joined over views.

Behind what arrived lies something that only seems changed; where it and what left are side by side, the hull is one
piece of both, and so is everything solid behind them as far as anyone can see. But in the old field's pictures what
left is all inside the changed pixels, while what is behind the newcomer goes on outside of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from refield.estimate.detect import Changed, Mask
from refield.estimate.hull import Hull, HullConfig, votes
from refield.estimate.lattice import Body, Lattice, Voxels, components, grown
from refield.estimate.look import Array, View
from refield.vision import pixels
from refield.vision.segmenter import Segmenter, cut_out

_JUMP = 5.0  # pixels' widths; a surface that is fitted well bends by less from one pixel to the next
_SPEAKS = 0.1  # of the changed pixels that a segmenter must call things; else it found none
_SHARED = 0.3  # of the smaller of two faces' voxels, for them to be one


@dataclass(frozen=True)
class Part:
    """A solid part of the change hull."""

    carved: Hull
    voxels: Voxels
    where: Voxels
    """voxels at which, or before which, most views show a thing, and none shows anything else"""

    @cached_property
    def body(self) -> Body:
        return Body(self.carved.lattice, self.voxels)


@dataclass(frozen=True)
class Parts:
    """What is solid in the change hull, in parts, the largest first."""

    things: list[Part]
    """those that look like things"""
    others: list[Part]
    """those that go on outside of the changed pixels"""


def changed_parts(changed: Sequence[Changed], hulls: Sequence[Hull], config: HullConfig, segmenter: Segmenter) -> Parts:
    """Solid parts of the change hull.

    Each has one surface and reaches no deeper behind it than that is wide.
    """
    marked = [_things_in(c, segmenter) for c in changed]
    found = [_parts_in(carved, changed, marked, config) for carved in hulls]

    def sorted_(parts: Iterable[list[Part]]) -> list[Part]:
        return sorted((p for some in parts for p in some), key=lambda p: p.body.volume, reverse=True)

    return Parts(sorted_(things for things, _ in found), sorted_(others for _, others in found))


def _parts_in(
    carved: Hull, changed: Sequence[Changed], marked: Sequence[Mask], config: HullConfig
) -> tuple[list[Part], list[Part]]:
    """One place's solid parts: those that look like things, and the others."""
    lattice = carved.lattice
    solid = carved.hull & carved.solid & carved.free
    own = _joined([f for c, t in zip(changed, marked) for f in _faces_in(c.view, c.mask & t, lattice, solid)])
    behind = _joined([f for c, t in zip(changed, marked) for f in _faces_in(c.view, c.mask & ~t, lattice, solid)])
    faces = own + behind
    if not faces:
        return [], []
    label = np.zeros(lattice.shape, np.int32)
    for k, face in enumerate(faces, start=1):
        label[face & (label == 0)] = k
    (box,) = ndimage.find_objects(solid.astype(np.int8))  # the faces lie in it, and nothing else is asked for
    nearest = ndimage.distance_transform_edt(label[box] == 0, return_distances=False, return_indices=True)
    label[box] = label[box][tuple(nearest)]
    things: list[Part] = []
    others: list[Part] = []
    where = _where(lattice.centres.reshape(-1, 3), changed, marked, config).reshape(lattice.shape)
    for k, face in enumerate(faces, start=1):
        at = lattice.centres[face]
        width = float((at.max(0) - at.min(0)).max()) + lattice.cell
        mine = solid & (label == k) & (carved.behind < width)
        parts = [p for p in components(mine, config.smallest) if (p & face).any()]
        (things if k <= len(own) else others).extend(Part(carved, voxels, where) for voxels in parts)
    return things, others


def _where(points: Array, changed: Sequence[Changed], marked: Sequence[Mask], config: HullConfig) -> Mask:
    """Points (N, 3) at which, or before which, most views show a thing, and none shows anything else.

    Views in which the segmenter finds next to nothing say nothing.
    """
    shown = [(c, c.mask & mask) for c, mask in zip(changed, marked)]
    told = [(c.witness(), pixels.dilate(m, config.margin)) for c, m in shown if m.sum() > _SPEAKS * c.mask.sum()]
    count, against = votes(points, told, config)
    return (against == 0) & (2 * count > len(told))


def _things_in(c: Changed, segmenter: Segmenter) -> Mask:
    """Changed pixels at which the old field shows something that is nowhere outside of them."""
    label, count = ndimage.label(c.mask)
    if count == 0:
        return c.mask
    hints = np.stack([label == k for k in range(1, count + 1)])
    return cut_out(segmenter, c.view.rgb, hints)


def _faces_in(view: View, mask: Mask, lattice: Lattice, allowed: Voxels) -> list[Voxels]:
    """The voxels at each smooth piece of the old surface under a mask."""
    label, count = ndimage.label(mask & ~_jumps(view))
    if count == 0:
        return []
    footprint = view.pixel_angle * float(np.median(view.depth[label > 0]))
    reach = max(1, int(np.ceil(0.75 * footprint / lattice.cell))) if np.isfinite(footprint) else 1
    out = []
    for k in range(1, count + 1):
        points = view.surface[label == k]
        ijk, inside = lattice.index(points[np.isfinite(points).all(-1)])
        if not inside.any():
            continue
        face = np.zeros(lattice.shape, bool)
        face[tuple(ijk[inside].T)] = True
        out.append(grown(face, reach) & allowed)
    return [f for f in out if f.any()]


def _jumps(view: View) -> Mask:
    """Pixels at which the depth bends by more than a surface does."""
    far = float(np.nanmax(np.where(np.isfinite(view.depth), view.depth, np.nan), initial=1.0))
    depth = np.where(np.isfinite(view.depth), view.depth, 2 * far)
    bend: Array = np.zeros(view.shape, np.float32)
    bend[1:-1] = np.abs(depth[:-2] - 2 * depth[1:-1] + depth[2:])
    bend[:, 1:-1] = np.maximum(bend[:, 1:-1], np.abs(depth[:, :-2] - 2 * depth[:, 1:-1] + depth[:, 2:]))
    return bend > _JUMP * view.pixel_angle * depth


def _joined(faces: Sequence[Voxels]) -> list[Voxels]:
    """Faces that share voxels put together."""
    if not faces:
        return []
    flat = np.stack([f.ravel() for f in faces])
    few = flat[:, flat.any(0)].astype(np.float32)
    sizes, shared = few.sum(1), few @ few.T
    same = shared > _SHARED * np.minimum(sizes[:, None], sizes[None])
    _, group = connected_components(coo_matrix(same), directed=False)
    return [flat[group == g].any(0).reshape(faces[0].shape) for g in range(group.max() + 1)]
