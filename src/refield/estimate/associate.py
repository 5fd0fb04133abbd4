"""Which of the things that were is which of the things that are (§10.2.2), by trying: a pose that explains the photos.

Objects are placed one after the other, the best first; what a placed object explains is taken off the photos before the
next is looked for. So two newcomers whose hulls run together are told apart by what fits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import count

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from refield.estimate.alone import object_alone
from refield.estimate.consist import consistent
from refield.estimate.detail import Detail, detail_of
from refield.estimate.detect import Changed, DetectConfig, Mask
from refield.estimate.explain import explained_before
from refield.estimate.hull import Hull, HullConfig, votes
from refield.estimate.lattice import Lattice, Voxels, components, grown
from refield.estimate.layers import Sight
from refield.estimate.light import Ratio
from refield.estimate.look import Array, View
from refield.estimate.matched import matched_poses
from refield.estimate.memory import Memory
from refield.estimate.objects import Old
from refield.estimate.outline import FEWEST_POINTS, ObjectConfig, restricted
from refield.estimate.past import Past, changed_share, gone_score, look_past, silhouette
from refield.estimate.pose_change import COARSEST, FINER, PoseChange, RefineConfig, refine, shared_out
from refield.estimate.register import Candidate, RegisterConfig, Target, register
from refield.estimate.split import halves
from refield.field.radiance import Field
from refield.scene.capture import Frame
from refield.scene.planes import Plane
from refield.scene.pose import invert, transform
from refield.vision import pixels
from refield.vision.matcher import Matcher

_HOLDS_MORE = 3.0  # times an object's volume; the hull of one object, carved by few photos, is about twice as large
_MOST_PLACES = 24  # that are tried in a component that holds several objects


@dataclass(frozen=True)
class AssociateConfig:
    """When a pose, a departure, an arrival is believed."""

    touched: float = 0.5
    """part of an old object's pixels that must have changed for it to be looked for elsewhere"""
    fits: float = 0.62
    """worst registration score that is refined"""
    explains: float = 0.5
    """part of the object's pixels that the moved object must explain"""
    shown: float = 0.8
    """part of the object's pixels that the field shows right in old photos; if it is less, down to half as much need be
    explained"""
    gains: float = 0.15
    """by how much more than the old rendering did"""
    alike: float = 0.5
    """part of the pixels at its new place that look as before; if it is more, it must gain twice as much"""
    refined: int = 6
    """candidates of an object that are refined"""
    gone: float = 0.45
    """part of an object's pixels that must show what was behind it, for it to have left"""
    arrived: float = 0.5
    """part of a newcomer's pixels that nothing else explains"""
    smallest: float = 0.003
    """part of a photo that a thing must fill in one at least; a smaller one is an error of the field, or an edge"""
    # the paper's contour area is 1 %, §10.2.2
    trim: float = 0.03
    """part of an object's voxels that the new photos or the ground deny, from which on it is trimmed"""
    core: float = 0.25
    """part of an object's voxels that must remain when it is trimmed"""
    sunk: float = 0.8
    """part of its pixels that must show an object which would be mostly beneath what holds things up"""
    still: float = 1.2
    """pixels; what moved by less stayed"""
    most: int = 5
    """old objects, and places, that are tried; the largest first"""


@dataclass(frozen=True)
class Ground:
    """What every attempt shares."""

    field: Field
    hull: Hull
    free: Voxels
    """voxels on the hull's lattice in front of whatever holds things up"""
    up: Array
    """(3,) the support's normal"""
    planes: Sequence[Plane]
    """what holds things up"""
    survey: Sequence[View]
    memory: Memory
    """what old photos saw"""
    photographed: Sequence[Frame]
    """old photos that show the old state as it was"""
    detect: DetectConfig
    carving: HullConfig
    shape: ObjectConfig
    believe: AssociateConfig
    search: RegisterConfig
    fine: RefineConfig
    matcher: Matcher


@dataclass(frozen=True)
class Settled:
    """What became of everything that changed."""

    moved: dict[int, PoseChange] = field(default_factory=dict)
    """by index of the old object"""
    removed: dict[int, float] = field(default_factory=dict)
    """by index of the old object: part of its pixels that show what was behind"""
    arrived: tuple[Voxels, ...] = ()
    views: tuple[Past, ...] = ()
    olds: tuple[Old, ...] = ()
    """the old objects, those that were found again without what cannot be theirs"""


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


