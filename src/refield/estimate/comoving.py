"""Which of the surfaces around a moved object went along with it: its outline, once its motion is known.

An outline is first a guess, from what changed and what is solid. Its motion says more. A surface that went along shows
what was behind it where it was, and itself where it is now; one that stayed shows itself where it was, and where the
motion would put it the photos show what was there anyway. Each point of the old surfaces is asked for both in every new
photo, and what no photo shows goes with its neighbours: those that are near, alike in colour and not across a hollow
(a random walker with priors, Grady 2005).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.sparse import csc_matrix, diags
from scipy.sparse.csgraph import laplacian
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from torch import Tensor

from refield.estimate.alone import object_alone
from refield.estimate.explain import LIMIT
from refield.estimate.ground import Ground
from refield.estimate.lattice import Lattice, Voxels, components
from refield.estimate.light import DARK, LARGEST, Ratio
from refield.estimate.look import Array
from refield.estimate.objects import Cloud, Old, Patch, corners_of, look_around
from refield.estimate.outline import FEWEST_POINTS, carve_solid, free_voxels, seen_as
from refield.estimate.past import Past
from refield.estimate.split import alike
from refield.scene.pose import transform
from refield.scene.srgb import to_linear, to_srgb
from refield.vision import pixels

_AROUND = 0.5  # of an object's longest side, on every side of it, is asked whether it went along
_TIMES = 3  # that is asked, of what is found to reach further; each reaches twice as far as the one before
_POINTS = 4000  # on all surfaces there
_SEEN = 2  # old pixels that must show a surface in a voxel
_UNKNOWN = 0.6  # what a photo costs that shows what nobody knew
_LIT = 0.3  # and one that shows the same in another light
_FACING = 0.2  # cosine, from which on a photo shows a surface well enough
_STIFF = 20.0  # what neighbours of the usual likeness weigh beside one photo


@dataclass(frozen=True)
class _Asked:
    """What the photos say of N points, summed over them."""

    stayed: Array
    """(N,) what it costs if it stayed"""
    went: Array
    """(N,) what it costs if it went along"""


def with_comoving(
    ground: Ground, old: Old, past: Sequence[Past], new_from_old: Tensor | None, others: Sequence[Old] = ()
) -> Old | None:
    """The object as all that went along with it from where it was; None if next to nothing did.

    Where that reaches the end of what was asked, what is around that is asked next.

    Args:
        past: the new photos, without what left and with what was placed before taken off.
        new_from_old: the pose change (4, 4); None if it left.
        others: what has a change of its own, and is no part of it.
    """
    along, asked = None, old
    for _ in range(_TIMES):
        found, ends = _along(ground, asked, past, new_from_old, others)
        if found is None:
            break
        along = found
        if ends or found.volume <= asked.volume:
            break
        asked = found
    return along


def _along(
    ground: Ground, old: Old, past: Sequence[Past], new_from_old: Tensor | None, others: Sequence[Old]
) -> tuple[Old | None, bool]:
    """What around an object went along with it, and whether that ends within what was asked."""
    places = old.lattice.centres[old.voxels]
    low, high = places.min(0), places.max(0)
    pad = _AROUND * float((high - low).max())
    low, high = low - pad, high + pad
    patches = look_around(ground.field, ground.photographed, corners_of(low, high), ground.shape.rays)
    if not patches:
        return None, True
    lattice = Lattice.over(low, high, ground.shape.longest)
    free = free_voxels(lattice, ground.planes)
    cloud, held = _surfaces(lattice, free, patches)
    if len(cloud.points) < FEWEST_POINTS:
        return None, True
    solid = carve_solid(lattice, patches, ground.shape.through, float((high - low).max())) & free | held
    asked = _asked(ground, old, cloud, past, new_from_old)
    likely = _walked(alike(cloud), asked)
    nearest = cKDTree(cloud.points).query(lattice.centres[solid])[1]
    voxels = np.zeros_like(solid)
    voxels[solid] = likely[nearest] > 0.5
    for other in others:
        voxels &= ~other.lattice.holds(other.voxels, lattice.centres)
    before = old.lattice.holds(old.voxels, lattice.centres)
    parts = [p for p in components(voxels, FEWEST_POINTS) if (p & before).any()]
    if not parts:
        return None, True
    part = max(parts, key=lambda p: (p & before).sum())
    ends = not any(part.take(k, axis).any() for axis in range(3) for k in (0, -1))
    return seen_as(lattice, part, free, patches, ground.planes, ground.shape), ends


def _surfaces(lattice: Lattice, free: Voxels, patches: Sequence[Patch]) -> tuple[Cloud, Voxels]:
    """What the old views see of all surfaces, thinned to the most frontal point of each voxel; and these voxels."""
    found: list[tuple[Array, ...]] = []
    for p in patches:
        xyz = p.points
        with np.errstate(invalid="ignore", over="ignore"):  # where the field is empty
            n = np.cross(np.gradient(xyz, axis=0), np.gradient(xyz, axis=1))
            n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-12)
            look = xyz - p.centre
            cosine = -(n * look).sum(-1) / np.linalg.norm(look, axis=-1)
        good = lattice.holds(free, xyz) & (cosine > _FACING)
        found.append(tuple(a[good] for a in (xyz, n, p.rgb, cosine)))
    xyz, n, rgb, cosine = (np.concatenate(a) for a in zip(*found))
    order = np.argsort(-cosine)
    ijk = lattice.index(xyz[order])[0]
    cells = np.ravel_multi_index(tuple(ijk.T), lattice.shape)
    _, first, count = np.unique(cells, return_index=True, return_counts=True)
    often = order[first[count >= _SEEN]]
    held = np.zeros(lattice.shape, bool)
    held[tuple(lattice.index(xyz[often])[0].T)] = True
    some = often[:: max(1, -(-len(often) // _POINTS))]
    return Cloud(*(np.ascontiguousarray(a[some], np.float32) for a in (xyz, n, rgb))), held


def _walked(weights: csc_matrix, asked: _Asked) -> Array:
    """(N,) how likely each point went along."""
    scale = _STIFF * weights.nnz / max(float(weights.sum()), 1e-12)
    return spsolve(
        (scale * laplacian(weights) + diags(asked.stayed + asked.went + 1e-4)).tocsc(), asked.stayed + 0.5e-4
    )


def _asked(ground: Ground, old: Old, cloud: Cloud, past: Sequence[Past], pose: Tensor | None) -> _Asked:
    """Ask every photo for every point, where it was and where it would be."""
    stayed, went = np.zeros(len(cloud.points)), np.zeros(len(cloud.points))
    shown = [_Shown.of(ground, old, p, pose) for p in past]
    if pose is not None:
        now = transform(pose, torch.from_numpy(cloud.points)).numpy().astype(np.float32)
        facing = (torch.from_numpy(cloud.normals).double() @ pose[:3, :3].T).numpy()
        colours = to_srgb(to_linear(cloud.colours) * _light(cloud, old, now, facing, shown))
    for s in shown:
        covered = np.full(s.past.view.shape, _UNKNOWN)
        if pose is not None:
            a, b = s.where_it_would_be(now, facing, colours)
            stayed, went = stayed + a, went + b
            covered = s.cost_of(now, facing, b)
        a, b = s.where_it_was(cloud, covered)
        stayed, went = stayed + a, went + b
    return _Asked(stayed, went)


@dataclass(frozen=True)
class _Shown:
    """A new photo beside the hypothesis that an object moved."""

    past: Past
    alone: Array
    """(H, W) depth of the moved object; inf where it is not"""
    front: Array
    """(H, W) depth of all else, as it is now"""
    before: Array
    """(H, W) what it costs to show the old field as it was"""
    behind: Array
    """(H, W) what it costs to show what was behind what left"""

    @staticmethod
    def of(ground: Ground, old: Old, p: Past, pose: Tensor | None) -> _Shown:
        view = p.view
        depth = np.full(view.shape, np.inf, np.float32)
        front = np.minimum(p.beyond, np.where(p.covered, p.depth, np.inf))
        if pose is not None:
            seen = object_alone(ground.field, old, view.rays, pose)
            depth = np.where(seen.opacity.numpy() > 0.5, seen.depth.numpy(), np.inf).reshape(view.shape)
            depth = np.where(depth < front * (1 + 2 * view.pixel_angle), depth, np.inf)
        wrong = LIMIT * p.changed.threshold
        before = np.where(p.changed.light, 0, np.minimum((p.changed.difference / wrong) ** 2, 1))
        even = Ratio.of(view, view.rgb, ground.detect).even_and_grey
        before = np.where(even, np.minimum(before, _LIT), before)
        behind = np.where(p.known, np.minimum((p.difference / wrong) ** 2, 1), _UNKNOWN)
        behind = np.where(p.changed.new, _UNKNOWN, behind)
        return _Shown(p, depth, front, before, behind)

    def where_it_was(self, cloud: Cloud, covered: Array) -> tuple[Array, Array]:
        """What it costs if the points stayed, and if they went, by what the photo shows where they were.

        ``covered``: (H, W) what it costs to show what may have moved there.
        """
        p, view = self.past, self.past.view
        uv, away, inside = view.project(cloud.points)
        slack = 2 * view.pixel_angle * away
        there = inside & (np.abs(view.lookup(view.depth, uv, inside) - away) < slack)
        there &= -((cloud.points - view.centre) * cloud.normals).sum(-1) > _FACING * away
        hidden = view.lookup(np.isfinite(self.alone) | p.covered, uv, inside)
        there &= ~hidden
        gone = view.lookup(np.minimum(np.where(p.was, self.behind, _UNKNOWN), covered), uv, inside)
        return np.where(there, view.lookup(self.before, uv, inside), 0), np.where(there, gone, 0)

    def would_show(self, now: Array, facing: Array) -> tuple[Array, Array, Array]:
        """Pixels (N, 2) of the points where they would be, whether they are in the picture, and whether seen."""
        view = self.past.view
        uv, away, inside = view.project(now)
        slack = 2 * view.pixel_angle * away
        seen = inside & (-((now - view.centre) * facing).sum(-1) > _FACING * away)
        depth = np.minimum(self.alone, self.front)
        return uv, inside, seen & (away < view.lookup(depth, uv, inside) + slack)

    def cost_of(self, now: Array, facing: Array, went: Array) -> Array:
        """(H, W) the least cost of the points that would be seen at each pixel; that of what is unknown elsewhere."""
        out = np.full(self.past.view.shape, np.inf, np.float32)
        uv, _, seen = self.would_show(now, facing)
        ij = uv[seen].astype(np.int64)
        np.minimum.at(out, (ij[:, 1], ij[:, 0]), went[seen])
        return np.minimum(cv2.erode(out, np.ones((3, 3))), _UNKNOWN)

    def where_it_would_be(self, now: Array, facing: Array, colours: Array) -> tuple[Array, Array]:
        view, p = self.past.view, self.past
        uv, inside, seen = self.would_show(now, facing)
        own = pixels.to_lab(colours[None].astype(np.float32))[0]
        apart = np.full(len(now), np.inf)
        for step in itertools.product((-1, 0, 1), repeat=2):
            at = uv + np.array(step)
            ok = inside & (at >= 0).all(-1) & (at < view.shape[::-1]).all(-1)
            far = np.linalg.norm(view.lookup(p.lab, at, ok) - own, axis=-1)
            apart = np.where(ok, np.minimum(apart, far), apart)
        wrong = LIMIT**2 * view.lookup(p.changed.threshold, uv, inside)
        went = np.minimum((apart / wrong) ** 2, 1)
        # what the object itself covers is explained by it, whether or not this point is a part of it
        stayed = view.lookup(np.where(np.isfinite(self.alone), _UNKNOWN, self.behind), uv, inside)
        return np.where(seen, stayed, 0), np.where(seen, went, 0)


def _light(cloud: Cloud, old: Old, now: Array, facing: Array, shown: Sequence[_Shown]) -> Array:
    """(N, 3) how much brighter the light is on the points where they are now, by the directions in which they face.

    Fitted to the object's own points, robustly: light on a surface that turned follows its normal.
    """
    own = old.lattice.holds(old.voxels, cloud.points)
    rows, logs = [], []
    for s in shown:
        view = s.past.view
        uv, inside, seen = s.would_show(now, facing)
        use = own & seen
        photo = to_linear(view.lookup(pixels.blur(view.photo, s.past.sigma), uv, inside)[use])
        ratio = np.log((photo + DARK / 3) / (to_linear(cloud.colours[use]) + DARK / 3))
        rows.append(facing[use])
        logs.append(ratio)
    n, y = np.concatenate(rows), np.concatenate(logs)
    if len(n) < 3 * FEWEST_POINTS:
        return np.ones((len(cloud.points), 3), np.float32)
    a = np.concatenate([np.ones((len(n), 1)), n], -1)
    weight = np.ones(len(n))
    ridge = np.diag([1e-3, 1e-1, 1e-1, 1e-1]) * len(n) * 0.1
    for _ in range(6):
        left = a * weight[:, None]
        fit = np.linalg.solve(left.T @ a + ridge, left.T @ y)
        error = np.abs(y - a @ fit).max(-1)
        scale = max(1.5 * float(np.median(error)), 0.05)
        weight = 1 / (1 + (error / scale) ** 2) ** 2
    gain = np.concatenate([np.ones((len(facing), 1)), facing], -1) @ fit
    return np.exp(np.clip(gain, -np.log(LARGEST), np.log(LARGEST))).astype(np.float32)
