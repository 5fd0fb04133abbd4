"""Where an old object is now: the pose that explains the photos best, of each outline that it may have, and of the two
things that one outline may be."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from refield.estimate.arrive import shadow_of
from refield.estimate.comoving import with_comoving
from refield.estimate.detail import Detail, detail_of, looking_alike
from refield.estimate.explain import FEWEST, explained_before
from refield.estimate.ground import Ground
from refield.estimate.hull import votes
from refield.estimate.lattice import Body, Lattice, components, some_of
from refield.estimate.layers import Sight, layers_at
from refield.estimate.look import Array
from refield.estimate.objects import Old
from refield.estimate.outline import FEWEST_POINTS, restricted
from refield.estimate.past import FEWEST_ASKED, Past, gone_score, silhouette
from refield.estimate.pose_change import COARSEST, FINER, SIDE, PoseChange, refine, shared_out
from refield.estimate.register import Candidate, Target, register
from refield.estimate.split import halves
from refield.scene.planes import Plane
from refield.scene.pose import angle_between, transform
from refield.vision import pixels

ALIKE = 0.02
"""of an object's pixels; poses that explain more by less than this explain as much"""
SHIFTS = 0.125
"""of an object's pixels; what a pose explains changes by no more when it is refined to the end"""
_HOLDS_MORE = 3.0  # times an object's volume; the hull of one object, carved by few photos, is about twice as large
_FEW = 3  # poses that are refined to the end
_MOST_PLACES = 24  # that are tried in a component that holds several objects


@dataclass(frozen=True)
class Fit:
    """An old object found again."""

    score: float
    """of the registration, as `Candidate.score`"""
    old: Old
    """without what cannot be at its new place"""
    change: PoseChange
    rest: Old | None = None
    """of the outline, where only a part of it was found"""
    rivals: tuple[Fit, ...] = ()
    """other poses of it that the photos show as well"""


def fit_of(
    ground: Ground,
    old: Old,
    olds: Sequence[Old],
    past: Sequence[Past],
    parts: Sequence[Body],
    extra: Sequence[Tensor],
) -> Fit | None:
    """The better fit of the outlines that an object may have.

    ``parts``: the arrivals' components.
    """
    fits: list[Fit] = []
    for one in old.outlines:
        fit = best_fit(ground, one, olds, past, parts, extra)
        if is_certain(ground, fit):
            return fit
        fits += [fit] if fit is not None else []
    whole = max(fits, key=lambda f: f.change.explained, default=None)
    if whole is None or old.remembered:
        return whole
    along = _along(ground, whole, olds, past)
    return max((fit for fit in (whole, along) if fit is not None), key=lambda f: f.change.net)


def is_certain(ground: Ground, fit: Fit | None) -> bool:
    """Whether the photos show nearly all of an object where it was found."""
    return fit is not None and fit.change.explained >= ground.believe.shown


def cut_of(
    ground: Ground,
    old: Old,
    whole: Fit | None,
    olds: Sequence[Old],
    past: Sequence[Past],
    parts: Sequence[Body],
    extra: Sequence[Tensor],
) -> Fit | None:
    """The fit of one of the two things that an outline may hold; None if neither is told better than the ``whole``.

    Where the whole fits, but not for certain, it is asked first whether it does because one of two things is there.

    ``parts``: the arrivals' components that would be told as newcomers if nothing explained them.
    """
    outline = old.outlines[-1]
    pairs = halves(outline, ground.shape)
    if left_by(ground, past, outline) is None:  # any outline can be cut: it or the half that is looked for is gone
        pairs = [(half, other) for half, other in pairs if left_by(ground, past, half) is not None]
    if not pairs or (whole is not None and not _shows_one_side(ground, whole, pairs[0], olds, past)):
        return None
    part = _part_of(ground, outline, pairs, olds, past, parts, extra)
    return part if part is None or whole is None or part.change.net > whole.change.net else None


