"""Which of the things that were is which of the things that are (§10.2.2), by trying: a pose that explains the photos.

Objects are placed one after the other, the best first; what a placed object explains is taken off the photos before the
next is looked for. So two newcomers whose hulls run together are told apart by what fits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from refield.estimate.arrive import newcomers, remarkable
from refield.estimate.cost import price, wrongness
from refield.estimate.detect import Changed
from refield.estimate.fit import Fit, cut_of, fit_again, fit_of, is_among, is_certain, left_by
from refield.estimate.ground import Ground
from refield.estimate.matched import matched_poses
from refield.estimate.objects import Old
from refield.estimate.past import Past, changed_share, silhouette
from refield.estimate.pose_change import PoseChange
from refield.scene.pose import transform
from refield.vision import pixels


def may_have_changed(ground: Ground, changed: Sequence[Changed], old: Old) -> bool:
    """Whether an object is to be looked for elsewhere: its pixels changed, and it is no crumb, unless it is known."""
    if not old.remembered and is_crumb(ground, changed, old):
        return False
    return changed_share(without(ground, changed, [old]), old) >= ground.believe.touched


def is_crumb(ground: Ground, changed: Sequence[Changed], old: Old) -> bool:
    """Whether what is wrong where an object was is less than it would cost that it left: it is rather the edge of
    something else."""
    shown = [silhouette(c.view, old) for c in changed]
    wrong = sum(float(wrongness(c.difference, c.threshold)[s].sum()) for c, s in zip(changed, shown))
    return wrong <= price(shown, ground.believe.smallest)


def without(
    ground: Ground, changed: Sequence[Changed], olds: Sequence[Old], placed: Sequence[tuple[Old, PoseChange]] = ()
) -> list[Past]:
    """The photos past some objects, with those that were placed taken off."""
    views = ground.past(changed, olds)
    for old, change in placed:
        views = take_off(ground, views, old, change)
    return views


def place_all(
    ground: Ground,
    olds: tuple[dict[int, Old], dict[int, Old]],
    changed: Sequence[Changed],
    moved: dict[int, PoseChange],
    kept: tuple[Iterator[int], dict[int, list[Fit]]],
) -> tuple[dict[int, PoseChange], dict[int, Old]]:
    """Place the changed objects that fit somewhere, in the photos without those that certainly left, then without all.

    What a newcomer hides may look like a thing that changed; where that is taken out, nobody knows what is behind, and
    the newcomer is not looked for.

    Args:
        olds: the objects that are known to have moved or left, and those that are placed now.
        moved: where the former are.
        kept: numbers for what outlines are cut into; and all places that were found for each object at any time.
    """
    (there, asked), known = olds, olds[0] | olds[1]
    sure = [k for k, old in asked.items() if left_by(ground, without(ground, changed, [old]), old) is not None]
    others = [k for k in asked if k not in sure]
    for out, some in [(sure, sure), (list(asked), others)] if sure and others else [(list(asked), list(asked))]:
        gone = {k: known[k] for k in dict.fromkeys((*there, *out, *moved))}
        views = without(ground, changed, list(gone.values()), [(known[k], c) for k, c in moved.items()])
        more, placed = _place(ground, gone, some, views, kept)
        moved, known = moved | more, known | placed
    return moved, known


def _place(
    ground: Ground,
    olds: dict[int, Old],
    asked: Sequence[int],
    views: list[Past],
    kept: tuple[Iterator[int], dict[int, list[Fit]]],
) -> tuple[dict[int, PoseChange], dict[int, Old]]:
    """Place some of the objects that ``views`` are without, the best first, taking each off."""
    keys, found = kept
    moved: dict[int, PoseChange] = {}
    tried = {k: olds[k] for k in asked[: ground.believe.most]}
    everyone, first = list(olds.values()), views
    cut: set[int] = set()  # what is left of outlines of which a part was found
    guess = cache(lambda k: matched_poses(tried[k], first, ground.survey, ground.matcher))
    while True:
        parts = newcomers(ground, views, everyone)[: ground.believe.most]
        left = remarkable(ground, parts, views, places_of(everyone, [(olds[k], c) for k, c in moved.items()]))
        fits: dict[int, Fit] = {}
        # what moved before moves again: a piece of something else is tried only on what that leaves unexplained
        for again in (True, False):
            some = [k for k, old in tried.items() if old.remembered == again and k not in moved and parts]
            tries: dict[int, Fit | None] = {}
            ground.tally.begin(len(some))
            for k in some:
                known = fit_again(ground, everyone, views, found[k])
                tries[k] = known or fit_of(ground, olds[k], everyone, views, parts, guess(k))
                ground.tally.count(len(some) - len(tries))
            fits |= _believed(ground, tries, cut)
            if left and not again and not any(is_certain(ground, fit) for fit in fits.values()):
                # if any fits, only those that do: once they are off the photos nothing may be left that asks for a cut
                for k in [k for k in some if k in fits or not fits]:
                    tries[k] = cut_of(ground, olds[k], fits.get(k), everyone, views, left, guess(k)) or tries[k]
                fits |= _believed(ground, tries, cut)
            for k, best in tries.items():
                for fit in () if best is None else (best, *best.rivals):
                    if not is_among(fit.change, [f.change for f in found[k]], fit.old):
                        found[k].append(fit)
            if any(is_certain(ground, fit) for fit in fits.values()):
                break
        if not fits:
            return moved, olds
        for k in _together(fits, ground.search.enough):
            olds[k], moved[k] = fits[k].old, fits[k].change
            rest = fits[k].rest
            if rest is not None and may_have_changed(ground, [v.changed for v in first], rest):
                another = next(keys)
                olds[another] = tried[another] = rest
                cut.add(another)
            views = take_off(ground, views, olds[k], moved[k])


def _believed(ground: Ground, tries: dict[int, Fit | None], cut: set[int]) -> dict[int, Fit]:
    """What was found; what is left of an outline (``cut``) only if the photos show it for certain."""
    return {k: fit for k, fit in tries.items() if fit is not None and (k not in cut or is_certain(ground, fit))}


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


def places_of(olds: Sequence[Old], placed: Sequence[tuple[Old, PoseChange]]) -> list[tuple[Old, Tensor]]:
    """Where objects stood and stand, each with its motion (4, 4) from where it stood."""
    still = torch.eye(4, dtype=torch.float64)
    return [(old, still) for old in olds] + [(old, change.new_from_old) for old, change in placed]


def take_off(ground: Ground, past: Sequence[Past], old: Old, change: PoseChange) -> list[Past]:
    """The photos once a placed object is accounted for: its pixels are explained, and it stands in front."""
    out = []
    for p in past:
        view = p.view
        alone = ground.object_alone(old, view, change)
        depth = alone.depth.numpy()
        shown = ((alone.opacity > 0.5).numpy() & (depth <= p.depth.ravel() + 0.5 * old.radius)).reshape(view.shape)
        shown = pixels.dilate(shown, 2)
        mask = p.changed.mask & ~shown
        front = np.where(shown, np.minimum(p.depth, depth.reshape(view.shape)), p.depth)
        changed = replace(p.changed, mask=mask)
        out.append(replace(p, changed=changed, depth=front.astype(np.float32), covered=p.covered | shown))
    return out
