"""What arrived: voxels that newcomers may fill, and which of them are believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from refield.estimate.consist import colours_of_others
from refield.estimate.cost import CAME, price, wrongness
from refield.estimate.detect import Mask, difference
from refield.estimate.explain import LIMIT
from refield.estimate.ground import Ground
from refield.estimate.hull import HullConfig, look_behind, votes
from refield.estimate.lattice import EVERY_WAY, Body, Lattice, components, grown, some_of
from refield.estimate.light import Ratio, brighter, light_of_others
from refield.estimate.look import Array, View
from refield.estimate.objects import Old
from refield.estimate.outline import free_voxels
from refield.estimate.past import Past
from refield.scene.pose import invert, transform
from refield.vision import pixels

_NEARLY_ALL = 0.95  # of a would-be newcomer's pixels


def arrivals(ground: Ground, past: Sequence[Past], olds: Sequence[Old]) -> list[Body]:
    """Connected voxels of the hull that newcomers may fill: in every seeing view's unexplained change, and empty once
    the old are gone."""
    out = []
    for hull in ground.hulls:
        empty = Body(hull.lattice, _empty(hull.lattice.centres, ~hull.solid, olds) & hull.free)
        there = _new(empty, past, ground.carving, ground.carving.margin)
        out += [Body(hull.lattice, part) for part in components(there.voxels, 1)]
    return out


def newcomers(ground: Ground, past: Sequence[Past], olds: Sequence[Old]) -> list[Body]:
    """Bodies that explain changed pixels which nothing else does, those that explain most of them first.

    Each is carved on a lattice of its own: on the hull's, which holds what is beside it, a small thing has few voxels.
    """
    out, open_ = list[Body](), [p.open & p.changed.certain for p in past]
    some = arrivals(ground, past, olds)
    some = [body for body in some if any(_speaks(ground, s & o) for s, o in zip(shadows_of(past, body), open_))]
    left = [(b, shadows_of(past, b)) for body in some for b in _thick(ground, _finer(ground, body, past, olds))]
    light = cache(partial(_lit, ground, past))
    while left:
        left.sort(key=lambda one: -sum(int((here & o).sum()) for here, o in zip(one[1], open_)))
        body, shadows = left.pop(0)
        seen = [(here, o, p.known) for here, o, p in zip(shadows, open_, past) if _speaks(ground, here & o)]
        shares = [float((here & o).sum() / (here & known).sum()) for here, o, known in seen]
        enough = len(shares) >= min(2, len(past)) and float(np.median(shares)) > ground.believe.arrived
        if enough and not _only_light(ground, body, past, shadows, light()):
            out.append(body)
            open_ = [o & ~pixels.dilate(here, 1) for o, here in zip(open_, shadows)]
    return out


def exactly(ground: Ground, body: Body, past: Sequence[Past]) -> Body:
    """A newcomer without what lies beside the photos' masks, by which it was carved with a margin."""
    inside = _new(body, past, ground.carving, 0)
    return inside if inside.voxels.any() else body


def _finer(ground: Ground, coarse: Body, past: Sequence[Past], olds: Sequence[Old]) -> Body:
    """What a component of the arrivals is on a lattice of its own, whose voxels are no smaller than pixels."""
    config, at, reach = ground.carving, coarse.places, coarse.lattice.cell
    pixel = min(float(np.linalg.norm(at - p.view.centre, axis=1).min()) * p.view.pixel_angle for p in past)
    lattice = Lattice.over(at.min(0) - reach, at.max(0) + reach, config.longest, pixel)
    voxels = free_voxels(lattice, ground.planes) & coarse.lattice.holds(grown(coarse.voxels, 1), lattice.centres)
    body = _new(Body(lattice, voxels), past, config, config.margin)
    # old photos last, since they are many: whether they look through what is left
    through, _ = look_behind(body.places, [*ground.survey, *(p.view for p in past)], config)
    return replace(body, voxels=some_of(body.voxels, _empty(body.places, through, olds)))


def _empty(places: Array, air: Mask, olds: Sequence[Old]) -> Mask:
    """Which of some ``places`` (..., 3) are ``air`` (...), or where one of the old was."""
    for old in olds:
        air = air | old.lattice.holds(grown(old.voxels, 1), places)
    return air


def _new(body: Body, past: Sequence[Past], config: HullConfig, margin: int) -> Body:
    """A body's voxels in every seeing view's unexplained change, grown by ``margin`` pixels."""
    seen = [(p.changed.witness(p.depth), p.changed.mask & ~p.explained) for p in past]
    needed = min(2, len(past))
    inside, against = votes(body.places, [(v, pixels.dilate(m, margin)) for v, m in seen], config)
    body = replace(body, voxels=some_of(body.voxels, (inside >= needed) & (against == 0)))
    sure, _ = votes(body.places, [(v, pixels.dilate(p.open, margin)) for (v, _), p in zip(seen, past)], config)
    return replace(body, voxels=some_of(body.voxels, sure >= needed))


def _thick(ground: Ground, body: Body) -> list[Body]:
    """The parts of a body, without the thin sheets that are left between masks."""
    core = ndimage.binary_erosion(body.voxels, EVERY_WAY)
    thick = grown(core, 2, body.voxels) if core.any() else core
    return [replace(body, voxels=part) for part in components(thick, ground.carving.smallest)]


def shadows_of(past: Sequence[Past], body: Body) -> list[Mask]:
    """Per photo, the pixels that show a newcomer: those it projects to, where nothing that is known hides it."""
    return [shadow_of(p.view, body, p.depth) for p in past]


