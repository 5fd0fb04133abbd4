"""A moved object's own part of the old field, rendered at its new place (Eq. 3)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from refield.estimate.look import Seen, reached, shaded
from refield.estimate.objects import Old
from refield.field.radiance import Field
from refield.field.sampling import OccupancySampler
from refield.field.warp import crossing, outline
from refield.scene.capture import Rays
from refield.scene.pose import invert, rotate, transform


def sampler_around(field: Field, old: Old) -> OccupancySampler:
    """The sampler of the field that an object is looked up in, which no longer looks anywhere but around it."""
    sampler = (old.source or field).sampler
    only = torch.zeros_like(sampler.grid)
    cells = sampler.cells_in(outline(old.home[0]))
    only.view(-1)[cells] = sampler.grid.reshape(-1)[cells]
    return replace(sampler, grid=only)


def object_alone(
    field: Field, old: Old, rays: Rays, new_from_old: Tensor, sampler: OccupancySampler | None = None
) -> Seen:
    """Colour (premultiplied), median depth and opacity of a moved object's own samples along rays.

    The samples are where the field's own sampler has them in pictures: a field is only right near the spacing it was
    trained with.
    Its colours are asked along directions that old photos looked along. ``sampler``: of `sampler_around`, if known.
    """
    grid, old_from_home = old.home
    home_from_new = invert(new_from_old @ old_from_home)
    there = Rays(transform(home_from_new, rays.origins), rotate(home_from_new, rays.directions))
    n = len(rays)
    rgb, depth, opacity = torch.zeros(n, 3), torch.full((n,), torch.inf), torch.zeros(n)
    near, far = crossing(there, outline(grid))
    hit = (far > near).nonzero()[:, 0]
    if len(hit) == 0:
        return Seen(rgb, depth, opacity)
    there = there[hit]
    sampler = sampler_around(field, old) if sampler is None else sampler
    end = float(far[hit].max()) / sampler.contraction.radius  # beyond it there is nothing to look for
    asked, along = (field, old.outlook.held) if old.source is None else (old.source, None)

    grids = (grid,) if old.source is None else (grid, old.source.grid)
    with torch.no_grad():
        samples, sigmas = reached(asked, replace(sampler, far=min(end, sampler.far)), there, grids, inside=True)
        seen = shaded(asked, samples.positions(there), sigmas, samples, along)
    rgb[hit], depth[hit], opacity[hit] = seen.rgb, seen.depth, seen.opacity
    return Seen(rgb, depth, opacity)
