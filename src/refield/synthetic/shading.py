"""Light on inserted solids and the shadow that they cast: a soft sun, a sky, and what the ground returns.

All in linear light. A level surface in the open receives 1; how much that is, is the light's ``radiance``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refield.scene.capture import Rays
from refield.scene.pose import invert, rotate, transform
from refield.scene.srgb import to_linear
from refield.synthetic.oracles import looked_up
from refield.synthetic.state import Item, State
from refield.synthetic.visibility import first_hits

_GROUND = 0.3  # of the light on a level surface comes back from it: a usual albedo
_SUN_RAYS, _SKY_RAYS = 12, 16
_AT_ONCE = 1 << 14  # points that rays are cast from together
_VARNISH = 0.04  # of the light is mirrored at a varnished surface seen head-on
_GOLDEN = np.pi * (3 - 5**0.5)


@dataclass(frozen=True)
class Light:
    """What falls on the solids."""

    up: Tensor
    """(3,) float64, unit"""
    sun: Tensor
    """(3,) float64, unit, towards it"""
    share: float
    """of the sun in what a level surface receives; the sky gives the rest"""
    spread: float
    """radians, half the angle under which the sun is seen"""
    radiance: Tensor
    """(3,) float32, linear: how bright a white level surface in the open is"""


def shaded(state: State, index: int, points: Tensor, directions: Tensor, light: Light) -> Tensor:
    """Linear colour (N, 3) of points (N, 3) on the surface of an item, seen along ``directions`` (N, 3)."""
    item = state.items[index]
    normals, size = _normals(item, points), 2 * max(item.solid.half)
    albedo = torch.from_numpy(to_linear(_painted(item, points).numpy())).double()
    start = points + 1e-3 * size * normals
    facing = (normals @ light.sun).clamp_min(0)
    sun = torch.zeros_like(facing)  # what looks away from it lies in its own shade
    sun[facing > 0] = _open(state, start[facing > 0], _cone(light.sun, light.spread, _SUN_RAYS))
    direct = light.share * facing / float(light.up @ light.sun) * sun
    tilt = normals @ light.up
    above = _height(state, points, light.up) / (0.5 * size)
    # near the ground the sky is half hidden by it, and the ground lies in the solid's own shade
    near = 1 - 0.5 * torch.exp(-3 * above) * (1 - tilt.clamp(0, 1))
    sky = (1 - light.share) * near * (0.5 * (1 + tilt)) + _GROUND * near * 0.5 * (1 - tilt)
    mirrored = directions - 2 * (directions * normals).sum(-1, keepdim=True) * normals
    if item.metal:
        colour = albedo * _around(mirrored, light, sun, item.roughness)[:, None]
    else:
        colour = albedo * (direct + sky)[:, None]
        if item.glossy:
            colour = colour + _VARNISH * _around(mirrored, light, sun, item.roughness)[:, None]
    return colour * light.radiance.double()


class CastShadow:
    """How much light still reaches a surface near the solids, as of a level one.

    Where a plane holds the solids up, the shadow on it is computed once, on a lattice.
    """

    def __init__(self, state: State, light: Light, plane: tuple[Tensor, float, float] | None = None) -> None:
        """``plane``: unit normal (3,), offset, and up to which distance from it a point counts as on it."""
        self._state, self._light, self._plane = state, light, plane
        if state.items:
            boxes = torch.stack([item.box() for item in state.items])
            self._reach = 3 * float((boxes[:, 1] - boxes[:, 0]).norm(dim=-1).max())
            self._box = torch.stack([boxes[:, 0].amin(0), boxes[:, 1].amax(0)])
            self._lattice = None if plane is None else _Lattice(self, plane[0], plane[1])

    def __call__(self, points: Tensor) -> Tensor:
        """World points (N, 3) -> (N,) in [0, 1]."""
        out = torch.ones(len(points), dtype=torch.float64)
        if not self._state.items:
            return out
        x = points.double()
        off = torch.maximum(self._box[0] - x, x - self._box[1]).clamp_min(0).norm(dim=-1)
        near = off < self._reach
        if self._plane is not None and self._lattice is not None:
            height = x @ self._plane[0] - self._plane[1]
            on = near & (height.abs() <= self._plane[2])
            out[on] = self._lattice(x[on])
            near &= ~on
        out[near] = self.direct(x[near])
        return out

    def direct(self, points: Tensor) -> Tensor:
        """The same, (N,), by rays from each point."""
        light, size = self._light, self._reach / 6
        start = points + 2e-3 * size * light.up
        sun = _open(self._state, start, _cone(light.sun, light.spread, _SUN_RAYS))
        sky = _open(self._state, start, _hemisphere(light.up, _SKY_RAYS))
        covered = torch.stack([item.distance(start) for item in self._state.items]).amin(0) < 0
        returned = 0.5 * _GROUND * (1 - sky)  # by the solid's lit sides
        return torch.where(covered, _GROUND, light.share * sun + (1 - light.share) * (sky + returned))


class _Lattice:
    """Bilinear look-up of a shadow on a plane."""

    _NODES = 256

    def __init__(self, shadow: CastShadow, normal: Tensor, offset: float) -> None:
        across = torch.linalg.svd(normal[None].double())[2][1:]  # two directions in the plane
        box, reach = shadow._box, shadow._reach / 2  # farther off it is faint
        corners = torch.cartesian_prod(*box.T) @ across.T
        self._across, self._lo = across, corners.amin(0) - reach
        self._cell = (corners.amax(0) + reach - self._lo) / (self._NODES - 1)
        i = torch.arange(self._NODES, dtype=torch.float64)
        uv = torch.stack(torch.meshgrid(i, i, indexing="ij"), -1).reshape(-1, 2) * self._cell + self._lo
        points = uv @ across + offset * normal.double()
        self._values = shadow.direct(points).reshape(1, 1, self._NODES, self._NODES)
        edge = torch.cat([self._values[..., 0, :], self._values[..., -1, :]], -1)
        self._values = (self._values / edge.median()).clamp(max=1)  # to 1 where it ends

    def __call__(self, points: Tensor) -> Tensor:
        at = (points @ self._across.T - self._lo) / self._cell / (self._NODES - 1) * 2 - 1
        inside = (at.abs() <= 1).all(-1)
        grid = at.flip(-1)[None, None]
        found = torch.nn.functional.grid_sample(self._values, grid, align_corners=True)[0, 0, 0]
        return torch.where(inside, found, 1.0)


def _painted(item: Item, points: Tensor) -> Tensor:
    """Texture (N, 3) sRGB at surface points (N, 3)."""
    texture = torch.from_numpy(item.texture).permute(2, 0, 1)[None]
    return looked_up(texture, item.solid.uv(transform(invert(item.world_from_item), points)).float())


def _normals(item: Item, points: Tensor) -> Tensor:
    """Outward unit normals (N, 3) at surface points (N, 3): the distance's gradient."""
    item_from_world = invert(item.world_from_item)
    x = transform(item_from_world, points)
    step = 1e-4 * max(item.solid.half)
    ahead = [item.solid.distance(x + step * e) - item.solid.distance(x - step * e) for e in torch.eye(3).double()]
    gradient = torch.stack(ahead, -1)
    gradient = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return rotate(item.world_from_item, gradient)


