"""Solids in closed form: distance, ray hit, texture coordinates and a mesh.

Everything is in the object's axes, origin at its middle. One texture atlas wraps each solid;
coordinates (u, v) are in [0, 1], v down the image's rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

INSET = 0.02  # an atlas cell is used up to this part of its border, so that filtering stays inside it
_SEGMENTS = 96  # of a mesh's circle; 0.02 cm off at a radius of 40 cm

Mesh = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]
"""vertices (V, 3), uv (V, 2), triangles (F, 3)"""


class Solid(Protocol):
    """A closed shape in its own axes."""

    @property
    def half(self) -> tuple[float, float, float]:
        """Half the sides of its box."""
        ...

    def distance(self, x: Tensor) -> Tensor:
        """Signed distance (..., 3) -> (...,), negative inside."""
        ...

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Distance to the first surface from outside, (N, 3) x 2 -> (N,); inf where missed."""
        ...

    def uv(self, x: Tensor) -> Tensor:
        """Atlas coordinates of the surface near x, (..., 3) -> (..., 2)."""
        ...

    def mesh(self) -> Mesh: ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class Box:
    """Six faces in a 3 x 2 atlas: column = axis, row 0 = the negative side."""

    half: tuple[float, float, float]

    def distance(self, x: Tensor) -> Tensor:
        q = x.abs() - x.new_tensor(self.half)
        return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        half = origins.new_tensor(self.half)
        inverse = 1 / torch.where(directions.abs() < 1e-12, 1e-12, directions)
        a, b = (-half - origins) * inverse, (half - origins) * inverse
        near, far = torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)
        return torch.where((near <= far) & (near > 0), near, torch.inf)

    def uv(self, x: Tensor) -> Tensor:
        unit = x / x.new_tensor(self.half)
        axis = (x.abs() - x.new_tensor(self.half)).argmax(-1)  # the nearest face, also of a flat box
        side = (unit.gather(-1, axis[..., None])[..., 0] > 0).to(x.dtype)
        first = unit.gather(-1, ((axis + 1) % 3)[..., None])[..., 0].clamp(-1, 1)
        second = unit.gather(-1, ((axis + 2) % 3)[..., None])[..., 0].clamp(-1, 1)
        scale = 0.5 * (1 - INSET)
        return torch.stack([(axis + 0.5 + scale * first) / 3, (side + 0.5 - scale * second) / 2], -1)

    def mesh(self) -> Mesh:
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
        vertices: list[NDArray[np.float64]] = []
        faces: list[list[int]] = []
        for axis in range(3):
            for sign in (-1, 1):
                face = np.zeros((4, 3))
                face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = sign, *corners.T
                k = 4 * len(vertices)
                order = [[0, 1, 2], [0, 2, 3]] if sign > 0 else [[0, 2, 1], [0, 3, 2]]
                faces += [[k + i for i in tri] for tri in order]
                vertices.append(face)
        unit = np.concatenate(vertices)
        # the corners' own face decides the atlas cell: look it up a little inside the face
        inward = np.repeat([v.mean(0) for v in vertices], 4, axis=0)
        near = torch.from_numpy(inward + (unit - inward) * (1 - 1e-6)) * torch.tensor(self.half).double()
        return _mesh(unit * np.array(self.half), self.uv(near).numpy(), faces)


