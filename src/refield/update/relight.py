"""The second stage: how the light on what is known changed, from the new photos' pixels that show it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from refield.field.render import render_many
from refield.field.volrend import OPAQUE
from refield.field.warp import crosses, outline
from refield.scene.pose import transform
from refield.update.cut import Known
from refield.update.light import Relighting, Sightings, fit_light
from refield.update.region import Region, meets
from refield.update.supervision import at_most_of

_RAYS = 60_000  # of the new photos, for the light on all and on each object; a lattice of factors is no finer
_AROUND = 1.5  # sides of the largest object, so far around all places light is looked for
_SPACING = 1.5  # pixels of the nearest new photo, the lattice's spacing
_PATCH = 4.0  # cells of the lattice that are left out together where one photo alone shows a place
_PATCHES, _CELLS = 8, 24  # a moved object's side in patches that are left out together; in cells at most
_PIXELS = 2.0  # so wide is such a cell at least
_MARGIN = 3.0  # cells; a fit fades out at the border of its box


@dataclass(frozen=True)
class RelightConfig:
    """How light that changed is set right; the paper leaves it aside."""

    still: bool = True
    """of what stood still: shadows that left, came or went along"""
    moved: bool = True
    """of each moved object"""


def light_of(known: Known, draw: torch.Generator) -> Relighting | None:
    """The light on what stood still; each photo is a fold."""
    change, sparse = known.change, known.sparse.taught
    box = Region(tuple(g for o in change.objects for g in (o.grid, o.grid_now) if g is not None)).box
    side = max(float((o.grid.tight_aabb().diff(dim=0)).max()) for o in change.objects)
    box = torch.stack([box[0] - _AROUND * side, box[1] + _AROUND * side])
    unknown = [c & ~r for c, r in zip(known.changed, known.recalled)]
    still = ~sparse.within(unknown)  # up to the objects' very edges, where their shadows are darkest
    seen = at_most_of(sparse, still & crosses(sparse.rays, [box]), _RAYS, draw)
    was = render_many(known.cut, seen.rays)
    x = seen.rays.origins + seen.rays.directions * was.depth[:, None]
    solid = (was.opacity > OPAQUE).nonzero()[:, 0]
    spacing = _SPACING * known.pixel(box.mean(0))
    return fit_light(Sightings(x, seen.rgb, was.rgb, seen.photo)[solid], box, spacing, _PATCH * spacing)


def shading_of(known: Known, draw: torch.Generator) -> tuple[Relighting | None, ...]:
    """How each moved object's own look changed with its place, kept at its old one.

    A side of it is often in one photo only, so patches of a photo are the folds, not photos.
    """
    cut, sparse = known.cut, known.sparse.taught
    out: list[Relighting | None] = []
    for i, move in enumerate(cut.moves):
        near = meets(Region((move.grid.moved(move.new_from_old),)).sampler(cut.sampler.step), sparse.rays)
        seen = at_most_of(sparse, near, _RAYS, draw)
        now = render_many(cut, seen.rays)
        x = seen.rays.origins + seen.rays.directions * now.depth[:, None]
        asked = transform(move.old_from_new, x)
        solid = ((now.opacity > OPAQUE) & (cut.arrived(x) == i)).nonzero()[:, 0]
        box = outline(move.grid)
        side = float((box[1] - box[0]).mean())
        sightings = Sightings(asked, seen.rgb, now.rgb, seen.photo).in_patches(side / _PATCHES)
        spacing = max(side / _CELLS, _PIXELS * known.pixel(x.mean(0)))
        box = torch.stack([box[0] - _MARGIN * spacing, box[1] + _MARGIN * spacing])
        out.append(fit_light(sightings[solid], box, spacing) if len(solid) else None)
    return tuple(out)