def settle(ground: Ground, olds: Sequence[Old], changed: Sequence[Changed]) -> Settled:
    """Find each old object's new place or that it left, and what else arrived."""
    touched = [k for k, old in enumerate(olds) if _may_have_changed(ground, changed, old)]
    moved, views, placed = _place_all(ground, {k: olds[k] for k in touched}, changed, count(len(olds)))
    trimmed_some = any(placed[k] is not olds[k] for k in touched)
    every = dict(enumerate(olds)) | placed
    olds, touched = [every[k] for k in sorted(every)], list(placed)
    shares = {k: _gone(ground, views, olds[k]) for k in touched if k not in moved}
    removed = {k: share for k, share in shares.items() if share is not None}
    kept = [k for k in touched if k in moved or k in removed]
    if len(kept) < len(touched) or trimmed_some:  # what never left hides what is behind it after all
        views = _without(ground, changed, [olds[k] for k in kept], [(olds[k], c) for k, c in moved.items()])
    gone = [olds[k] for k in kept]
    places = _places(gone, [(olds[k], c) for k, c in moved.items()])
    arrived = _remarkable(ground, newcomers(ground, arrivals(ground, views, gone), views), views, places)
    arrived = [consistent(ground.hull.lattice, p, [(v.view, v.open) for v in views]) for p in arrived]
    # what its colours leave of it must be as believable as the whole was
    arrived = [p for p in arrived if fresh(views, ground.hull.lattice, p) >= ground.believe.arrived]
    moved = {k: c for k, c in moved.items() if _noticeable(olds[k], c, ground.believe.still)}
    return Settled(moved, removed, tuple(arrived), tuple(views), tuple(olds))


def _may_have_changed(ground: Ground, changed: Sequence[Changed], old: Old) -> bool:
    """Whether an object is to be looked for elsewhere: its pixels changed, and it is no crumb, unless it is known."""
    crumb = not old.remembered and is_crumb(changed, old, ground.believe.smallest)
    return not crumb and changed_share(changed, old) >= ground.believe.touched


def unexplained(ground: Ground, settled: Settled, part: Voxels) -> bool:
    """Whether most of the changed pixels that some voxels project to are not accounted for by what was settled."""
    lattice = ground.hull.lattice
    shown, left = 0, 0
    for p in settled.views:
        here = shadow_of(p.view, lattice, part)
        came = np.logical_or.reduce([shadow_of(p.view, lattice, a) for a in settled.arrived] or [np.zeros_like(here)])
        shown += int(here.sum())
        left += int((here & p.changed.mask & ~p.explained & ~pixels.dilate(came, 2)).sum())
    return left > ground.believe.touched * shown


def is_crumb(changed: Sequence[Changed], old: Old, least: float) -> bool:
    """Whether an object fills less than this part of every photo: it is rather the edge of something else."""
    return max(float(silhouette(c.view, old).mean()) for c in changed) < least


def looks_gone(ground: Ground, changed: Sequence[Changed], old: Old) -> bool:
    """Whether an object's pixels changed and show what was behind it."""
    if changed_share(changed, old) < ground.believe.touched:
        return False
    return _gone(ground, _without(ground, changed, [old]), old) is not None


def _without(
    ground: Ground, changed: Sequence[Changed], olds: Sequence[Old], placed: Sequence[tuple[Old, PoseChange]] = ()
) -> list[Past]:
    """The photos past some objects, with those that were placed taken off."""
    views = look_past(ground.field, changed, ground.memory, olds, (ground.detect, ground.carving))
    for old, change in placed:
        views = take_off(ground.field, views, old, change)
    return views


def _gone(ground: Ground, views: Sequence[Past], old: Old) -> float | None:
    """Part of an object's pixels that show what was behind it; None if they are too few to say that it left."""
    share, asked = gone_score(views, old)
    return share if share >= ground.believe.gone and asked >= 12 else None


