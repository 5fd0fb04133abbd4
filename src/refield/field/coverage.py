"""Which cells the cameras can know: right before a few of them anything can be made to look like their photos."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from refield.field.sampling import OccupancySampler
from refield.scene.capture import Frame

_NEAR, _BESIDE = 0.8, 0.5  # core radii
_PART, _LEAST, _ENOUGH = 0.1, 3, 6  # of the cameras; between these numbers of them
_COARSE = 2  # cells of the occupancy grid, along each axis, that are decided together


def knowable(sampler: OccupancySampler, frames: tuple[Frame, ...]) -> Tensor:
    """(R**3,) bool: cells that may hold something.

    A cell near a camera may if enough cameras see it; otherwise it would be painted with whatever these few photos
    show behind it, a floater before any new camera. Farther away, where no camera sees, nothing is decided.
    """
    r = sampler.resolution // _COARSE
    coarse = OccupancySampler(sampler.contraction, torch.zeros(r, r, r, dtype=torch.uint8), sampler.step)
    cells = torch.arange(r**3)
    x = coarse.points_in(cells, jitter=False)
    width = coarse.width(coarse.distance(cells))
    unit = _NEAR * sampler.contraction.radius
    seen, near, ahead = (torch.zeros(len(x), dtype=torch.int32) for _ in range(3))
    for f in frames:
        m = f.world_from_cam.float()
        local = (x - m[:3, 3]) @ m[:3, :3]
        z = local[:, 2].clamp_min(1e-6)
        c = f.camera
        # the lens' distortion moves the frustum's sides by a little; the edge of a photo decides nothing
        u, v = local[:, 0] / z * c.fx + c.cx, local[:, 1] / z * c.fy + c.cy
        seen += (local[:, 2] > 0) & (u > 0) & (v > 0) & (u < c.width) & (v < c.height)
        # a photo that shows any part of a cell can fill it, with its middle outside of the picture
        mu, mv = width / z * c.fx, width / z * c.fy
        part = (u > -mu) & (v > -mv) & (u < c.width + mu) & (v < c.height + mv) & (local[:, 2] > -width)
        close = local.square().sum(-1) < unit**2
        near += part & close
        ahead += (local[:, 2] > 0) & close
    few = min(_LEAST, len(frames))
    enough = max(min(round(_PART * len(frames)), _ENOUGH), few)
    # ahead of cameras, but in none of their pictures: there it is the background of a few opposite ones, and a veil
    # before a new camera that looks a little past its neighbours
    needed = torch.where(near > 0, enough, torch.where(ahead > 0, few, 0))
    allowed = (seen >= needed).reshape(1, 1, r, r, r).float()
    return functional.interpolate(allowed, scale_factor=_COARSE, mode="nearest").reshape(-1) > 0


def beside(sampler: OccupancySampler, frames: tuple[Frame, ...]) -> Tensor:
    """(R**3,) bool: cells right beside a camera, where hardly anything is that it looks at."""
    r = sampler.resolution // _COARSE
    coarse = OccupancySampler(sampler.contraction, torch.zeros(r, r, r, dtype=torch.uint8), sampler.step)
    x = coarse.points_in(torch.arange(r**3), jitter=False)
    eyes = torch.stack([f.centre.float() for f in frames])
    near = torch.cat([torch.cdist(some, eyes).amin(-1) for some in x.split(1 << 16)])
    found = (near < _BESIDE * sampler.contraction.radius).float().reshape(1, 1, r, r, r)
    return functional.interpolate(found, scale_factor=_COARSE, mode="nearest").reshape(-1) > 0