def _shows_one_side(
    ground: Ground, whole: Fit, sides: tuple[Old, Old], olds: Sequence[Old], past: Sequence[Past]
) -> bool:
    """Whether the photos show one of two sides of an outline for certain where the whole fits, and not the other: what
    a field shows badly is explained as badly on either side."""
    pose, rays = whole.change.new_from_old, shared_out(ground.fine.rays[-1], len(past))
    sight = Sight(ground.field, whole.old, past, olds, detail_for(ground, whole.old, past, pose))
    ready = layers_at(sight, pose, rays)
    told = ready.explained_of(sides, pose, SIDE * ready.apparent)
    shares = [side.part for side in told]
    return min(shares) < ground.believe.shown <= max(shares) and min(side.pixels for side in told) >= FEWEST


def _along(ground: Ground, fit: Fit, olds: Sequence[Old], past: Sequence[Past]) -> Fit | None:
    """A thing that was found, outlined by what went along with it; what did not is the rest."""
    along = with_comoving(ground, fit.old, past, fit.change.new_from_old)
    if along is None:
        return None
    found = _refined(ground, along, olds, past, [fit.change.new_from_old], fit.score, ground.believe.gains)
    if found is None:
        return None
    return replace(found, rest=rest_of(ground, fit.old, along))


def rest_of(ground: Ground, old: Old, part: Old) -> Old | None:
    """What an outline holds beside a thing; None if that could not be found again."""
    left = components(old.voxels & ~part.lattice.holds(part.voxels, old.lattice.centres), FEWEST_POINTS)
    rest = restricted(replace(old, instead=None), left[0], ground.shape) if left else None
    return rest if rest is not None and len(rest.cloud.points) >= FEWEST_POINTS else None


def fit_again(ground: Ground, olds: Sequence[Old], past: Sequence[Past], found: Sequence[Fit]) -> Fit | None:
    """The best of the places at which an object was found before, if the photos still show it there for certain."""
    again: list[Fit] = []
    for f in found:
        fit = _refined(ground, f.old, olds, past, [f.change.new_from_old], f.score, ground.believe.gains)
        again += [replace(fit, rest=f.rest)] if fit is not None else []
    best = next(iter(_best_first(again)), None)
    return best if is_certain(ground, best) else None


def is_among(change: PoseChange, others: Iterable[PoseChange], old: Old) -> bool:
    """Whether a pose change puts an object at the same place as one of some others."""
    return any(at_one_place(other, change, old) for other in others)


def all_apart(changes: Iterable[PoseChange], old: Old, others: Sequence[PoseChange] = ()) -> list[PoseChange]:
    """Those pose changes that put an object at another place than those before them, and than some others, do."""
    apart: list[PoseChange] = []
    for change in changes:
        if not is_among(change, (*others, *apart), old):
            apart.append(change)
    return apart


def at_one_place(one: PoseChange, other: PoseChange, old: Old) -> bool:
    """Whether two poses put an object at the same place, within a pixel or two."""
    points = torch.from_numpy(old.cloud.points).double()
    apart = (transform(one.new_from_old, points) - transform(other.new_from_old, points)).norm(dim=-1)
    return bool(apart.max() < 2 * one.pixel)


def _part_of(
    ground: Ground,
    old: Old,
    pairs: Sequence[tuple[Old, Old]],
    olds: Sequence[Old],
    past: Sequence[Past],
    parts: Sequence[Body],
    extra: Sequence[Tensor],
) -> Fit | None:
    """The better fit of the two things that an outline may be; of the whole, if the other moved along.

    A piece fits more easily than a thing: one is believed if the photos show nearly all of it where it is.

    ``pairs``: the halves that are looked for, each with the other.
    """
    fits = [(best_fit(ground, half, olds, past, parts, extra), other) for half, other in pairs]
    found = [(fit, other) for fit, other in fits if fit is not None and is_certain(ground, fit)]
    if not found:
        return None
    best, other = max(found, key=lambda f: f[0].change.net)
    pose = [best.change.new_from_old]
    if _refined(ground, other, olds, past, pose, best.score, ground.believe.gains) is not None:
        whole = _refined(ground, old, olds, past, pose, best.score, ground.believe.gains)
        if whole is not None:
            return whole
    rivals = [f for f in best.rivals if is_certain(ground, f)]
    return replace(best, rest=other, rivals=tuple(replace(f, rest=other) for f in rivals))


