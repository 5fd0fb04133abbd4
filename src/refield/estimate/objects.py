"""An object as it was: its voxels, its coloured surface, and the parts of the old views that show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from refield.estimate.lattice import Lattice, Voxels, grown
from refield.estimate.look import Array, see
from refield.field.outlook import Outlook
from refield.field.radiance import Field
from refield.field.source import Source
from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays, camera_rays
from refield.scene.change import OccupancyGrid

_CARVED_AWAY = 0.6  # voxels


@dataclass(frozen=True)
class Patch:
    """A rectangle of one old view, and what the field shows in it."""

    frame: Frame
    camera: Camera
    """the frame's, scaled"""
    box: tuple[int, int, int, int]
    """x0, y0, x1, y1 in pixels of ``camera``"""
    rgb: Array
    """(h, w, 3)"""
    depth: Array
    """(h, w)"""

    @property
    def centre(self) -> Array:
        return self.frame.world_from_cam[:3, 3].numpy().astype(np.float32)

    @cached_property
    def rays(self) -> Rays:
        return patch_rays(self.camera, self.frame, self.box)

    @cached_property
    def points(self) -> Array:
        """World points (h, w, 3) on the surface."""
        d = self.rays.directions.numpy().reshape(*self.depth.shape, 3)
        with np.errstate(invalid="ignore"):
            return (self.centre + d * self.depth[..., None]).astype(np.float32)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points (N, 3) -> pixels (N, 2) of ``camera`` and depths along its axis (N,)."""
        m = self.frame.world_from_cam
        return self.camera.project((points - m[:3, 3].float()) @ m[:3, :3].float())

    def pixel_of(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points (N, 3) -> index into the patch's pixels, row by row, (N,), and whether they fall in it."""
        uv, z = self.project(points)
        j, i = uv[:, 0].floor().long() - self.box[0], uv[:, 1].floor().long() - self.box[1]
        h, w = self.depth.shape
        inside = (z > 0) & (i >= 0) & (i < h) & (j >= 0) & (j < w)
        return torch.where(inside, i * w + j, torch.zeros_like(i)), inside

    def behind_surface(self, points: Tensor) -> Tensor:
        """How far behind what the patch shows each world point (N, 3) lies, (N,); inf outside the patch."""
        where, inside = self.pixel_of(points)
        front = torch.from_numpy(self.depth).reshape(-1)[where]
        distance = (points - torch.from_numpy(self.centre)).norm(dim=-1)
        return torch.where(inside, distance - front, torch.inf)


@dataclass(frozen=True)
class Cloud:
    """Coloured surface points of an object at its old place."""

    points: Array
    """(N, 3) world"""
    normals: Array
    """(N, 3) unit, outwards"""
    colours: Array
    """(N, 3) in [0, 1], the field's"""


