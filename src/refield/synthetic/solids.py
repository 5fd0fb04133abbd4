"""More solids: convex ones of any faces, ellipsoids, boxes with rounded edges.

Each fulfils `shapes.Solid`: the object's axes, the origin at the middle of its box, one texture atlas.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.synthetic.shapes import INSET, Box, Mesh, Sphere

Point = tuple[float, float, float]

_STEPS = 3000  # of a traced ray, at most: one that grazes a surface nears it by ever smaller steps
_NEAR = 1e-7  # metres from a surface at which a traced ray has met it
_SAME_PLANE = 1e-7
_ACROSS = 12  # cells a side of a rounded face's mesh


def traced(
    distance: Callable[[Tensor], Tensor], rays: tuple[Tensor, Tensor], near: Tensor, far: Tensor
) -> Tensor:  # fmt: skip
    """Where rays (origins, directions), (N, 3) each, meet a surface between ``near`` and ``far`` (N,): (N,), else inf.

    ``distance`` may be too small, never too large: a step by it never passes a surface.
    """
    origins, directions = rays
    out = torch.full_like(near, torch.inf)
    index = ((near <= far) & (far > 0)).nonzero()[:, 0]
    t = near[index].clamp_min(0)
    for _ in range(_STEPS):
        if len(index) == 0:
            break
        d = distance(origins[index] + t[:, None] * directions[index])
        met = d < _NEAR
        out[index[met]] = t[met]
        t = t + d
        on = ~met & (t <= far[index])
        index, t = index[on], t[on]
    return out


def slabs(origins: Tensor, directions: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a box about the origin, (N,) each; they miss it where the first is the larger."""
    inverse = 1 / torch.where(directions.abs() < 1e-12, 1e-12, directions)
    a, b = (-half - origins) * inverse, (half - origins) * inverse
    return torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)


@dataclass(frozen=True)
class _Face:
    """One flat side of a convex solid."""

    normal: NDArray[np.float64]
    offset: float
    axes: NDArray[np.float64]
    """(2, 3) in the plane; with the normal right-handed"""
    corners: NDArray[np.float64]
    """(K, 3) counter-clockwise from outside"""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 2): least and greatest coordinates along the axes."""
        flat = self.corners @ self.axes.T
        return np.stack([flat.min(0), flat.max(0)])


def _face(normal: NDArray[np.float64], offset: float, corners: NDArray[np.float64]) -> _Face:
    least = np.eye(3)[np.abs(normal).argmin()]
    first = np.cross(least, normal)
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first)])
    flat = (corners - corners.mean(0)) @ axes.T
    return _Face(normal, offset, axes, corners[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))])


def hull_faces(points: NDArray[np.float64], same: float = _SAME_PLANE) -> list[_Face]:
    """The flat sides of the convex hull of (N, 3) points; what is of one plane, to ``same``, is one side."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    corners = points[hull.vertices]
    scale = np.array([1, 1, 1, float(np.ptp(points, axis=0).max())])
    planes, faces = hull.equations, []
    while len(planes):
        plane = planes[0]
        planes = planes[(np.abs(planes - plane) >= same * scale).any(1)]
        on = np.abs(corners @ plane[:3] + plane[3]) < same * scale[3]
        faces.append(_face(plane[:3], -float(plane[3]), corners[on]))
    return faces


