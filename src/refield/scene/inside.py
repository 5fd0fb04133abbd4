"""Is a point inside, does a ray pass through? Boxes and occupancy grids, asked about millions of points and rays.

On the CPU by compiled loops. Letters: S points, N rays, B boxes. Points that are not numbers are inside of nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from refield.scene.capture import Rays

_Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "error_model": "numpy"}


def in_boxes(x: Tensor, boxes: Tensor) -> Tensor:
    """World points (S, 3), world boxes (B, 2, 3) -> whether any box holds each point, (S,) bool."""
    if x.device.type != "cpu":
        lo, hi = boxes.to(x.device, x.dtype).unbind(1)
        return ((x[:, None] >= lo) & (x[:, None] <= hi)).all(-1).any(-1)
    out = torch.empty(len(x), dtype=torch.bool)
    _in_boxes(x.detach().numpy(), boxes.detach().to(x.dtype).numpy(), out.numpy())
    return out


def in_grid(x: Tensor, aabb: Tensor, values: Tensor, level: float) -> Tensor:
    """World points (S, 3) -> whether the trilinear value there is above ``level``, (S,) bool.

    ``values`` (X, Y, Z) float32 are at the nodes of a lattice from corner to corner of ``aabb`` (2, 3); outside of it
    there is nothing.
    """
    if x.device.type != "cpu":
        return trilinear(x, aabb, values) > level
    out = torch.empty(len(x), dtype=torch.bool)
    _in_grid(x.detach().numpy(), aabb.detach().to(x.dtype).numpy(), values.detach().numpy(), level, out.numpy())
    return out


def meet_grid(rays: Rays, aabb: Tensor, values: Tensor, level: float, tight: Tensor, places: int) -> Tensor:
    """N rays -> whether each passes, at one of ``places`` places along its way through
    the box ``tight`` (2, 3), where the trilinear value is above ``level``, (N,) bool on the CPU. See `in_grid`."""
    out = torch.empty(len(rays), dtype=torch.bool)
    origins, directions, box, nodes, within = (
        t.detach().cpu().numpy() for t in (rays.origins, rays.directions, aabb.double(), values, tight.double())
    )
    _meet_grid(origins, directions, box, nodes, level, within, places, out.numpy())
    return out


def spans(rays: Rays, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """N rays, world boxes (B, 2, 3) -> distances (N,) at which each ray enters the first of them that it meets and
    leaves the last, on the CPU; infinite and 0 where it meets none."""
    enter, leave = torch.empty(len(rays)), torch.empty(len(rays))
    origins, directions, sides = (t.detach().cpu().numpy() for t in (rays.origins, rays.directions, boxes.float()))
    _spans(origins, directions, sides, enter.numpy(), leave.numpy())
    return enter, leave


def trilinear(x: Tensor, aabb: Tensor, values: Tensor) -> Tensor:
    """The value itself at points (..., 3), (...,); 0 outside. Differentiable in ``x``."""
    lo, hi = aabb.to(x.device, x.dtype)
    unit = (x - lo) / (hi - lo) * 2 - 1
    flat = unit.flip(-1).reshape(1, -1, 1, 1, 3)  # grid_sample's first coordinate runs along the last axis
    grid = values.to(x.device, x.dtype)[None, None]
    out = functional.grid_sample(grid, flat, mode="bilinear", padding_mode="border", align_corners=True)
    inside = (unit.abs() <= 1).all(-1)
    return torch.where(inside, out.reshape(x.shape[:-1]), torch.zeros_like(x[..., 0]))


@njit(parallel=True, **_JIT)
def _in_boxes(x: _Array, boxes: _Array, out: _Array) -> None:
    for s in prange(len(x)):
        found = False
        for k in range(len(boxes)):
            inside = True  # without a branch: points come in no order that a processor could guess
            for a in range(3):
                inside &= (x[s, a] >= boxes[k, 0, a]) & (x[s, a] <= boxes[k, 1, a])
            found |= inside
        out[s] = found


@njit(**_JIT)
def cell_along(x: float, low: float, high: float, nodes: int) -> tuple[int, float]:
    """Along one axis: the node below a place, and the part of the way to the next; node -1 outside."""
    at = (x - low) / (high - low) * (nodes - 1)
    if not (at >= 0 and at <= nodes - 1):
        return -1, at
    node = min(int(at), nodes - 2)
    return node, at - node


@njit(**_JIT)
def above(values: _Array, aabb: _Array, level: float, x: float, y: float, z: float) -> bool:
    """Whether the trilinear value at a place is above a level; False outside."""
    i, u = cell_along(x, aabb[0, 0], aabb[1, 0], values.shape[0])
    j, v = cell_along(y, aabb[0, 1], aabb[1, 1], values.shape[1])
    k, w = cell_along(z, aabb[0, 2], aabb[1, 2], values.shape[2])
    if i < 0 or j < 0 or k < 0:
        return False
    near = (values[i, j, k] * (1 - w) + values[i, j, k + 1] * w) * (1 - v)
    near += (values[i, j + 1, k] * (1 - w) + values[i, j + 1, k + 1] * w) * v
    far = (values[i + 1, j, k] * (1 - w) + values[i + 1, j, k + 1] * w) * (1 - v)
    far += (values[i + 1, j + 1, k] * (1 - w) + values[i + 1, j + 1, k + 1] * w) * v
    return bool(near * (1 - u) + far * u > level)


@njit(parallel=True, **_JIT)
def _in_grid(x: _Array, aabb: _Array, values: _Array, level: float, out: _Array) -> None:
    for s in prange(len(x)):
        out[s] = above(values, aabb, level, x[s, 0], x[s, 1], x[s, 2])


@njit(**_JIT)
def _span(origin: _Array, direction: _Array, boxes: _Array) -> tuple[float, float]:
    first, last = np.inf, 0.0
    for k in range(len(boxes)):
        near, far = 0.0, np.inf
        for axis in range(3):
            along = float(direction[axis])
            along = along if abs(along) >= 1e-9 else 1e-9
            a, b = (boxes[k, 0, axis] - origin[axis]) / along, (boxes[k, 1, axis] - origin[axis]) / along
            near, far = max(near, min(a, b)), min(far, max(a, b))
        if far > near:
            first, last = min(first, near), max(last, far)
    return first, last


@njit(parallel=True, **_JIT)
def _spans(origins: _Array, directions: _Array, boxes: _Array, enter: _Array, leave: _Array) -> None:
    for n in prange(len(origins)):
        enter[n], leave[n] = _span(origins[n], directions[n], boxes)


@njit(parallel=True, **_JIT)
def _meet_grid(
    origins: _Array,
    directions: _Array,
    aabb: _Array,
    values: _Array,
    level: float,
    tight: _Array,
    places: int,
    out: _Array,
) -> None:
    for n in prange(len(origins)):
        near, far = 0.0, np.inf
        for axis in range(3):
            along = float(directions[n, axis])
            along = along if abs(along) >= 1e-9 else 1e-9
            first, last = (tight[0, axis] - origins[n, axis]) / along, (tight[1, axis] - origins[n, axis]) / along
            near, far = max(near, min(first, last)), min(far, max(first, last))
        found = False
        if far > near:
            for place in range(places):
                t = near + (far - near) * (place + 0.5) / places
                x, y = origins[n, 0] + directions[n, 0] * t, origins[n, 1] + directions[n, 1] * t
                if above(values, aabb, level, x, y, origins[n, 2] + directions[n, 2] * t):
                    found = True
                    break
        out[n] = found