def left_by(ground: Ground, past: Sequence[Past], old: Old) -> float | None:
    """Part of an object's pixels that show what was behind it; None if they are too few to say that it left."""
    share, asked = gone_score(past, old)
    return share if share >= ground.believe.gone and asked >= FEWEST_ASKED else None


def best_fit(
    ground: Ground,
    old: Old,
    olds: Sequence[Old],
    past: Sequence[Past],
    parts: Sequence[Body],
    extra: Sequence[Tensor] = (),
) -> Fit | None:
    """The pose change that best explains the photos with one old object; None if none does.

    ``parts``: the arrivals' components, any of which it may be, or be in.
    """
    found: list[Candidate] = []
    for target in (t for part in parts for t in targets_of(past, part, old)):
        found += register(old.cloud, past, target, ground.up, ground.search, extra)
        if any(c.score <= ground.search.enough for c in found):
            break
    return _likeliest(ground, old, olds, past, found, ground.believe.gains)


def _likeliest(
    ground: Ground, old: Old, olds: Sequence[Old], past: Sequence[Past], found: Sequence[Candidate], gains: float
) -> Fit | None:
    """The best of some candidates once the likelier ones are refined."""
    found = sorted(found, key=lambda c: c.score)
    if not found:
        return None
    likely = [c.new_from_old for c in found[: ground.believe.refined] if c.score <= found[0].score + 0.1]
    return _refined(ground, old, olds, past, likely, found[0].score, gains)


def places_among(
    ground: Ground, old: Old, olds: Sequence[Old], past: Sequence[Past], parts: Sequence[Body]
) -> list[Fit]:
    """Where an object may be among the newcomers' bodies, the likeliest few, refined; whether it is there is not said.

    An outline may hold much that is not the object's, so that few of its pixels are shown even where it is.
    """
    found: list[Candidate] = []
    for target in (t for part in parts for t in targets_of(past, part, old)):
        found += register(old.cloud, past, target, ground.up, ground.search)
    found = sorted(found, key=lambda c: c.score)[: ground.believe.refined]
    fine = finest(ground, Sight(ground.field, old, past, olds), [c.new_from_old for c in found])
    return [Fit(found[0].score, *one) for one in fine]


def slid(ground: Ground, old: Old, olds: Sequence[Old], past: Sequence[Past]) -> Fit | None:
    """The pose change of an object that may have slid by less than its width, so that it hides where it was.

    It explains hardly more pixels than it did where it was: whether it slid is not said here.
    """
    wanted = []
    for p in past:
        stays = ~pixels.dilate(p.changed.mask | p.changed.light | p.covered | silhouette(p.view, old), 3)
        wanted.append(-stays.astype(np.float32))
    target = Target(old.centre[None].astype(np.float32), tuple(wanted))
    found = register(old.cloud, past, target, ground.up, ground.search)
    return _likeliest(ground, old, olds, past, found, gains=0.0)


def _refined(
    ground: Ground,
    old: Old,
    olds: Sequence[Old],
    past: Sequence[Past],
    poses: Sequence[Tensor],
    score: float,
    gains: float,
) -> Fit | None:
    """The best of some poses of an object, refined, with its rivals; None if the photos do not show it at any.

    ``gains``: the part of its pixels by which they must show more of it than of what was there.
    """
    likely = finest(ground, Sight(ground.field, old, past, olds), poses, _asked(ground, old, past))
    fits = _best_first(Fit(score, *found) for found in likely if believed(ground, found[0], past, found[1], gains))
    return replace(fits[0], rivals=tuple(fits[1:])) if fits else None


def _best_first(fits: Iterable[Fit]) -> list[Fit]:
    """Fits of one object, those that explain most first; of those that explain as much, that which turns it least: a
    thing may look the same from several sides."""
    fits = list(fits)
    most = max((f.change.explained for f in fits), default=0.0)
    return sorted(fits, key=lambda f: (f.change.explained < most - ALIKE, _turn(f.change)))