def _place_all(
    ground: Ground, olds: dict[int, Old], changed: Sequence[Changed], keys: Iterator[int]
) -> tuple[dict[int, PoseChange], list[Past], dict[int, Old]]:
    """Place the changed objects that fit somewhere, in the photos without those that certainly left, then without all.

    What a newcomer hides may look like a thing that changed; where that is taken out, nobody knows what is behind, and
    the newcomer is not looked for.
    """
    sure = [k for k, old in olds.items() if _gone(ground, _without(ground, changed, [old]), old) is not None]
    others = [k for k in olds if k not in sure]
    moved: dict[int, PoseChange] = {}
    for out, asked in [(sure, sure), (list(olds), others)] if sure and others else [(list(olds), list(olds))]:
        views = _without(ground, changed, [olds[k] for k in out], [(olds[k], c) for k, c in moved.items()])
        more, views, placed = _place(ground, {k: olds[k] for k in out}, asked, views, keys)
        moved, olds = moved | more, olds | placed
    return moved, views, olds


def _place(
    ground: Ground, olds: dict[int, Old], asked: Sequence[int], views: list[Past], keys: Iterator[int]
) -> tuple[dict[int, PoseChange], list[Past], dict[int, Old]]:
    """Place some of the objects that ``views`` are without, the best first, taking each off."""
    moved: dict[int, PoseChange] = {}
    tried = {k: olds[k] for k in asked[: ground.believe.most]}
    everyone, first = list(olds.values()), views
    cut: set[int] = set()  # what is left of outlines of which a part was found
    guess = cache(lambda k: matched_poses(tried[k], first, ground.survey, ground.matcher))
    while True:
        parts = newcomers(ground, arrivals(ground, views, everyone), views)[: ground.believe.most]
        left = _remarkable(ground, parts, views, _places(everyone, [(olds[k], c) for k, c in moved.items()]))
        fits: dict[int, Fit] = {}
        # what moved before moves again: a piece of something else is tried only on what that leaves unexplained
        for again in (True, False):
            some = [k for k, old in tried.items() if old.remembered == again and k not in moved and parts]
            tries = {k: _best_of(ground, olds[k], everyone, views, (parts, left), guess(k)) for k in some}
            enough = {k: ground.believe.shown if k in cut else 0.0 for k in some}
            fits |= {k: fit for k, fit in tries.items() if fit is not None and fit.change.explained >= enough[k]}
            if any(fit.change.explained >= ground.believe.shown for fit in fits.values()):
                break
        if not fits:
            return moved, views, olds
        for k in _together(fits, ground.search.enough):
            olds[k], moved[k] = fits[k].old, fits[k].change
            rest = fits[k].rest
            if rest is not None and _may_have_changed(ground, [v.changed for v in first], rest):
                another = next(keys)
                olds[another] = tried[another] = rest
                cut.add(another)
            views = take_off(ground.field, views, olds[k], moved[k])


def _together(fits: dict[int, Fit], enough: float) -> list[int]:
    """Of objects that fit: the best, and those that fit as well as can be at places of their own.

    The others are looked for again when these are off the photos.
    """
    taken: dict[int, Tensor] = {}
    for k, fit in sorted(fits.items(), key=lambda f: f[1].score):
        centre = transform(fit.change.new_from_old, torch.from_numpy(fit.old.centre).double())
        apart = [float((centre - c).norm()) > 0.8 * (fit.old.radius + fits[j].old.radius) for j, c in taken.items()]
        if not taken or (fit.score <= enough and all(apart)):
            taken[k] = centre
    return list(taken)


def arrivals(ground: Ground, past: Sequence[Past], olds: Sequence[Old]) -> Voxels:
    """Voxels that newcomers may fill: in every seeing view's unexplained change, and empty once the old are gone."""
    hull, config = ground.hull, ground.carving
    points = hull.lattice.centres.reshape(-1, 3)
    seen = [(p.changed.witness(p.depth), p.changed.mask & ~p.explained) for p in past]
    inside, against = votes(points, [(v, pixels.dilate(m, config.margin)) for v, m in seen], config)
    sure, _ = votes(points, [(v, pixels.dilate(p.open, 1)) for (v, _), p in zip(seen, past)], config)
    air = ~hull.solid.reshape(-1)
    for old in olds:
        air |= old.lattice.holds(grown(old.voxels, 1), points)
    needed = min(2, len(past))
    found = (inside >= needed) & (sure >= needed) & (against == 0) & air
    return found.reshape(hull.lattice.shape) & ground.free