def _height(state: State, points: Tensor, up: Tensor) -> Tensor:
    """(N,) how far above the lowest point of the solids."""
    lowest = min(float((torch.cartesian_prod(*item.box().T) @ up).min()) for item in state.items)
    return (points @ up - lowest).clamp_min(0)


def _open(state: State, points: Tensor, directions: Tensor) -> Tensor:
    """(N,) the part of the directions (K, 3) in which no solid is met from each of the points (N, 3)."""
    boxes = torch.stack([item.box() for item in state.items])
    middles, radii = boxes.mean(1), (boxes[:, 1] - boxes[:, 0]).norm(dim=-1) / 2
    blocked = torch.zeros(len(points), dtype=torch.float64)
    for rows in torch.arange(len(points)).split(_AT_ONCE):
        offset = middles - points[rows, None]  # (N, I, 3)
        square = (offset.square().sum(-1) - radii**2)[..., None]
        along = offset @ directions.T  # (N, I, K)
        # most rays pass by the solids' spheres, and need not be cast
        near = ((square <= 0) | ((along > 0) & (along**2 >= square))).any(1)
        n, k = near.nonzero().T
        hit = first_hits(state, Rays(points[rows[n]], directions[k])).item >= 0
        blocked.index_add_(0, rows[n], hit.double())
    return 1 - blocked / len(directions)


def _around(directions: Tensor, light: Light, sun: Tensor, roughness: float) -> Tensor:
    """(N,) what comes from ``directions`` (N, 3), spread by a rough mirror; 1 is a white level surface's light."""
    up = directions @ light.up
    sky = (1 - light.share) * (0.5 + 0.5 * (up / (0.2 + roughness)).clamp(-1, 1)) + _GROUND * 0.5 * (1 - up)
    wide = light.spread**2 + roughness**2
    lobe = torch.exp((directions @ light.sun - 1) / wide) / (2 * wide) / float(light.up @ light.sun)
    return sky + light.share * lobe * sun


def _cone(axis: Tensor, half_angle: float, count: int) -> Tensor:
    """Directions (K, 3) spread evenly over a cone."""
    k = torch.arange(count, dtype=torch.float64)
    radius = np.tan(half_angle) * ((k + 0.5) / count).sqrt()
    return _about(axis, radius * torch.cos(k * _GOLDEN), radius * torch.sin(k * _GOLDEN), torch.ones_like(k))


def _hemisphere(axis: Tensor, count: int) -> Tensor:
    """Directions (K, 3) over a hemisphere, as many as a level surface takes light from."""
    k = torch.arange(count, dtype=torch.float64)
    square = (k + 0.5) / count
    radius = square.sqrt()
    return _about(axis, radius * torch.cos(k * _GOLDEN), radius * torch.sin(k * _GOLDEN), (1 - square).sqrt())


def _about(axis: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    across = torch.linalg.svd(axis[None].double())[2][1:]
    d = x[:, None] * across[0] + y[:, None] * across[1] + z[:, None] * axis.double()
    return d / d.norm(dim=-1, keepdim=True)