def _turn(change: PoseChange) -> float:
    """Degrees by which a pose change turns an object."""
    return float(angle_between(change.new_from_old[:3, :3], torch.eye(3, dtype=torch.float64)))


def finest(ground: Ground, sight: Sight, poses: Sequence[Tensor], least: float = 0.0) -> list[tuple[Old, PoseChange]]:
    """The few poses of an object that explain most, each another place, refined to the end: what looks much alike when
    it is turned is told apart by what is fine. None that could not be the best, nor explain ``least`` of its pixels."""
    rough = [refine(sight, pose, ground.fine, COARSEST) for pose in poses]
    apart = all_apart(sorted((c for c in rough if c is not None), key=lambda c: -c.explained), sight.old)
    out = list[tuple[Old, PoseChange]]()
    most = apart[0].explained if apart else 0.0
    least = max(least, most - SHIFTS) - SHIFTS
    for change in [c for c in apart[:_FEW] if c.explained >= least]:
        found = finished(ground, sight, change)
        if found is not None and not is_among(found[1], [other for _, other in out], found[0]):
            out.append(found)
    return out


def finished(ground: Ground, sight: Sight, rough: PoseChange) -> tuple[Old, PoseChange] | None:
    """A pose refined to the end, with what old photos show of the object, and the object without what cannot be at the
    ``rough`` pose; None if no photo shows the place."""
    old, rough = trimmed(ground, sight, rough)
    # of the whole outline, so that poses at which other parts of it are cut off share it
    detail = detail_for(ground, sight.old, sight.past, rough.new_from_old)
    fine = refine(replace(sight, old=old, detail=detail), rough.new_from_old, ground.fine, FINER)
    return None if fine is None else (old, fine)


def believed(ground: Ground, old: Old, past: Sequence[Past], change: PoseChange, gains: float | None = None) -> bool:
    """Whether the photos show an object where a pose change puts it.

    ``gains``: the part of its pixels by which they must show more of it than of what was there.
    """
    believe = ground.believe
    least = _asked(ground, old, past)
    if is_sunk(ground, old, change):  # possible, off the edge of a table; but a crumb of floor fits anywhere
        least = max(least, believe.sunk)
    return change.explained >= least and gains_enough(ground, change, gains)


def _asked(ground: Ground, old: Old, past: Sequence[Past]) -> float:
    """The part of an object's pixels that a pose must explain: less of one that the old field shows badly."""
    believe = ground.believe
    return believe.explains * min(1.0, max(0.5, shown_right(ground, old, past) / believe.shown))


def gains_enough(ground: Ground, change: PoseChange, gains: float | None = None) -> bool:
    """Whether the photos show that much more of an object than of what was there; ``gains`` as configured if None."""
    return change.explained >= change.before + gains_asked(ground, change, gains)


def gains_asked(ground: Ground, change: PoseChange, gains: float | None = None) -> float:
    """The part of an object's pixels by which the photos must show more of it than of what was there; twice as much
    where its place looks as before."""
    gains = ground.believe.gains if gains is None else gains
    return gains * (2 if change.before > ground.believe.alike else 1)


def detail_for(ground: Ground, old: Old, past: Sequence[Past], new_from_old: Tensor) -> Detail | None:
    """What old photos show of an object that the field does not, as new ones see it at a pose; None if that is not
    asked for."""
    fine, views = ground.fine, [p.view for p in past]
    if fine.detail == 0 or not ground.photographed:
        return None
    rays = shared_out(fine.detail_rays, len(views))
    frames = looking_alike(old, ground.photographed, views, new_from_old, fine.detail)
    return ground.details.get((old, *frames), lambda: detail_of(ground.field, old, frames, rays))


def shown_right(ground: Ground, old: Old, past: Sequence[Past]) -> float:
    """Part of an object's pixels in old photos that the old field shows as they are."""
    threshold = float(np.median(np.concatenate([p.changed.threshold.ravel() for p in past])))
    return explained_before([(v.photo, v.rgb, silhouette(v, old)) for v in ground.survey], threshold)