def _speaks(ground: Ground, mask: Mask) -> bool:
    """Whether so many pixels of a photo say anything."""
    return float(mask.mean()) >= 2 * ground.detect.smallest


def remarkable(
    ground: Ground, parts: Sequence[Body], past: Sequence[Past], places: Sequence[tuple[Old, Tensor]]
) -> list[Body]:
    """Would-be newcomers that are no scraps at the edges of objects."""
    some = [p for p in parts if _may_pay(ground, p, past)]
    return [p for p in some if not any(_rim_of(p, old, place) for old, place in places)]


def _may_pay(ground: Ground, part: Body, past: Sequence[Past]) -> bool:
    """Whether a would-be newcomer explains what it costs, beside what was placed already, with the margin by which it
    was carved: what hardly pays is rather the place of a small thing that left."""
    shadows, gain = shadows_of(past, part), 0.0
    for here, p in zip(shadows, past):
        told = p.known & ~p.covered & p.asked
        gain += float((wrongness(p.difference, p.changed.threshold) - CAME)[here & told].sum())
    return gain > price(shadows, ground.believe.smallest)


def _rim_of(part: Body, old: Old, new_from_old: Tensor) -> bool:
    """Whether a small would-be newcomer hugs an object's old or new place: a contact shadow, the rest of an outline."""
    points = torch.from_numpy(part.places)
    if len(points) * part.lattice.cell**3 > 0.2 * old.volume:
        return False
    back = transform(invert(new_from_old), points).numpy()
    reach = max(2, round(0.35 * old.radius / old.lattice.cell))
    near = ndimage.distance_transform_edt(~np.pad(old.voxels, reach)) <= reach
    ijk = np.floor((back - old.lattice.low) / old.lattice.cell).astype(int) + reach
    inside = ((ijk >= 0) & (ijk < near.shape)).all(-1)
    return float(near[tuple(ijk[inside].T)].sum()) > 0.5 * len(points)


@dataclass(frozen=True)
class _Lit:
    """Where a photo shows what is known to stand there, only darker or brighter, (H, W) each."""

    asked: Mask
    """pixels whose surface other photos see"""
    alike: Mask
    """of these, pixels that show it in the light in which the others do"""
    even: Mask
    """pixels that show it evenly darker or brighter"""


def _lit(ground: Ground, past: Sequence[Past]) -> list[_Lit]:
    views = [replace(p.view, rgb=p.rgb, depth=p.depth) for p in past]
    ratios = [Ratio.of(p.view, p.rgb, ground.detect) for p in past]
    out = []
    for p, ratio, light in zip(past, ratios, light_of_others(views, ratios, [p.covered for p in past])):
        asked = np.isfinite(light)
        alike = _shows(ground, p, brighter(p.rgb, np.where(asked, light, 0)))
        out.append(_Lit(asked, asked & alike, ratio.even_and_grey))
    return out


def _only_light(
    ground: Ground, part: Body, past: Sequence[Past], shadows: Sequence[Mask], light: Sequence[_Lit]
) -> bool:
    """Whether a would-be newcomer only darkens or brightens what is behind it: mostly by as much as other photos show
    there, and what they show of the newcomer itself tells of no more pixels than it costs; or evenly nearly everywhere,
    as no thing does by chance."""
    here = [shadow & p.open for shadow, p in zip(shadows, past)]
    if _count(here, [one.even for one in light]) > _NEARLY_ALL * _count(here, here):
        return True
    asked = [h & one.asked for h, one in zip(here, light)]
    alike = [one.alike for one in light]
    if not any(_speaks(ground, a) for a in asked) or _count(asked, alike) <= 0.5 * _count(asked, asked):
        return False
    things = colours_of_others(part, [(p.view, h) for p, h in zip(past, here)])
    both = [a & np.isfinite(thing[..., 0]) for a, thing in zip(asked, things)]
    shown = [_shows(ground, p, np.where(b[..., None], thing, p.view.photo)) for p, thing, b in zip(past, things, both)]
    # about a quarter of the smallest thing's pixels in these photos: by fewer the two do not differ
    fewest = (1 - CAME) * price(shadows, ground.believe.smallest)
    return _count(both, alike) > _count(both, shown) - fewest


def _count(some: Sequence[Mask], others: Sequence[Mask]) -> int:
    """Pixels, over all photos, that are in both."""
    return sum(int((a & b).sum()) for a, b in zip(some, others))


def _shows(ground: Ground, p: Past, picture: Array) -> Mask:
    """Pixels of a photo that show what a picture (H, W, 3) does."""
    return difference(p.view, picture, ground.detect) < LIMIT * p.changed.threshold


def fresh(past: Sequence[Past], body: Body) -> float:
    """Part of a newcomer's pixels that nothing else explains, the median over photos that show any."""
    shares = [float((here & p.open).sum() / here.sum()) for here, p in zip(shadows_of(past, body), past) if here.any()]
    return float(np.median(shares)) if shares else 0.0


def shadow_of(view: View, body: Body, depth: Array | None = None) -> Mask:
    """Pixels that voxels project to; with the ``depth`` (H, W) of what stands there, those that it does not hide."""
    out = np.zeros(view.shape, bool)
    uv, distance, inside = view.project(body.places)
    if depth is not None:
        inside = inside & (distance < view.lookup(depth, uv, inside) + body.lattice.cell)
    ij = uv[inside].astype(np.int64)
    out[ij[:, 1], ij[:, 0]] = True
    return pixels.close(out, 5)