@dataclass(frozen=True)
class Old:
    """An object as it was."""

    lattice: Lattice
    voxels: Voxels
    free: Voxels
    """voxels in front of what holds things up"""
    cloud: Cloud
    patches: tuple[Patch, ...]
    margin: int = 2
    """voxels between its surface (the field's median depth) and where the field's soft surface ends"""
    remembered: bool = False
    """its shape is that of an earlier visit; ``patches`` are of some old views only"""
    source: Source | None = None
    """where it is looked up, if not where it was"""
    instead: Old | None = None
    """what it may be with its surroundings, where it cannot be told from them; what fits the new photos says which"""

    @property
    def outlines(self) -> tuple[Old, ...]:
        """What it may be: itself, and with its surroundings."""
        return (self,) if self.instead is None else (self, self.instead)

    @cached_property
    def centre(self) -> Array:
        return self.lattice.centres[self.voxels].mean(0)

    @cached_property
    def radius(self) -> float:
        """rms distance of its voxels from the centre, scaled to a ball's radius."""
        p = self.lattice.centres[self.voxels]
        return float(np.sqrt(((p - p.mean(0)) ** 2).sum(-1).mean() * 5 / 3))

    @cached_property
    def thickest(self) -> tuple[Array, float]:
        """The point (3,) world of it that is furthest inside, the middlemost of those that are; and how far."""
        inner = ndimage.distance_transform_edt(self.voxels)
        at = self.lattice.centres[inner > inner.max() - 1]
        middle = at[np.linalg.norm(at - self.centre, axis=-1).argmin()]
        return middle, float(inner.max()) * self.lattice.cell

    @cached_property
    def outlook(self) -> Outlook:
        """The directions along which old photos looked at it."""
        eyes = torch.from_numpy(np.stack([p.centre for p in self.patches]))
        return Outlook.from_eyes(eyes, self.grid)

    @cached_property
    def _sides(self) -> NDArray[np.int64]:
        """The side of the object near each voxel; -1 where no old photo saw its surface."""
        out = np.full(self.lattice.shape, -1)
        ijk, inside = self.lattice.index(self.cloud.points)
        out[tuple(ijk[inside].T)] = sides_of(self.cloud.normals)[inside]
        apart = float(np.median(cKDTree(self.cloud.points).query(self.cloud.points, 2)[0][:, 1]))
        distance, nearest = ndimage.distance_transform_edt(out < 0, return_indices=True)
        reach = 2 * apart / self.lattice.cell + self.margin
        return np.where(distance <= reach, out[tuple(nearest)], -1)

    def side_of(self, points: Array) -> NDArray[np.int64]:
        """Which of its six sides surface points (N, 3) are on, at its old place; -1 where no old photo saw it."""
        ijk, inside = self.lattice.index(points)
        return np.where(inside, self._sides[tuple(ijk.T)], -1)

    @property
    def volume(self) -> float:
        return float(self.voxels.sum()) * self.lattice.cell**3

    def within(self, other: Old) -> bool:
        """Whether it is rather a piece of another outline."""
        return other.has_most(self.lattice.centres[self.voxels])

    def has_most(self, points: Array) -> bool:
        """Whether most world points (N, 3) are in its outline, or beside it."""
        return bool(self.lattice.holds(grown(self.voxels, 1), points).mean() > 0.5)

    @cached_property
    def grid(self) -> OccupancyGrid:
        """Its mask M: with the whole of the field's soft surface, which is as thick as its samples are apart, and a
        little smoothed, so that the trilinear half level is not a staircase."""
        values = ndimage.gaussian_filter((grown(self.voxels, self.margin) & self.free).astype(np.float32), 0.7)
        return self.lattice.grid(values)

    @cached_property
    def home(self) -> tuple[OccupancyGrid, Tensor]:
        """Its mask where it is looked up, and the motion (4, 4) from there to where it was."""
        if self.source is None:
            return self.grid, torch.eye(4, dtype=torch.float64)
        return self.grid.moved(self.source.then_from_now), self.source.now_from_then

    @cached_property
    def shape(self) -> OccupancyGrid:
        """The object without the softness that the field gives to its surface.

        Views that look along a surface see past what the field has there, so carving leaves it a little too small.
        """
        outside, inside = (ndimage.distance_transform_edt(v) for v in (~self.voxels, self.voxels))
        depth = np.where(self.voxels, inside - 0.5, 0.5 - outside).astype(np.float32)
        depth = ndimage.gaussian_filter(depth, 0.7) + (0 if self.remembered else _CARVED_AWAY)
        return self.lattice.grid(np.clip(0.5 + depth / 2, 0, 1))

    @cached_property
    def haze(self) -> OccupancyGrid:
        """The object and the haze around it, for looking past it."""
        return self.lattice.grid((grown(self.voxels, self.margin + 1) & self.free).astype(np.float32))


def patch_rays(camera: Camera, frame: Frame, box: tuple[int, int, int, int]) -> Rays:
    """Rays through the pixels of a rectangle, row by row."""
    x0, y0, x1, y1 = box
    v, u = torch.meshgrid(torch.arange(y0, y1) + 0.5, torch.arange(x0, x1) + 0.5, indexing="ij")
    return camera_rays(camera, frame.world_from_cam, torch.stack([u, v], -1).reshape(-1, 2).double())


def box_in(camera: Camera, frame: Frame, corners: Array, margin: int = 1) -> tuple[int, int, int, int] | None:
    """The rectangle of an image that world points (N, 3) project to; None if it misses the image."""
    m = frame.world_from_cam
    local = (torch.from_numpy(corners).double() - m[:3, 3]) @ m[:3, :3]
    ahead = local[:, 2] > 0
    if not ahead.all():  # around the camera, or beside it: any pixel may show a part
        return (0, 0, camera.width, camera.height) if ahead.any() else None
    uv = camera.project(local)[0].numpy()
    x0, y0 = np.floor(uv.min(0)).astype(int) - margin
    x1, y1 = np.ceil(uv.max(0)).astype(int) + margin
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, camera.width), min(y1, camera.height)
    return (int(x0), int(y0), int(x1), int(y1)) if x1 - x0 >= 3 and y1 - y0 >= 3 else None


