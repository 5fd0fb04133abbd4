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
from torch import Tensor

from refield.estimate.alone import object_alone
from refield.estimate.arrive import arrivals, fresh, newcomers, remarkable, shadow_of
from refield.estimate.consist import consistent
from refield.estimate.detect import Changed
from refield.estimate.fit import Fit, fit_of, left_by
from refield.estimate.ground import Ground
from refield.estimate.lattice import Voxels
from refield.estimate.matched import matched_poses
from refield.estimate.objects import Old
from refield.estimate.past import Past, changed_share, look_past, silhouette
from refield.estimate.pose_change import PoseChange
from refield.field.radiance import Field
from refield.scene.pose import transform
from refield.vision import pixels


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


def settle(ground: Ground, olds: Sequence[Old], changed: Sequence[Changed]) -> Settled:
    """Find each old object's new place or that it left, and what else arrived."""
    touched = [k for k, old in enumerate(olds) if _may_have_changed(ground, changed, old)]
    moved, views, placed = _place_all(ground, {k: olds[k] for k in touched}, changed, count(len(olds)))
    trimmed_some = any(placed[k] is not olds[k] for k in touched)
    every = dict(enumerate(olds)) | placed
    olds, touched = [every[k] for k in sorted(every)], list(placed)
    shares = {k: left_by(ground, views, olds[k]) for k in touched if k not in moved}
    removed = {k: share for k, share in shares.items() if share is not None}
    kept = [k for k in touched if k in moved or k in removed]
    if len(kept) < len(touched) or trimmed_some:  # what never left hides what is behind it after all
        views = _without(ground, changed, [olds[k] for k in kept], [(olds[k], c) for k, c in moved.items()])
    gone = [olds[k] for k in kept]
    places = _places(gone, [(olds[k], c) for k, c in moved.items()])
    arrived = remarkable(ground, newcomers(ground, arrivals(ground, views, gone), views), views, places)
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
    return left_by(ground, _without(ground, changed, [old]), old) is not None


def _without(
    ground: Ground, changed: Sequence[Changed], olds: Sequence[Old], placed: Sequence[tuple[Old, PoseChange]] = ()
) -> list[Past]:
    """The photos past some objects, with those that were placed taken off."""
    views = look_past(ground.field, changed, ground.memory, olds, (ground.detect, ground.carving))
    for old, change in placed:
        views = take_off(ground.field, views, old, change)
    return views


def _place_all(
    ground: Ground, olds: dict[int, Old], changed: Sequence[Changed], keys: Iterator[int]
) -> tuple[dict[int, PoseChange], list[Past], dict[int, Old]]:
    """Place the changed objects that fit somewhere, in the photos without those that certainly left, then without all.

    What a newcomer hides may look like a thing that changed; where that is taken out, nobody knows what is behind, and
    the newcomer is not looked for.
    """
    sure = [k for k, old in olds.items() if left_by(ground, _without(ground, changed, [old]), old) is not None]
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
        left = remarkable(ground, parts, views, _places(everyone, [(olds[k], c) for k, c in moved.items()]))
        fits: dict[int, Fit] = {}
        # what moved before moves again: a piece of something else is tried only on what that leaves unexplained
        for again in (True, False):
            some = [k for k, old in tried.items() if old.remembered == again and k not in moved and parts]
            tries = {k: fit_of(ground, olds[k], everyone, views, (parts, left), guess(k)) for k in some}
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


def _places(olds: Sequence[Old], placed: Sequence[tuple[Old, PoseChange]]) -> list[tuple[Old, Tensor]]:
    """Where objects stood and stand, each with its motion (4, 4) from where it stood."""
    still = torch.eye(4, dtype=torch.float64)
    return [(old, still) for old in olds] + [(old, change.new_from_old) for old, change in placed]


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