def is_sunk(ground: Ground, old: Old, change: PoseChange) -> bool:
    """Whether most of an object would be beneath what holds things up, at its new place."""
    now = transform(change.new_from_old, torch.from_numpy(old.lattice.centres[old.voxels])).numpy()
    return any((p.above(now) < -2 * _exact(old, p)).mean() > 0.5 for p in ground.planes)


def _exact(old: Old, plane: Plane) -> float:
    """How exact the height of an object's voxels above a plane is, world units."""
    return max(0.25 * old.lattice.cell, plane.noise)


def trimmed(ground: Ground, sight: Sight, change: PoseChange) -> tuple[Old, PoseChange]:
    """The object without what cannot be at its new place (§10.2.4 on new photos).

    What no old view saw behind or beneath an object counts as solid. The new photos may look at its other side; and
    nothing reaches into what holds things up.
    """
    old, past = sight.old, sight.past
    places = old.lattice.centres[old.voxels]
    now = transform(change.new_from_old, torch.from_numpy(places)).numpy()
    seen = [
        (p.changed.witness(p.depth), pixels.dilate(p.changed.mask | p.changed.light | p.covered | ~p.known, 2))
        for p in past
    ]
    _, against = votes(now, seen, ground.carving)
    never = against > 0
    for plane in ground.planes:
        height, least = plane.above(now), _exact(old, plane)
        if (height < -2 * least).mean() >= ground.believe.trim:  # more than a pose that is not exact
            never |= height < least
    if never.mean() < ground.believe.trim:
        return old, change
    parts = components(some_of(old.voxels, ~never), 30)
    if not parts or parts[0].sum() < ground.believe.core * len(places):
        return old, change
    smaller = restricted(old, parts[0], ground.shape)
    if len(smaller.cloud.points) < FEWEST_POINTS:
        return old, change
    again = refine(replace(sight, old=smaller), change.new_from_old, ground.fine, COARSEST)
    return (old, change) if again is None or again.explained <= change.explained - 0.02 else (smaller, again)


def targets_of(past: Sequence[Past], body: Body, old: Old) -> list[Target]:
    """A component of the arrivals as places to register an object to; those that come later are for when it fails.

    Its middle, and where its bulk is thickest. One that is much larger than the object holds others too: then the
    object may be wherever its thickest part fits in.
    """
    wanted = []
    lattice, voxels = body.lattice, body.voxels
    for p in past:
        here = p.open & shadow_of(p.view, body)
        out = ~pixels.dilate(p.changed.mask | p.changed.light | p.covered, 3)
        wanted.append(here.astype(np.float32) - out.astype(np.float32))
    inner = ndimage.distance_transform_edt(voxels)
    if voxels.sum() * lattice.cell**3 > _HOLDS_MORE * old.volume:
        places = _places_in(lattice, inner, old)
        if len(places) > 1:
            return [Target(places, tuple(wanted), old.thickest[0])]
    middle = lattice.centres[voxels].mean(0)
    bulk = lattice.centres[inner > 0.7 * inner.max()].mean(0)
    centres = [middle] if np.linalg.norm(bulk - middle) < 4 * lattice.cell else [middle, bulk]
    return [Target(c[None].astype(np.float32), tuple(wanted)) for c in centres]


def _places_in(lattice: Lattice, inner: Array, old: Old) -> Array:
    """Spread places (K, 3) where an object's thickest part fits into a component.

    ``inner``: voxels to the component's surface.
    """
    fits = np.argwhere(inner * lattice.cell > min(0.8 * old.thickest[1], 0.7 * float(inner.max()) * lattice.cell))
    at = lattice.centres[tuple(fits.T)]
    chosen = [int(inner[tuple(fits.T)].argmax())]
    nearest = np.linalg.norm(at - at[chosen[0]], axis=-1)
    while len(chosen) < _MOST_PLACES and nearest.max() > 0.5 * old.radius:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(at - at[chosen[-1]], axis=-1))
    return at[chosen].astype(np.float32)
