"""A moved object's own part of the old field, rendered at its new place (Eq. 3)."""

from __future__ import annotations

import torch
from torch import Tensor

from refield.estimate.look import Seen, shaded
from refield.estimate.objects import Old
from refield.field.radiance import Field
from refield.field.volrend import Samples
from refield.scene.capture import Rays
from refield.scene.change import OccupancyGrid
from refield.scene.pose import invert, rotate, transform


def object_alone(field: Field, old: Old, rays: Rays, new_from_old: Tensor) -> Seen:
    """Colour (premultiplied), median depth and opacity of a moved object's own samples along rays.

    The samples are where the field's own sampler has them: a field is only right at the spacing it was trained with.
    Its colours are asked along directions that old photos looked along.
    """
    old_from_new = invert(new_from_old)
    there = Rays(transform(old_from_new, rays.origins), rotate(old_from_new, rays.directions))
    n = len(rays)
    rgb, depth, opacity = torch.zeros(n, 3), torch.full((n,), torch.inf), torch.zeros(n)
    grid = old.grid()
    near, far = crossing(grid, there)
    hit = (far > near).nonzero()[:, 0]
    if len(hit) == 0:
        return Seen(rgb, depth, opacity)
    there = there[hit]
    samples = field.sampler(there)
    ids = samples.ray_ids
    middle = (samples.t_starts + samples.t_ends) / 2
    keep = ((middle > near[hit][ids]) & (middle < far[hit][ids])).nonzero()[:, 0]
    x = there.origins[ids[keep]] + there.directions[ids[keep]] * middle[keep, None]
    inside = grid.contains(x)
    keep, x = keep[inside], x[inside]
    counts = torch.bincount(ids[keep], minlength=len(hit))
    offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    own = Samples(samples.t_starts[keep], samples.t_ends[keep], offsets)
    with torch.no_grad():
        along = old.outlook.held(x, there.directions[ids[keep]])
        seen = shaded(field, (x, along), field.density(x), own)
    rgb[hit], depth[hit], opacity[hit] = seen.rgb, seen.depth, seen.opacity
    return Seen(rgb, depth, opacity)


def crossing(grid: OccupancyGrid, rays: Rays) -> tuple[Tensor, Tensor]:
    """Distances (N,) at which rays enter and leave a grid's tight box; a ray misses if it does not enter first."""
    lo, hi = grid.tight_aabb()
    d = rays.directions
    inverse = 1 / torch.where(d.abs() < 1e-9, torch.full_like(d, 1e-9), d)
    a, b = (lo - rays.origins) * inverse, (hi - rays.origins) * inverse
    return torch.minimum(a, b).amax(-1).clamp_min(0), torch.maximum(a, b).amin(-1)