@dataclass(frozen=True)
class Sphere:
    """Latitude and longitude fill the atlas."""

    radius: float

    @property
    def half(self) -> tuple[float, float, float]:
        return (self.radius,) * 3

    def distance(self, x: Tensor) -> Tensor:
        return x.norm(dim=-1) - self.radius

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        b = (origins * directions).sum(-1)
        return _first_root(torch.ones_like(b), b, (origins * origins).sum(-1) - self.radius**2)

    def at(self, uv: Tensor) -> Tensor:
        """Inverse of `uv`: (..., 2) -> surface points (..., 3)."""
        polar = torch.pi * uv[..., 1]
        return _around(uv[..., 0], self.radius * polar.sin(), self.radius * polar.cos())

    def uv(self, x: Tensor) -> Tensor:
        polar = torch.atan2(x[..., :2].norm(dim=-1), x[..., 2]) / torch.pi
        return torch.stack([_turn(x), polar], -1)

    def mesh(self) -> Mesh:
        polar = np.linspace(0, np.pi, _SEGMENTS // 2 + 1)
        return _revolved(self.radius * np.sin(polar), self.radius * np.cos(polar), polar / np.pi)


@dataclass(frozen=True)
class Cylinder:
    """Upright. The side fills the atlas' upper half; below it the bottom (left) and the top (right)."""

    radius: float
    height: float

    @property
    def half(self) -> tuple[float, float, float]:
        return (self.radius, self.radius, self.height / 2)

    def distance(self, x: Tensor) -> Tensor:
        q = torch.stack([x[..., :2].norm(dim=-1) - self.radius, x[..., 2].abs() - self.height / 2], -1)
        return q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0)

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        o, d, h = origins[:, :2], directions[:, :2], self.height / 2
        t = _first_root((d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - self.radius**2)
        side = torch.where((origins[:, 2] + t * directions[:, 2]).abs() <= h, t, torch.inf)
        caps = [_disc_hit(origins, directions, z, self.radius) for z in (-h, h)]
        return torch.stack([side, *caps]).amin(0)

    def at(self, uv: Tensor) -> Tensor:
        """Inverse of `uv`: (..., 2) -> surface points (..., 3)."""
        h, down = self.height / 2, _down(uv[..., 1])
        side = _around(uv[..., 0], torch.full_like(down, self.radius), h - 2 * h * down)
        return torch.where((uv[..., 1] < 0.5)[..., None], side, _cap_at(uv, self.radius, h))

    def uv(self, x: Tensor) -> Tensor:
        r, h = x[..., :2].norm(dim=-1), self.height / 2
        down = (0.5 - x[..., 2] / (2 * h)).clamp(0, 1)
        side = torch.stack([_turn(x), 0.5 * (INSET + (1 - 2 * INSET) * down)], -1)
        cap = _cap_uv(x, self.radius, x[..., 2] > 0)
        on_cap = x[..., 2].abs() - h > r - self.radius
        return torch.where(on_cap[..., None], cap, side)

    def mesh(self) -> Mesh:
        h = self.height / 2
        v = 0.5 * np.array([1 - INSET, INSET])
        side = _revolved(np.full(2, self.radius), np.array([-h, h]), v)
        return _joined(side, _disc(self.radius, -h, False), _disc(self.radius, h, True))


@dataclass(frozen=True)
class Cone:
    """Point up. The side fills the atlas' upper half (point at the top); the base is below it, left."""

    radius: float
    height: float

    @property
    def half(self) -> tuple[float, float, float]:
        return (self.radius, self.radius, self.height / 2)

    def _side(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Along the slope from the rim (0) to the point (1), and above it, in the (r, z) half-plane."""
        r, z = x[..., :2].norm(dim=-1), x[..., 2] + self.height / 2
        slope = (self.radius**2 + self.height**2) ** 0.5
        along = ((self.radius - r) * self.radius + z * self.height) / slope**2
        above = ((r - self.radius) * self.height + z * self.radius) / slope
        return along, above

    def distance(self, x: Tensor) -> Tensor:
        along, above = self._side(x)
        r, z = x[..., :2].norm(dim=-1), x[..., 2] + self.height / 2
        inside = torch.maximum(above, -z)
        t = along.clamp(0, 1)
        to_side = torch.hypot(r - self.radius * (1 - t), z - self.height * t)
        to_base = torch.hypot((r - self.radius).clamp_min(0), z)
        return torch.where(inside <= 0, inside, torch.minimum(to_side, to_base))

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        k = self.radius / self.height
        o, d, down = origins[:, :2], directions[:, :2], self.height / 2 - origins[:, 2]
        dz = -directions[:, 2]
        a = (d * d).sum(-1) - k * k * dz * dz
        b = (o * d).sum(-1) - k * k * down * dz
        c = (o * o).sum(-1) - k * k * down * down
        root = (b * b - a * c).clamp_min(0).sqrt()
        a = torch.where(a.abs() < 1e-12, 1e-12, a)
        side = torch.stack([(-b - root) / a, (-b + root) / a])
        z = origins[:, 2] + side * directions[:, 2]
        good = (side > 0) & (z.abs() <= self.height / 2) & (b * b - a * c >= 0)
        base = _disc_hit(origins, directions, -self.height / 2, self.radius)
        return torch.stack([*torch.where(good, side, torch.inf), base]).amin(0)

    def at(self, uv: Tensor) -> Tensor:
        """Inverse of `uv`: (..., 2) -> surface points (..., 3)."""
        h, down = self.height / 2, _down(uv[..., 1])
        side = _around(uv[..., 0], self.radius * down, h - 2 * h * down)
        base = _cap_at(uv, self.radius, h) * uv.new_tensor([1, 1, 0]) - uv.new_tensor([0, 0, h])
        return torch.where((uv[..., 1] < 0.5)[..., None], side, base)

    def uv(self, x: Tensor) -> Tensor:
        along, above = self._side(x)
        v = 0.5 * (INSET + (1 - 2 * INSET) * (1 - along.clamp(0, 1)))
        below = -(x[..., 2] + self.height / 2)
        cap = _cap_uv(x, self.radius, torch.zeros_like(below, dtype=torch.bool))
        return torch.where((below > above)[..., None], cap, torch.stack([_turn(x), v], -1))

    def mesh(self) -> Mesh:
        h, v = self.height / 2, 0.5 * np.linspace(1 - INSET, INSET, 9)
        side = _revolved(np.linspace(self.radius, 0, 9), np.linspace(-h, h, 9), v)
        return _joined(side, _disc(self.radius, -h, False))


def _turn(x: Tensor) -> Tensor:
    """Angle about z as a part of the full turn, [0, 1)."""
    return (torch.atan2(x[..., 1], x[..., 0]) / (2 * torch.pi)) % 1.0


def _around(turn: Tensor, r: Tensor, z: Tensor) -> Tensor:
    a = 2 * torch.pi * turn
    return torch.stack([r * a.cos(), r * a.sin(), z], -1)


def _down(v: Tensor) -> Tensor:
    """How far down a side the atlas row v lies: 0 at the top, 1 at the rim."""
    return ((2 * v - INSET) / (1 - 2 * INSET)).clamp(0, 1)


def _cap_at(uv: Tensor, radius: float, half_height: float) -> Tensor:
    top = uv[..., 0] >= 0.5
    scale = 0.25 * (1 - INSET) / radius
    x = (uv[..., 0] - 0.25 - 0.5 * top) / scale
    y = (0.75 - uv[..., 1]) / scale
    return torch.stack([x, y, torch.where(top, half_height, -half_height)], -1)


def _cap_uv(x: Tensor, radius: float, top: Tensor) -> Tensor:
    scale = 0.25 * (1 - INSET) / radius
    u = 0.25 + 0.5 * top + scale * x[..., 0].clamp(-radius, radius)
    return torch.stack([u, 0.75 - scale * x[..., 1].clamp(-radius, radius)], -1)


def _first_root(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Smaller root of a t² + 2 b t + c, inf where there is none or it lies behind."""
    under = b * b - a * c
    t = (-b - under.clamp_min(0).sqrt()) / a.clamp_min(1e-12)
    return torch.where((under >= 0) & (t > 0), t, torch.inf)


def _disc_hit(origins: Tensor, directions: Tensor, z: float, radius: float) -> Tensor:
    dz = torch.where(directions[:, 2].abs() < 1e-12, 1e-12, directions[:, 2])
    t = (z - origins[:, 2]) / dz
    at = origins[:, :2] + t[:, None] * directions[:, :2]
    return torch.where((t > 0) & (at.norm(dim=-1) <= radius), t, torch.inf)


def _mesh(vertices: NDArray[np.float64], uv: NDArray[np.float64], faces: object) -> Mesh:
    return vertices.astype(np.float32), uv.astype(np.float32), np.asarray(faces, np.uint32)


def _revolved(r: NDArray[np.float64], z: NDArray[np.float64], v: NDArray[np.float64]) -> Mesh:
    """A profile turned about z, with a seam of doubled vertices."""
    turn = np.linspace(0, 1, _SEGMENTS + 1)
    a = 2 * np.pi * turn
    x = np.stack([np.outer(r, np.cos(a)), np.outer(r, np.sin(a)), np.outer(z, np.ones_like(a))], -1)
    uv = np.stack(np.broadcast_arrays(turn[None], v[:, None]), -1)
    i = np.arange((len(r) - 1) * (_SEGMENTS + 1)).reshape(len(r) - 1, -1)[:, :-1].ravel()
    up = i + _SEGMENTS + 1
    faces = np.concatenate([np.stack([i, i + 1, up], -1), np.stack([i + 1, up + 1, up], -1)])
    if z[0] > z[-1]:
        faces = faces[:, ::-1]
    return _mesh(x.reshape(-1, 3), uv.reshape(-1, 2), faces)


def _disc(radius: float, z: float, top: bool) -> Mesh:
    a = np.linspace(0, 2 * np.pi, _SEGMENTS, endpoint=False)
    rim = np.stack([radius * np.cos(a), radius * np.sin(a), np.full_like(a, z)], -1)
    x = np.concatenate([rim, [[0, 0, z]]])
    i = np.arange(_SEGMENTS)
    faces = np.stack([i, (i + 1) % _SEGMENTS, np.full_like(i, _SEGMENTS)], -1)
    uv = _cap_uv(torch.from_numpy(x), radius, torch.full((len(x),), top)).numpy()
    return _mesh(x, uv, faces if top else faces[:, ::-1])


def _joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0] + [len(m[0]) for m in meshes[:-1]])
    faces = np.concatenate([m[2] + k for m, k in zip(meshes, starts)])
    return _mesh(np.concatenate([m[0] for m in meshes]), np.concatenate([m[1] for m in meshes]), faces)
