"""What an update does to pixels that show nothing that changed, and which of its parts are left out for it.

Light, the light on each moved object, and what is told of the surroundings of what left and arrived (ground, helper)
are fitted to a few photos. Where one of them shows unchanged pixels of those photos worse than the old field did, the
update is better without it: the rest is kept. Pixels of the same photos judge that nothing was
fitted to: harm that shows only from elsewhere is not seen here. Letters: P pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_many
from refield.update.composite import UpdatedField
from refield.update.region import Region, carved, grown
from refield.update.routing import SKIN
from refield.update.supervision import Lessons
from refield.update.textured import TexturedPlane

_PIXELS = 20_000  # of the new photos, that are asked; their errors' means are known to a few parts in a thousand
_ROUNDED = 1 / 255**2 / 12  # squared error of a photo's own rounding to 8 bits; less is no difference


@dataclass(frozen=True)
class ShowConfig:
    """What is kept of what was learnt."""

    spared: bool = True
    """leave out parts that show unchanged pixels worse than the old field did"""


@dataclass(frozen=True)
class LeftOut:
    """A part that an update is better without."""

    part: str
    """in words"""
    gain: float
    """dB that unchanged pixels are shown better without it, of those whose rays meet anything that it says"""


@dataclass(frozen=True)
class Spared:
    """What is kept of an update."""

    field: UpdatedField
    left_out: tuple[LeftOut, ...] = ()
    lost: float = 0.0
    """dB that the same pixels are shown worse than before all the same; 0 if they are not"""


def spared(updated: UpdatedField, new: Lessons, changed: Tensor) -> Spared:
    """The update without the parts that show unchanged pixels worse; all of it, if the old field shows them no better.

    A part is left out if unchanged pixels, and all pixels together, are shown better without it; the one by which
    unchanged pixels gain the most first.

    Args:
        new: pixels of the new photos that are kept to judge by.
        changed: (P,) bool, which of them show what arrived or left.
    """
    before, same = updated.unchanged(new.rays)
    rows = (~same).nonzero()[:, 0]
    if len(rows) > _PIXELS:
        rows = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:_PIXELS]]
    asked, still = new[rows], ~changed[rows]
    if not still.any():
        return Spared(updated)

    def errors(field: Field) -> Tensor:
        return (render_many(field, asked.rays).rgb - asked.rgb).square().mean(-1)

    was, now = errors(before), errors(updated)
    parts, left_out = _parts(updated), []
    while parts and now[still].mean() > was[still].mean() + _ROUNDED:
        without = {name: part(updated) for name, part in parts.items()}
        found = {name: errors(field) for name, field in without.items()}
        name = min(found, key=lambda n: float(found[n][still].sum()))
        if found[name][still].mean() > now[still].mean() - _ROUNDED or found[name].mean() > now.mean():
            break
        left_out.append(
            LeftOut(name, 10 * float((now[still].sum() / found[name][still].sum().clamp_min(1e-12)).log10()))
        )
        updated, now = without[name], found[name]
        del parts[name]
    lost = 10 * float((now[still].mean() / (was[still].mean() + _ROUNDED)).clamp_min(1).log10())
    return Spared(updated, tuple(left_out), lost)


_Without = Callable[[UpdatedField], UpdatedField]


def _parts(updated: UpdatedField) -> dict[str, _Without]:
    """What may be left out, by its name in words, and how."""
    out: dict[str, _Without] = {}
    if updated.light is not None:
        out["the light on what stood still"] = lambda field: field.but(learnt=replace(field.learnt, light=None))
    if any(light is not None for light in updated.shading):
        out["the light on what moved"] = lambda field: field.but(learnt=replace(field.learnt, shading=()))
    if updated.helper is not None or updated.region.planes:
        out["what is beside the objects' places"] = lambda field: field.but(
            learnt=replace(field.learnt, region=_narrow(field))
        )
    return out


def _narrow(updated: UpdatedField) -> Region:
    """The places alone about which the old field is wrong: what left was in them, or what arrived is."""
    change, skin = updated.to_learn, SKIN * updated.pretrained.sampler.step
    arrived = tuple(grown(o.grid, skin) for o in change.objects if o.kind == "added")
    grids = carved(change, skin).grids + arrived + updated.bare.grids + updated.earlier.unknown.grids
    planes = tuple(p for plane in updated.region.planes if (p := _beneath(plane, Region(grids))).known.any())
    return Region(grids, planes)


def _beneath(plane: TexturedPlane, places: Region) -> TexturedPlane:
    """What a plane knows of itself in some places, and right beneath them."""
    under = places.contains(plane.nodes) | places.contains(plane.nodes + plane.clear * plane.normal)
    return replace(plane, known=plane.known & under.reshape(plane.known.shape))