@dataclass(frozen=True)
class Convex:
    """The convex hull of some corners; each face has its own cell of the atlas, row by row.

    The distance is exact inside; outside, beside edges and corners, it is too small (the largest of the planes').
    """

    corners: tuple[Point, ...]

    @staticmethod
    def of(points: NDArray[np.float64]) -> Convex:
        """Of (N, 3) points, shifted so that the middle of its box is the origin."""
        middle = (points.min(0) + points.max(0)) / 2
        return Convex(tuple((float(x), float(y), float(z)) for x, y, z in points - middle))

    @cached_property
    def half(self) -> Point:
        x, y, z = np.abs(np.array(self.corners)).max(0).tolist()
        return (x, y, z)

    @cached_property
    def faces(self) -> list[_Face]:
        return hull_faces(np.array(self.corners))

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of the atlas."""
        columns = int(np.ceil(np.sqrt(len(self.faces))))
        return int(np.ceil(len(self.faces) / columns)), columns

    @cached_property
    def _planes(self) -> tuple[Tensor, Tensor]:
        normals = torch.from_numpy(np.stack([f.normal for f in self.faces]))
        return normals, torch.tensor([f.offset for f in self.faces], dtype=torch.float64)

    @cached_property
    def _charts(self) -> tuple[Tensor, Tensor]:
        axes = torch.from_numpy(np.stack([f.axes for f in self.faces]))
        return axes, torch.from_numpy(np.stack([f.bounds for f in self.faces]))

    def _above(self, x: Tensor) -> Tensor:
        normals, offsets = self._planes
        return x @ normals.to(x.dtype).T - offsets.to(x.dtype)

    def distance(self, x: Tensor) -> Tensor:
        return self._above(x).amax(-1)

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        above = self._above(origins)
        towards = directions @ self._planes[0].to(directions.dtype).T
        t = -above / torch.where(towards.abs() < 1e-12, 1e-12, towards)
        near = torch.where(towards < 0, t, -torch.inf).amax(-1)
        far = torch.where(towards > 0, t, torch.inf).amin(-1)
        beside = ((towards.abs() < 1e-12) & (above > 0)).any(-1)
        return torch.where((near <= far) & (near > 0) & ~beside, near, torch.inf)

    def uv(self, x: Tensor) -> Tensor:
        return self._laid(x, self._above(x).argmax(-1))

    def _laid(self, x: Tensor, face: Tensor) -> Tensor:
        axes, bounds = (chart.to(x.dtype)[face] for chart in self._charts)
        flat = (axes @ x[..., None])[..., 0]
        unit = ((flat - bounds[..., 0, :]) / (bounds[..., 1, :] - bounds[..., 0, :])).clamp(0, 1)
        rows, columns = self.cells
        inside = 0.5 + (1 - INSET) * (unit - 0.5)
        u = (face % columns + inside[..., 0]) / columns
        v = (torch.div(face, columns, rounding_mode="floor") + 1 - inside[..., 1]) / rows
        return torch.stack([u, v], -1)

    def mesh(self) -> Mesh:
        vertices, uv, start = [], [], 0
        triangles: list[list[int]] = []
        for i, face in enumerate(self.faces):
            count = len(face.corners)
            vertices.append(face.corners)
            uv.append(self._laid(torch.from_numpy(face.corners), torch.full((count,), i)).numpy())
            triangles += [[start, start + k, start + k + 1] for k in range(1, count - 1)]
            start += count
        return as_mesh(np.concatenate(vertices), np.concatenate(uv), triangles)


@dataclass(frozen=True)
class Ellipsoid:
    """Latitude and longitude fill the atlas. The distance is exact to first order near the surface."""

    half: Point

    def distance(self, x: Tensor) -> Tensor:
        half = x.new_tensor(self.half)
        level = (x / half).norm(dim=-1)
        slope = (x / half**2).norm(dim=-1)
        shortest = min(self.half)
        return torch.where(slope < 1e-9, level.new_tensor(-shortest), level * (level - 1) / slope.clamp_min(1e-9))

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        half = origins.new_tensor(self.half)
        scaled = directions / half
        length = scaled.norm(dim=-1)
        return Sphere(1.0).hit(origins / half, scaled / length[:, None]) / length

    def at(self, uv: Tensor) -> Tensor:
        """Inverse of `uv`: (..., 2) -> surface points (..., 3)."""
        return Sphere(1.0).at(uv) * uv.new_tensor(self.half)

    def uv(self, x: Tensor) -> Tensor:
        return Sphere(1.0).uv(x / x.new_tensor(self.half))

    def mesh(self) -> Mesh:
        vertices, uv, faces = Sphere(1.0).mesh()
        return (vertices * np.array(self.half, np.float32)).astype(np.float32), uv, faces


@dataclass(frozen=True)
class RoundedBox:
    """A box whose edges are rounded with one radius, no larger than its least half side. The atlas is a `Box`'s."""

    half: Point
    radius: float

    def _inner(self, like: Tensor) -> Tensor:
        return like.new_tensor(self.half) - self.radius

    def distance(self, x: Tensor) -> Tensor:
        q = x.abs() - self._inner(x)
        return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0) - self.radius

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        near, far = slabs(origins, directions, origins.new_tensor(self.half))
        t = traced(self.distance, (origins, directions), near, far)
        return torch.where(near > 0, t, torch.inf)

    def uv(self, x: Tensor) -> Tensor:
        return Box(self.half).uv(x)

    def mesh(self) -> Mesh:
        line = np.linspace(-1, 1, _ACROSS + 1)
        first, second = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
        i = np.arange(_ACROSS * (_ACROSS + 1)).reshape(_ACROSS, -1)[:, :-1].ravel()
        quads = np.stack([i, i + _ACROSS + 1, i + _ACROSS + 2, i + 1], -1)
        half, inner = np.array(self.half), np.array(self.half) - self.radius
        vertices: list[NDArray[np.float64]] = []
        uv, faces = [], []
        for axis in range(3):
            for sign in (-1, 1):
                cube = np.empty((len(first), 3))
                cube[:, axis], cube[:, (axis + 1) % 3], cube[:, (axis + 2) % 3] = sign, first, second
                core = np.clip(cube * half, -inner, inner)
                out = cube * half - core
                x = core + self.radius * out / np.linalg.norm(out, axis=-1, keepdims=True)
                # on an edge two faces are as near: look the cell up a little inside of this one
                middle = np.eye(3)[axis] * sign * half
                uv.append(self.uv(torch.from_numpy(middle + (x - middle) * (1 - 1e-6))).numpy())
                order = quads if sign > 0 else quads[:, ::-1]
                faces.append(np.concatenate([order[:, [0, 1, 2]], order[:, [0, 2, 3]]]) + len(x) * len(vertices))
                vertices.append(x)
        return as_mesh(np.concatenate(vertices), np.concatenate(uv), np.concatenate(faces))


def as_mesh(vertices: NDArray[np.float64], uv: NDArray[np.float64], faces: object) -> Mesh:
    """In the types of a `Mesh`."""
    return vertices.astype(np.float32), uv.astype(np.float32), np.asarray(faces, np.uint32)


def prism(outline: Sequence[tuple[float, float]], height: float, top: float = 1.0) -> Convex:
    """Upright, on a convex outline in (x, y); towards its top it shrinks to ``top`` times the outline."""
    flat = np.array(outline, float)
    lower = np.column_stack([flat, np.full(len(flat), -height / 2)])
    middle = (flat.min(0) + flat.max(0)) / 2
    upper = np.column_stack([middle + top * (flat - middle), np.full(len(flat), height / 2)])
    return Convex.of(np.unique(np.concatenate([lower, upper]).round(12), axis=0))