def corners_of(low: Array, high: Array) -> Array:
    """The eight corners of a box, (8, 3)."""
    return np.array([[(low, high)[b >> a & 1][a] for a in range(3)] for b in range(8)], np.float32)


def look_around(field: Field, frames: Sequence[Frame], corners: Array, rays: int) -> list[Patch]:
    """The part of every old view that shows a box, scaled down evenly if it takes more than ``rays`` rays."""
    boxes = [(f, box_in(f.camera, f, corners)) for f in frames]
    total = sum((b[2] - b[0]) * (b[3] - b[1]) for _, b in boxes if b)
    shrink = min(1.0, (rays / max(total, 1)) ** 0.5)
    todo = []
    for frame, _ in boxes:
        c = frame.camera
        camera = c if shrink == 1 else c.scaled(max(8, round(c.width * shrink)), max(8, round(c.height * shrink)))
        box = box_in(camera, frame, corners)
        if box is not None:
            todo.append((frame, camera, box, patch_rays(camera, frame, box)))
    if not todo:
        return []
    joined = Rays(torch.cat([t[3].origins for t in todo]), torch.cat([t[3].directions for t in todo]))
    seen = see(field, joined)
    out, at = [], 0
    for frame, camera, box, r in todo:
        shape = (box[3] - box[1], box[2] - box[0])
        rgb = seen.rgb[at : at + len(r)].reshape(*shape, 3).numpy()
        out.append(Patch(frame, camera, box, rgb, seen.depth[at : at + len(r)].reshape(shape).numpy()))
        at += len(r)
    return out


def surface_cloud(lattice: Lattice, voxels: Voxels, patches: Sequence[Patch], count: int) -> Cloud:
    """What the patches see of the voxels' surface, thinned evenly to about ``count`` points."""
    near = grown(voxels, 1)
    smooth = ndimage.gaussian_filter(voxels.astype(np.float32), 1.5)
    slope = np.stack(np.gradient(smooth), -1)
    points, colours, facing = [], [], []
    for p in patches:
        xyz = p.points.reshape(-1, 3)
        on = lattice.holds(near, xyz) & np.isfinite(xyz).all(-1)
        ijk, _ = lattice.index(xyz[on])
        n = -slope[ijk[:, 0], ijk[:, 1], ijk[:, 2]]
        n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-9)
        look = xyz[on] - p.centre
        cosine = -(n * look).sum(-1) / np.linalg.norm(look, axis=-1)
        good = cosine > 0.25  # what is seen at a grazing angle has its neighbour's colour
        points.append(np.concatenate([xyz[on], n], -1)[good])
        colours.append(p.rgb.reshape(-1, 3)[on][good])
        facing.append(cosine[good])
    if not points or sum(len(p) for p in points) == 0:
        empty = np.zeros((0, 3), np.float32)
        return Cloud(empty, empty, empty)
    return _thinned(np.concatenate(points), np.concatenate(colours), np.concatenate(facing), count)


def _thinned(points: Array, colours: Array, facing: Array, count: int) -> Cloud:
    """The most frontal point of each cell of a lattice fine enough for ``count`` of them."""
    order = np.argsort(-facing)
    points, colours = points[order], colours[order]
    xyz = points[:, :3]
    extent = float((xyz.max(0) - xyz.min(0)).max()) + 1e-9
    keep = np.arange(len(xyz))
    for n in (128, 96, 72, 56, 44, 34, 26, 20):
        cells = np.floor((xyz - xyz.min(0)) / extent * n).astype(np.int64)
        _, keep = np.unique(cells @ np.array([1, 1 << 16, 1 << 32]), return_index=True)
        if len(keep) <= count:
            break
    return Cloud(*(np.ascontiguousarray(a[keep], np.float32) for a in (xyz, points[:, 3:], colours)))


def sides_of(normals: Array) -> NDArray[np.int64]:
    """Which of six sides each normal (N, 3) belongs to, (N,): axes as the object's own normals have them."""
    centred = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    axes = np.linalg.svd(centred, full_matrices=False)[2] if len(normals) >= 3 else np.eye(3)
    for _ in range(10):  # turn the axes onto the faces of whatever is boxy
        along = centred @ axes.T
        best = np.abs(along).argmax(-1)
        signs = np.sign(along[np.arange(len(best)), best])
        pull = np.zeros((3, 3))
        np.add.at(pull, best, centred * signs[:, None])
        u, _, vt = np.linalg.svd(pull + 1e-6 * axes)
        axes = u @ vt
    along = centred @ axes.T
    best = np.abs(along).argmax(-1)
    return (2 * best + (along[np.arange(len(best)), best] > 0)).astype(np.int64)