def newcomers(ground: Ground, voxels: Voxels, past: Sequence[Past]) -> list[Voxels]:
    """Components of the arrivals that explain changed pixels which nothing else does."""
    lattice = ground.hull.lattice
    core = ndimage.binary_erosion(voxels, np.ones((3, 3, 3), bool))  # not the thin sheets left between masks
    thick = grown(core, 2, voxels) if core.any() else core
    out: list[Voxels] = []
    taken = [~p.open for p in past]
    for part in components(thick, ground.carving.smallest):
        shares = []
        shadows = [shadow_of(p.view, lattice, part) for p in past]
        for here, gone, p in zip(shadows, taken, past):
            if (here & ~gone).sum() >= ground.detect.smallest * here.size * 2:
                shares.append(float((here & ~gone).sum() / (here & p.known).sum()))
        enough = len(shares) >= min(2, len(past)) and float(np.median(shares)) > ground.believe.arrived
        if enough and not _only_light(ground, part, past):
            out.append(part)
            taken = [t | pixels.dilate(s, 1) for t, s in zip(taken, shadows)]
    return out


def _places(olds: Sequence[Old], placed: Sequence[tuple[Old, PoseChange]]) -> list[tuple[Old, Tensor]]:
    """Where objects stood and stand, each with its motion (4, 4) from where it stood."""
    still = torch.eye(4, dtype=torch.float64)
    return [(old, still) for old in olds] + [(old, change.new_from_old) for old, change in placed]


def _remarkable(
    ground: Ground, parts: Sequence[Voxels], past: Sequence[Past], places: Sequence[tuple[Old, Tensor]]
) -> list[Voxels]:
    """Would-be newcomers that are no scraps at the edges of objects."""
    large = [p for p in parts if _substantial(ground, p, past)]
    return [p for p in large if not any(_rim_of(ground, p, old, place) for old, place in places)]


def _substantial(ground: Ground, part: Voxels, past: Sequence[Past]) -> bool:
    """Whether a would-be newcomer is large enough in some photo; what is left over at the edge of others is not."""
    shadows = [shadow_of(p.view, ground.hull.lattice, part) & p.open for p in past]
    return max(float(s.mean()) for s in shadows) >= ground.believe.smallest


def _rim_of(ground: Ground, part: Voxels, old: Old, new_from_old: Tensor) -> bool:
    """Whether a small would-be newcomer hugs an object's old or new place: a contact shadow, the rest of an outline."""
    lattice = ground.hull.lattice
    points = torch.from_numpy(lattice.centres[part])
    if len(points) * lattice.cell**3 > 0.2 * old.volume:
        return False
    back = transform(invert(new_from_old), points).numpy()
    reach = max(2, round(0.35 * old.radius / old.lattice.cell))
    near = ndimage.distance_transform_edt(~np.pad(old.voxels, reach)) <= reach
    ijk = np.floor((back - old.lattice.low) / old.lattice.cell).astype(int) + reach
    inside = ((ijk >= 0) & (ijk < near.shape)).all(-1)
    return float(near[tuple(ijk[inside].T)].sum()) > 0.5 * len(points)


def _only_light(ground: Ground, part: Voxels, past: Sequence[Past]) -> bool:
    """Whether a would-be newcomer lies flat on what holds things up and only darkens or brightens it."""
    points = ground.hull.lattice.centres[part]
    extent = float((points.max(0) - points.min(0)).max())
    low = max(5 * ground.hull.lattice.cell, 0.3 * extent)
    if not any((plane.above(points) <= low).mean() >= 0.95 for plane in ground.planes):
        return False
    alike, shown = 0, 0
    for p in past:
        here = shadow_of(p.view, ground.hull.lattice, part) & p.open
        alike += int((here & Ratio.of(p.view, p.rgb, ground.detect).even_and_grey).sum())
        shown += int(here.sum())
    return alike > 0.5 * shown


def fresh(past: Sequence[Past], lattice: Lattice, part: Voxels) -> float:
    """Part of a newcomer's pixels that nothing else explains, the median over photos that show any."""
    shadows = [(shadow_of(p.view, lattice, part), p.open) for p in past]
    shares = [float((here & left).sum() / here.sum()) for here, left in shadows if here.any()]
    return float(np.median(shares)) if shares else 0.0


