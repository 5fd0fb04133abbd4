"""The object's masks on every old photo (§4.2.4, §10.2.4), with occlusion.

The projection check of the paper is done in `objects`; here the finished grid is looked at from every old view.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from refield.estimate.look import median_depth
from refield.estimate.objects import box_in, corners_of, patch_rays
from refield.field.radiance import Field
from refield.field.volrend import weights
from refield.scene.capture import Frame
from refield.scene.change import OccupancyGrid
from refield.vision import pixels


def masks_of(field: Field, frames: Sequence[Frame], grid: OccupancyGrid, inside: bool) -> tuple[Tensor | None, ...]:
    """Per old frame, (H, W) bool: where the grid is seen.

    Args:
        inside: the grid holds what the old field shows (an object's old place); else it is a place in front of, or
            behind, what the field shows (its new place).
    """
    return tuple(_mask(field, f, grid, inside) for f in frames)


def _mask(field: Field, frame: Frame, grid: OccupancyGrid, inside: bool) -> Tensor:
    camera = frame.camera
    out = np.zeros((camera.height, camera.width), bool)
    low, high = grid.tight_aabb().numpy()
    box = box_in(camera, frame, corners_of(low, high))
    if box is None:
        return torch.from_numpy(out)
    rays = patch_rays(camera, frame, box)
    enter, leave = _crossing(grid, rays.origins, rays.directions)
    hit = torch.isfinite(enter)
    x0, y0, x1, y1 = box
    shape = (y1 - y0, x1 - x0)
    index = hit.nonzero()[:, 0]
    if len(index) == 0:
        return torch.from_numpy(out)
    sub = rays[index]
    with torch.no_grad():
        samples = field.sampler(sub)
        x, _ = samples.positions(sub)
        sigmas = field.density(x)
        if inside:
            w = weights(sigmas, samples) * grid.contains(x)
            shown = torch.zeros(len(sub)).index_add_(0, samples.ray_ids, w) > 0.35
        else:
            cell = float(((grid.aabb[1] - grid.aabb[0]) / (torch.tensor(grid.values.shape) - 1)).max())
            shown = median_depth(sigmas, samples) > enter[index] - 2 * cell
    part = np.zeros(shape[0] * shape[1], bool)
    part[index.numpy()] = shown.numpy()
    out[y0:y1, x0:x1] = part.reshape(shape)
    return torch.from_numpy(pixels.fill_holes(pixels.close(out, 5), 0.02 * out.size))


def _crossing(grid: OccupancyGrid, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays first meet the grid's inside, and where they leave its box; inf where they miss."""
    lo, hi = grid.tight_aabb()
    inverse = 1 / torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (lo - origins) * inverse, (hi - origins) * inverse
    near, far = torch.minimum(a, b).amax(-1).clamp_min(0), torch.maximum(a, b).amin(-1)
    enter = torch.full_like(near, torch.inf)
    hit = (far > near).nonzero()[:, 0]
    steps = 64
    t = near[hit, None] + (far - near)[hit, None] * (torch.arange(steps) + 0.5) / steps
    inside = grid.contains(origins[hit, None] + directions[hit, None] * t[..., None])
    first = inside.float().argmax(1)
    found = inside.any(1)
    enter[hit] = torch.where(found, t.gather(1, first[:, None])[:, 0], torch.full_like(near[hit], torch.inf))
    return enter, far
