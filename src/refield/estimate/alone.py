"""A moved object's own part of the old field, rendered at its new place (Eq. 3)."""

from __future__ import annotations

import torch
from torch import Tensor

from refield.estimate.look import Seen, shaded
from refield.estimate.objects import Old
from refield.field.radiance import Field
from refield.field.volrend import Samples
from refield.field.warp import crossing
from refield.scene.capture import Rays
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
    near, far = crossing(there, old.grid.tight_aabb())
    hit = (far > near).nonzero()[:, 0]
    if len(hit) == 0:
        return Seen(rgb, depth, opacity)
    there = there[hit]
    samples = field.sampler(there)
    ids = samples.ray_ids
    middle = (samples.t_starts + samples.t_ends) / 2
    keep = ((middle > near[hit][ids]) & (middle < far[hit][ids])).nonzero()[:, 0]
    x = there.origins[ids[keep]] + there.directions[ids[keep]] * middle[keep, None]
    inside = old.grid.contains(x)
    keep, x = keep[inside], x[inside]
    counts = torch.bincount(ids[keep], minlength=len(hit))
    offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    own = Samples(samples.t_starts[keep], samples.t_ends[keep], offsets)
    with torch.no_grad():
        along = old.outlook.held(x, there.directions[ids[keep]])
        seen = shaded(field, (x, along), field.density(x), own)
    rgb[hit], depth[hit], opacity[hit] = seen.rgb, seen.depth, seen.opacity
    return Seen(rgb, depth, opacity)