def shadow_of(view: View, lattice: Lattice, voxels: Voxels) -> Mask:
    """Pixels that voxels project to."""
    out = np.zeros(view.shape, bool)
    uv, _, inside = view.project(lattice.centres[voxels])
    ij = uv[inside].astype(np.int64)
    out[ij[:, 1], ij[:, 0]] = True
    return pixels.close(out, 5)


def targets_of(past: Sequence[Past], lattice: Lattice, voxels: Voxels, old: Old) -> list[Target]:
    """A component of the arrivals as places to register an object to; those that come later are for when it fails.

    Its middle, and where its bulk is thickest. One that is much larger than the object holds others too: then the
    object may be wherever it fits in, and need not explain the whole.
    """
    wanted, never = [], []
    for p in past:
        here = p.open & shadow_of(p.view, lattice, voxels)
        out = ~pixels.dilate(p.changed.mask | p.changed.light | p.covered, 3)
        wanted.append(here.astype(np.float32) - out.astype(np.float32))
        never.append(-out.astype(np.float32))
    inner = ndimage.distance_transform_edt(voxels)
    if voxels.sum() * lattice.cell**3 > _HOLDS_MORE * old.volume:
        places = _places_in(lattice, inner, old)
        if len(places) > 1:
            return [Target(places, tuple(never))]
    middle = lattice.centres[voxels].mean(0)
    bulk = lattice.centres[inner > 0.7 * inner.max()].mean(0)
    centres = [middle] if np.linalg.norm(bulk - middle) < 4 * lattice.cell else [middle, bulk]
    return [Target(c[None].astype(np.float32), tuple(wanted)) for c in centres]


def _places_in(lattice: Lattice, inner: Array, old: Old) -> Array:
    """Spread places (K, 3) where an object's thickest part fits into a component; ``inner``: voxels to its surface."""
    thickest = float(ndimage.distance_transform_edt(old.voxels).max()) * old.lattice.cell
    fits = np.argwhere(inner * lattice.cell > min(0.8 * thickest, 0.7 * float(inner.max()) * lattice.cell))
    at = lattice.centres[tuple(fits.T)]
    chosen = [int(inner[tuple(fits.T)].argmax())]
    nearest = np.linalg.norm(at - at[chosen[0]], axis=-1)
    while len(chosen) < _MOST_PLACES and nearest.max() > 0.5 * old.radius:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(at - at[chosen[-1]], axis=-1))
    return at[chosen].astype(np.float32)


def _best_of(
    ground: Ground,
    old: Old,
    olds: Sequence[Old],
    past: Sequence[Past],
    arrived: tuple[Sequence[Voxels], Sequence[Voxels]],
    extra: Sequence[Tensor],
) -> Fit | None:
    """The better fit of the outlines that an object may have, or of a part of one that may hold several things.

    ``arrived``: the arrivals' components, and those that would be told as newcomers if nothing explained them: only
    these are worth an outline cut in two.
    """
    (parts, newcomers_left), outlines = arrived, [old] if old.instead is None else [old, old.instead]
    fits: list[Fit] = []
    for one in outlines:
        fit = best_fit(ground, one, olds, past, parts, extra)
        fits += [fit] if fit is not None else []
        if fit is not None and fit.change.explained >= ground.believe.shown:
            return fit
    whole = max(fits, key=lambda f: f.change.explained, default=None)
    if old.remembered or not newcomers_left:
        return whole
    part = _part_of(ground, outlines[-1], olds, past, newcomers_left, extra)
    if part is None or (whole is not None and whole.change.net >= part.change.net):
        return whole
    return part


def _part_of(
    ground: Ground,
    old: Old,
    olds: Sequence[Old],
    past: Sequence[Past],
    parts: Sequence[Voxels],
    extra: Sequence[Tensor],
) -> Fit | None:
    """The better fit of the two things that an outline may be; of the whole, if the other moved along.

    Any outline can be cut, and a piece fits more easily than a thing: one is believed if it shows as much as it can.
    """
    fits = [(best_fit(ground, half, olds, past, parts, extra), other) for half, other in halves(old, ground.shape)]
    found = [(fit, other) for fit, other in fits if fit is not None and fit.change.explained >= ground.believe.shown]
    if not found:
        return None
    best, other = max(found, key=lambda f: f[0].change.net)
    pose = [best.change.new_from_old]
    if _refined(ground, other, olds, past, pose, best.score) is not None:
        whole = _refined(ground, old, olds, past, pose, best.score)
        if whole is not None:
            return whole
    return replace(best, rest=other)


def best_fit(
    ground: Ground,
    old: Old,
    olds: Sequence[Old],
    past: Sequence[Past],
    parts: Sequence[Voxels],
    extra: Sequence[Tensor] = (),
) -> Fit | None:
    """The pose change that best explains the photos with one old object; None if none does.

    ``parts``: the arrivals' components, any of which it may be, or be in.
    """
    found: list[Candidate] = []
    for target in (t for part in parts for t in targets_of(past, ground.hull.lattice, part, old)):
        found += register(old.cloud, past, target, ground.up, ground.search, extra)
        if min(c.score for c in found) <= ground.search.enough:
            break
    found.sort(key=lambda c: c.score)
    if not found:
        return None
    most = min(ground.believe.fits, found[0].score + 0.1)
    likely = [c.new_from_old for c in found[: ground.believe.refined] if c.score <= most]
    return _refined(ground, old, olds, past, likely, found[0].score)


def _refined(
    ground: Ground, old: Old, olds: Sequence[Old], past: Sequence[Past], poses: Sequence[Tensor], score: float
) -> Fit | None:
    """The best of some poses of an object, refined; None if the photos do not show it there."""
    believe = ground.believe
    best: PoseChange | None = None
    sight = Sight(ground.field, old, past, olds)
    for pose in poses:
        change = refine(sight, pose, ground.fine, COARSEST)
        if change is not None and (best is None or change.explained > best.explained + 0.02):
            best = change
    if best is not None:
        sight = replace(sight, detail=_detail(ground, old, past, best.new_from_old))
        best = refine(sight, best.new_from_old, ground.fine, FINER)
    if best is None:
        return None
    old, best = trimmed(ground, sight, best)
    least = believe.explains * min(1.0, max(0.5, shown_right(ground, old, past) / believe.shown))
    gains = believe.gains * (2 if best.before > believe.alike else 1)
    if is_sunk(ground, old, best):  # possible, off the edge of a table; but a crumb of floor fits anywhere
        least = max(least, ground.believe.sunk)
    if best.explained < max(least, best.before + gains):
        return None
    return Fit(score, old, best)


def _detail(ground: Ground, old: Old, past: Sequence[Past], new_from_old: Tensor) -> Detail | None:
    fine, views = ground.fine, [p.view for p in past]
    if fine.detail == 0 or not ground.photographed:
        return None
    rays = shared_out(fine.detail_rays, len(views))
    return detail_of(ground.field, old, ground.photographed, views, new_from_old, fine.detail, rays)


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
    voxels = old.voxels.copy()
    voxels[voxels] = ~never
    parts = components(voxels, 30)
    if not parts or parts[0].sum() < ground.believe.core * len(places):
        return old, change
    smaller = restricted(old, parts[0], ground.shape)
    if len(smaller.cloud.points) < FEWEST_POINTS:
        return old, change
    again = refine(replace(sight, old=smaller), change.new_from_old, ground.fine)
    return (old, change) if again is None or again.explained <= change.explained - 0.02 else (smaller, again)


def take_off(field: Field, past: Sequence[Past], old: Old, change: PoseChange) -> list[Past]:
    """The photos once a placed object is accounted for: its pixels are explained, and it stands in front."""
    out = []
    for p in past:
        view = p.view
        alone = object_alone(field, old, view.rays, change.new_from_old)
        depth = alone.depth.numpy()
        shown = ((alone.opacity > 0.5).numpy() & (depth <= p.depth.ravel() + 0.5 * old.radius)).reshape(view.shape)
        shown = pixels.dilate(shown, 2)
        mask = p.changed.mask & ~shown
        front = np.where(shown, np.minimum(p.depth, depth.reshape(view.shape)), p.depth)
        changed = replace(p.changed, mask=mask)
        out.append(replace(p, changed=changed, depth=front.astype(np.float32), covered=p.covered | shown))
    return out


def _noticeable(old: Old, change: PoseChange, still: float) -> bool:
    """Whether any part of the object moved by more than ``still`` pixels."""
    points = torch.from_numpy(old.cloud.points).double()
    shift = (transform(change.new_from_old, points) - points).norm(dim=-1)
    return bool(shift.max() > still * change.pixel)
