"""What became of everything that changed: the hypothesis by which the new photos are explained best.

Begun with the objects placed one by one, then changed by one exchange at a time while that leaves less unexplained; at
last what is explained less than it might is rotated about its place.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count

import numpy as np
import torch

from refield.estimate.arrive import exactly, fresh, newcomers, remarkable
from refield.estimate.associate import may_have_changed, place_all, places_of, without
from refield.estimate.comoving import with_comoving
from refield.estimate.confidence import confidence
from refield.estimate.consist import consistent
from refield.estimate.cost import CAME
from refield.estimate.detect import Changed
from refield.estimate.fit import (
    ALIKE,
    Fit,
    all_apart,
    at_one_place,
    believed,
    gains_asked,
    gains_enough,
    is_among,
    left_by,
    places_among,
    rest_of,
    slid,
)
from refield.estimate.ground import Ground
from refield.estimate.kept import Kept
from refield.estimate.lattice import Body
from refield.estimate.layers import Sight
from refield.estimate.likelihood import Settled, gained_apart, judged, pixels_at, pixels_of, unexplained_at
from refield.estimate.look import Array
from refield.estimate.objects import Old
from refield.estimate.outline import as_one, standing
from refield.estimate.past import Past
from refield.estimate.pose_change import FINER, PoseChange, refine
from refield.estimate.rotations import best_rotations, may_be_turned, rotated_at
from refield.estimate.split import halves
from refield.scene.pose import invert, transform

_Tries = Callable[[Settled], Iterator[Settled]]
_Which = tuple[str, int, int]
_SAME = 0.25
"""of an object's radius; places that are nearer to each other are asked for its rotation once"""
_PIECES = ("cut", "parted")
"""exchanges that tell pieces of an outline for things"""
_OTHERS = ("elsewhere", "again", "stayed")
"""what says of an object something else, not the same more exactly"""
_EVEN = 0.5
"""confidence in what is as likely as not"""


@dataclass(frozen=True)
class Search:
    """What is tried beside a hypothesis, and what was found out while trying."""

    ground: Ground
    changed: Sequence[Changed]
    first: dict[int, Old] = field(default_factory=dict)
    """the objects as they were outlined at first"""
    fits: dict[int, list[Fit]] = field(default_factory=lambda: defaultdict(list))
    """where each was found at any time"""
    wholes: Kept[Old | None] = field(default_factory=Kept)
    """the thing that an outline is a piece of, or two of them are"""
    slides: Kept[Fit | None] = field(default_factory=Kept)
    """how an object may have slid"""
    again: Kept[list[Fit]] = field(default_factory=Kept)
    """where what left may be among what arrived"""
    rotated: Kept[list[tuple[Array, list[tuple[Old, PoseChange]]]]] = field(default_factory=Kept)
    """how what left may be rotated, place by place"""
    pieces: Kept[list[Old]] = field(default_factory=Kept)
    """of an outline, that changed"""
    hypotheses: Kept[Settled] = field(default_factory=lambda: Kept(32))
    """by what was, what was touched and where it is"""
    costs: Kept[tuple[Settled, float]] = field(default_factory=lambda: Kept(32))
    """of hypotheses, as `judged` tells them"""
    outlined: Kept[Old | None] = field(default_factory=Kept)
    """what went along with an object, by its motion and by what else changed"""
    anew: dict[int, Old] = field(default_factory=dict)
    """what was outlined so, by its identity"""

    def settle(self, olds: Sequence[Old], begun: Settled | None = None) -> Settled:
        """Find each old object's new place or that it left, and what else arrived.

        ``begun``: what was settled before these objects were known; it stays unless they leave enough less unexplained.
        """
        best, least = self._judged(self._placed(olds, begun or Settled()))
        again = True
        tried: dict[_Which, float] = {}  # beside this best one
        while again:
            again, exchanges = False, self._exchanges(best)
            self.ground.tally.begin(sum(this not in tried for this, _ in exchanges))
            for k, (this, tries) in enumerate(exchanges, start=1):
                if this in tried:
                    continue
                others = [self._judged(other) for other in tries(best)]
                asked = [self._compared(best, least, o, left, this[0] in _PIECES) for o, left in others]
                tried[this] = min(asked, default=math.inf)
                if tried[this] < least - 1:
                    best, least = others[asked.index(tried[this])]
                    again, tried = True, {}
                self.ground.tally.count(sum(that not in tried for that, _ in exchanges[k:]))
        if begun is not None:
            before = self._judged(begun)[1]
            if self._compared(begun, before, best, least) >= before:
                return begun
        return self._led(best, least, tried)

    def _judged(self, settled: Settled) -> tuple[Settled, float]:
        return self.costs.get((settled,), lambda: judged(self.ground, settled))

    def _compared(self, best: Settled, least: float, other: Settled, left: float, piece: bool = False) -> float:
        """What a hypothesis costs, beside the best one, which costs ``least``: with what the things more must gain that
        it tells of, and no less than it is cheaper where what became of anything is told otherwise. What arrived has
        another outline beside a thing more; that says nothing of the thing."""
        worth = self._worth(best, other, piece) if left < least else 0.0
        return left if worth == 0 else worth + max(left, least - gained_apart(self.ground, best, other))

    def _worth(self, best: Settled, other: Settled, piece: bool = False) -> float:
        """How many pixels less than the best one a hypothesis must leave unexplained: of each thing more that moved or
        left by it, the part of its pixels, where it was and where it is, that a pose must gain which is believed; less
        those of each that it tells of no longer. What little a field, its light or the pose of another thing is wrong
        by is explained by a thing more, too.

        Where nothing is told yet something changed all the same: then only a ``piece`` must gain as much, which fits
        more easily than a thing, and no more where its place looks as before.
        """
        beside = bool(best.moved or best.removed or best.arrived)
        if not beside and not piece:
            return 0.0
        told, now = best.moved.keys() | best.removed.keys(), other.moved.keys() | other.removed.keys()
        worth = sum(self._gain(other, k, beside) for k in now - told)
        if not piece:  # it is told beside, or in place of, a whole that fits as well
            worth -= sum(self._gain(best, k, beside) for k in told - now)
        return max(worth, 0.0)

    def _gain(self, settled: Settled, k: int, beside: bool) -> float:
        """Pixels, where an object was and where it is, that it must gain to be told, ``beside`` other things or not."""
        gains = self.ground.believe.gains
        if beside and k in settled.moved:
            gains = gains_asked(self.ground, settled.moved[k])
        return gains * pixels_of(self.ground, settled, k)

    def likely(self, told: Settled) -> Settled:
        """What was settled, without what left or arrived and by its lead is less likely so than not, beside what moved
        or is likelier; unless something left and something arrived, which may be one thing that moved."""
        if told.removed and told.arrived:
            return told
        removed = {k: v for k, v in told.removed.items() if confidence("removed", told.led[k], half=False) >= _EVEN}
        came = [one for one in zip(told.arrived, told.came) if confidence("added", one[1], half=False) >= _EVEN]
        if not (told.moved or removed or came):
            return told
        bodies, leads = tuple(body for body, _ in came), tuple(lead for _, lead in came)
        return replace(told, removed=removed, arrived=bodies, came=leads)

    def turned(self, told: Settled) -> Settled:
        """What was settled, with each object rotated about its place as the photos show more of it, where they show
        less than they might.

        The number that hypotheses are compared by hardly knows the rotation of what is small: a rotation may leave as
        many pixels more unexplained as it explains more of the object.
        """
        for k in told.moved:
            old, change = told.olds[k], told.moved[k]
            gone, views = self._without(told, k, old)
            if may_be_turned(self.ground, old, views, change):
                sight = Sight(self.ground.field, old, views, gone)
                told = self._turned_to(told, k, best_rotations(self.ground, sight, change))
        return told

    def _turned_to(self, told: Settled, k: int, found: Sequence[tuple[Old, PoseChange]]) -> Settled:
        """What was settled, with an object at the best of some poses, the first of which is the one that is told."""
        old, best = max(found, key=lambda one: one[1].explained, default=(told.olds[k], told.moved[k]))
        if not found or best.explained < found[0][1].explained + ALIKE:
            return told
        other, left = self._judged(self._with(told, k, old, best))
        if other.moved.keys() != told.moved.keys() or other.removed.keys() != told.removed.keys():
            return told
        gained = (best.explained - found[0][1].explained) * pixels_at(self.ground, other, k)
        if left - self._judged(told)[1] > gained:
            return told
        twins = all_apart((one for _, one in found if one.explained > best.explained - ALIKE), old, [best])
        return replace(other, led=told.led, twins={**told.twins, k: tuple(twins)})

    def _led(self, best: Settled, least: float, tried: dict[_Which, float]) -> Settled:
        """The best hypothesis with how far it leads the other answers for each object that it tells of, and the poses
        between which the photos do not decide."""
        led, twins = {}, {}
        for k in (*best.moved, *best.removed):
            asked = max(pixels_of(self.ground, best, k), 1)
            other = min((left for (kind, j, *_), left in tried.items() if j == k and kind in _OTHERS), default=math.inf)
            led[k] = (other - least) / asked
            if tried.get(("turned", k, 0), math.inf) - least < ALIKE * asked:
                alike = (
                    one.moved[k]
                    for one in self._turned(best, k)
                    if k in one.moved and self._judged(one)[1] - least < ALIKE * asked
                )
                twins[k] = tuple(all_apart(alike, best.olds[k], [best.moved[k]]))
        return replace(best, led=led, twins=twins)

    def _exchanges(self, best: Settled) -> list[tuple[_Which, _Tries]]:
        """What is tried beside a hypothesis, each with what tells it from the others."""
        changed, pieces = (*best.moved, *best.removed), self._pieces(best)
        return [
            *((("elsewhere", k, 0), partial(self._elsewhere, k=k)) for k in self.fits),
            *((("turned", k, 0), partial(self._turned, k=k)) for k in best.moved),
            *((("again", k, 0), partial(self._again, k=k)) for k in best.removed if best.arrived),
            *((("stayed", k, 0), partial(self._stayed, k=k)) for k in changed),
            *((("outlined", k, 0), partial(self._outlines, k=k)) for k in changed),
            *((("joined", k, 0), partial(self._joined, k=k)) for k in best.moved if len(best.moved) > 1),
            *((("slid", k, id(one)), partial(self._slides, k=k, one=one)) for k, one in self._asked(best)),
            *((("cut", 0, id(one)), partial(self._cut, one=one)) for one in pieces),
            *([(("parted", 0, 0), self._parted)] if pieces else []),
        ]

    def _pieces(self, best: Settled) -> list[Old]:
        """Pieces of what was outlined at first that changed, and of which more is left unexplained than the pixels of a
        newcomer cost; those where most is left come first."""
        believe, left = self.ground.believe, unexplained_at(self.ground, best)
        worth: list[tuple[float, Old]] = []
        for old in self.first.values():
            if left(old.outlines[-1], 0):
                pieces = self.pieces.get((old,), partial(_cut_up, self.ground, self.changed, old))
                worth += [(much, one) for one in pieces if (much := left(one, CAME))]
        worth.sort(key=lambda w: -w[0])
        return [one for _, one in worth[: believe.most]]

    def _cut(self, best: Settled, one: Old) -> Iterator[Settled]:
        """With a piece of an outline, or all that went along with it, for a thing that turned or slid about where it
        was; the others of which it is a piece as they are told, or not moved."""
        k, alone = len(best.olds), _without_moves_around(best, one)
        around = [c for j, c in best.moved.items() if j not in alone.moved]
        fits: list[tuple[Old, PoseChange]] = []
        for fit in self._places(alone, one):
            if is_among(fit.change, around, fit.old):  # what went along is asked elsewhere
                continue
            change = self._refined(alone, k, fit.old, fit.change)
            if change is not None and _noticeable(fit.old, change, self.ground.believe.still):
                fits.append((fit.old, change))
                for told in (best, alone) if around else (best,):
                    yield self._with(told, k, fit.old, change)
        if fits:
            old, change = max(fits, key=lambda f: f[1].net)
            yield from self._with_along(alone, k, old, change)

    def _parted(self, best: Settled) -> Iterator[Settled]:
        """With several pieces for things, each where most of it is explained: one alone may leave more to a newcomer
        than it explains."""
        found = [fits[0] for one in self._pieces(best) if (fits := self._places(best, one))]
        taken, now = list[Old](), best
        for fit in sorted(found, key=lambda f: -f.change.net):
            if any(fit.old.within(o) or o.within(fit.old) for o in taken):
                continue
            k, alone = len(now.olds), _without_moves_around(now, fit.old)
            change = self._refined(alone, k, fit.old, fit.change)
            if change is not None and _noticeable(fit.old, change, self.ground.believe.still):
                now = self._with(alone, k, fit.old, change)
                taken.append(fit.old)
        if len(taken) > 1:
            yield now

    def _places(self, best: Settled, one: Old) -> list[Fit]:
        """Where a piece of an outline may be about where it was, as it is asked for first. What went elsewhere is found
        as a whole, or by half."""

        def found() -> Fit | None:
            gone, views = self._without(best, len(best.olds), one)
            return slid(self.ground, one, gone, views)

        fit = self.slides.get((one,), found)
        return [] if fit is None else [fit, *fit.rivals]

    def _placed(self, olds: Sequence[Old], begun: Settled) -> Settled:
        """The hypothesis that more objects are where each is found by itself, one after the other."""
        ground, changed = self.ground, self.changed
        more = dict(enumerate(olds, start=len(begun.olds)))
        known = dict(enumerate(begun.olds)) | more
        self.first.update(more)
        asked = {k: old for k, old in more.items() if may_have_changed(ground, changed, old)}
        wholes = list(asked.values())
        kept = {k: known[k] for k in (*begun.moved, *begun.removed) if not is_piece(known[k], wholes)}
        moved = {k: c for k, c in begun.moved.items() if k in kept}
        moved, placed = place_all(ground, (kept, asked), changed, moved, (count(len(known)), self.fits))
        touched = [k for k in begun.touched if not is_piece(known[k], wholes)]
        touched += [k for k in placed if k not in touched]
        return self._hypothesis(known | placed, touched, moved)

    def _hypothesis(self, known: dict[int, Old], touched: Sequence[int], moved: dict[int, PoseChange]) -> Settled:
        """What `_completed` makes of it, made once of the same objects, of which none is known by two indices, with the
        same poses: without one object the others are often asked again."""
        olds = [known[k] for k in sorted(known)]
        placed = [one for k, change in moved.items() for one in (known[k], change)]
        make = partial(_completed, self.ground, known, touched, self.changed, moved)
        return self.hypotheses.get((*olds, None, *(known[k] for k in touched), None, *placed), make)

    def _with(self, best: Settled, k: int, old: Old, change: PoseChange | None, rest: Old | None = None) -> Settled:
        """The hypothesis with object ``k`` as it is told here, without those that are pieces of it, and the others
        without it; the ``rest`` of its outline may have left."""
        olds, apart = dict(enumerate(best.olds)) | {k: old}, [k]
        for j in best.touched:
            mine = olds[j]
            if j == k or mine.within(old):
                continue
            if old.within(mine):
                left = rest_of(self.ground, mine, old)
                if left is None:
                    continue
                olds[j] = left
            apart.append(j)
        if rest is not None and may_have_changed(self.ground, self.changed, rest):
            apart.append(len(olds))
            olds[len(olds)] = rest
        moved = {j: c for j, c in best.moved.items() if j in apart and j != k}
        return self._hypothesis(olds, apart, moved if change is None else moved | {k: change})

    def _without(self, best: Settled, k: int, one: Old) -> tuple[list[Old], list[Past]]:
        """What left in a hypothesis, with ``one`` for object ``k``, and the photos past that, the others taken off."""
        apart = [j for j in best.touched if j != k and not best.olds[j].within(one)]
        gone = [one, *(best.olds[j] for j in apart if j in best.moved or j in best.removed)]
        placed = [(best.olds[j], c) for j, c in best.moved.items() if j in apart]
        return gone, without(self.ground, self.changed, gone, placed)

    def _outlines(self, best: Settled, k: int) -> Iterator[Settled]:
        """With an object outlined by its motion, again from the outline that this gave before, and what seems to have
        left may be of it; or the rest of it may be a thing that left."""
        old, change = best.olds[k], best.moved.get(k)
        if change is not None and best.removed:
            yield from self._with_along(best, k, old, change)
        if change is None and (id(old) in self.anew or k not in best.removed):
            return
        other = self._outlined(best, k, old, change)
        if other is None:
            return
        self.anew[id(other)] = other
        if change is not None:
            change = self._refined(best, k, other, change)
        if change is not None or k in best.removed:
            rest = rest_of(self.ground, old, other)
            for one in (rest, None) if rest is not None else (None,):
                yield self._with(best, k, other, change, one)

    def _outlined(self, best: Settled, k: int, old: Old, change: PoseChange | None, apart: bool = True) -> Old | None:
        """All that went along with an object; unless it is ``apart``, also of what seems to have left."""
        if old.remembered:
            return None
        gone, views = self._without(best, k, old)
        others = [o for o in gone if o is not old and not old.within(o)]
        if not apart:
            left = [best.olds[j] for j in best.removed]
            others = [o for o in others if o.remembered or not any(o is one for one in left)]
        pose = None if change is None else change.new_from_old
        make = partial(with_comoving, self.ground, old, views, pose, others)
        return self.outlined.get((old, change, *sorted(gone, key=id), None, *sorted(others, key=id)), make)

    def _joined(self, best: Settled, k: int) -> Iterator[Settled]:
        """With an object and another that went where its motion takes it as one thing."""
        if k not in best.moved:  # no longer: another exchange was taken since this one was listed
            return
        old, change = best.olds[k], best.moved[k]
        for j, other in best.moved.items():
            pieces = sorted((old, best.olds[j]), key=id)
            if j == k or any(o.remembered for o in pieces) or not at_one_place(change, other, best.olds[j]):
                continue
            moved = {i: c for i, c in best.moved.items() if i != j}
            alone = replace(best, moved=moved, touched=tuple(i for i in best.touched if i != j))
            g = self.ground
            both = self.wholes.get(tuple(pieces), partial(as_one, g.field, g.photographed, pieces, g.planes, g.shape))
            found = None if both is None else self._refined(alone, k, both, change)
            if both is not None and found is not None:
                yield self._with(alone, k, both, found)

    def _refined(self, best: Settled, k: int, old: Old, change: PoseChange) -> PoseChange | None:
        """An object's pose in the photos of a hypothesis; None if they do not show it there."""
        gone, views = self._without(best, k, old)
        found = refine(Sight(self.ground.field, old, views, gone), change.new_from_old, self.ground.fine, FINER)
        gains = self.ground.believe.gains if gains_enough(self.ground, change) else 0.0  # what slid looks as before
        return found if found is not None and believed(self.ground, old, views, found, gains) else None

    def _elsewhere(self, best: Settled, k: int) -> Iterator[Settled]:
        """With an object at another place at which it was found at any time."""
        return self._at(best, k, [f for f in self.fits[k] if k not in best.moved or not self._is_turned(best, k, f)])

    def _turned(self, best: Settled, k: int) -> Iterator[Settled]:
        """With an object turned where it is, as it was found at any time."""
        if k not in best.moved:  # no longer, as in `_joined`
            return iter(())
        turned = [f for f in self.fits[k] if self._is_turned(best, k, f)]
        return self._at(best, k, [f for f in turned if not at_one_place(best.moved[k], f.change, f.old)])

    def _is_turned(self, best: Settled, k: int, fit: Fit) -> bool:
        """Whether an object that was found is rather the moved one where it is, however it is turned."""
        back = invert(best.moved[k].new_from_old) @ fit.change.new_from_old
        at = torch.from_numpy(fit.old.lattice.centres[fit.old.voxels]).double()
        return best.olds[k].has_most(transform(back, at).numpy())

    def _at(self, best: Settled, k: int, fits: Sequence[Fit]) -> Iterator[Settled]:
        """With an object where it was found, as it was outlined then, or as it is now."""
        now = best.olds[k]
        for fit in fits:
            outlines = [(fit.old, fit.rest)]
            if now is not fit.old:
                outlines.append((now, None))
            for old, rest in outlines:
                change = self._refined(best, k, old, fit.change)
                if change is not None:
                    yield self._with(best, k, old, change, rest)

    def _again(self, best: Settled, k: int) -> Iterator[Settled]:
        """With an object that left where something arrived, as its surface's colours fit or in any rotation: it was
        looked for before all was known that hides it."""
        if k not in best.removed:  # no longer, as in `_joined`
            return
        old = best.olds[k]
        gone, views = self._without(best, k, old)
        found = self.again.get(
            (old, *sorted(gone, key=id), *best.moved.values()),
            lambda: places_among(self.ground, old, gone, views, newcomers(self.ground, views, gone)),
        )
        for fit in found:
            yield self._with(best, k, fit.old, fit.change)
        sight = Sight(self.ground.field, old, views, gone)
        for body in best.arrived:
            for one, rotated in self._rotated(sight, body.places.mean(0)):
                change = self._refined(best, k, one, rotated)  # asked of other photos, and of pixels alone
                if change is not None:
                    yield self._with(best, k, one, change)

    def _rotated(self, sight: Sight, place: Array) -> list[tuple[Old, PoseChange]]:
        """How an object may be rotated at a place; asked once of places that are hardly apart."""
        asked = self.rotated.get((sight.old,), list)
        for near, found in asked:
            if np.linalg.norm(near - place) < _SAME * sight.old.radius:
                return found
        asked.append((place, rotated_at(self.ground, sight, place)))
        return asked[-1][1]

    def _stayed(self, best: Settled, k: int) -> Iterator[Settled]:
        """With an object less that moved, as it was outlined at first, or as all that changed with it; or as if it had
        not changed at all."""
        first = self.first.get(k, best.olds[k])
        for one in (first, self._outlined(best, k, first, None)) if k in best.moved else ():
            if one is not None:
                yield self._less(best, k, one, [k])
        if k in best.moved or k in best.removed:
            yield self._less(best, k, first, [])

    def _less(self, best: Settled, k: int, one: Old, more: list[int]) -> Settled:
        """The hypothesis that object ``k``, outlined as ``one``, did not move; ``more`` than that may have left."""
        inside = [j for j in best.touched if j != k and best.olds[j].within(one)]
        rests = [j for j in inside if more or j not in self.first]
        touched = [*more, *(j for j in best.touched if j not in rests and j != k)]
        others = {j: c for j, c in best.moved.items() if j != k and j in touched}
        return self._hypothesis(dict(enumerate(best.olds)) | {k: one}, touched, others)

    def _asked(self, best: Settled) -> list[tuple[int, Old]]:
        """What may have slid about where it was, by less than its width.

        Those are not looked for before: what seems to have arrived is where they were, and most of them to have stayed.
        """
        came, left = [_box(body) for body in best.arrived], unexplained_at(self.ground, best)
        anywhere = not best.arrived and not best.moved and not best.removed
        olds = {k: old for k, old in enumerate(best.olds) if k not in best.removed}
        some = {
            k: old
            for k, old in olds.items()
            if anywhere or _beside(_box(Body(old.lattice, old.voxels)), came) or (k not in best.moved and left(old, 0))
        }
        asked = [(k, one) for k, old in some.items() for one in old.outlines]
        return asked + self._whole(some)

    def _slides(self, best: Settled, k: int, one: Old) -> Iterator[Settled]:
        """With an object that slid, or all that went along with it."""

        def found() -> Fit | None:
            gone, views = self._without(best, k, one)
            return slid(self.ground, one, gone, views)

        fit = self.slides.get((one,), found)
        if fit is not None and _noticeable(fit.old, fit.change, self.ground.believe.still):
            change = self._refined(best, k, fit.old, fit.change)
            if change is not None:
                yield self._with(best, k, fit.old, change)
                if k not in best.moved:
                    yield from self._with_along(best, k, fit.old, change)

    def _with_along(self, best: Settled, k: int, old: Old, change: PoseChange) -> Iterator[Settled]:
        """With all that went along with an object, also of what seems to have left."""
        along = self._outlined(best, k, old, change, apart=False)
        again = None if along is None else self._refined(best, k, along, change)
        if along is not None and again is not None:
            self.anew[id(along)] = along
            yield self._with(best, k, along, again)

    def _whole(self, pieces: dict[int, Old]) -> list[tuple[int, Old]]:
        """The whole things, where they stand free, each once, by one of its pieces."""
        g, out = self.ground, list[tuple[int, Old]]()
        for k, piece in pieces.items():
            if piece.remembered or any(piece.within(whole) for _, whole in out):
                continue
            whole = self.wholes.get((piece,), partial(standing, g.field, g.photographed, piece, g.planes, g.shape))
            out += [(k, whole)] if whole is not None else []
        return out


def _without_moves_around(best: Settled, one: Old) -> Settled:
    """The hypothesis that what a piece is of did not move, but for the piece."""
    return replace(best, moved={j: c for j, c in best.moved.items() if not one.within(best.olds[j])})


def _cut_up(ground: Ground, changed: Sequence[Changed], old: Old, times: int = 3) -> list[Old]:
    """Halves of an outline, their halves, and so on; those of them that changed."""
    out: list[Old] = []
    for one, _ in halves(old.outlines[-1], ground.shape) if times and not old.remembered else ():
        out += [one] if may_have_changed(ground, changed, one) else []
        out += _cut_up(ground, changed, one, times - 1)
    return out


def _box(body: Body) -> Array:
    """The box around a body, (2, 3) world."""
    at = body.places
    return np.stack([at.min(0), at.max(0)])


def _beside(box: Array, others: Sequence[Array]) -> bool:
    """Whether a box is no further from one of the others than either is long, in each direction."""
    apart = [
        np.maximum(box[0] - o[1], o[0] - box[1]).max() - max((b[1] - b[0]).max() for b in (box, o)) for o in others
    ]
    return min(apart, default=math.inf) <= 0


def _completed(
    ground: Ground,
    known: dict[int, Old],
    touched: Sequence[int],
    changed: Sequence[Changed],
    moved: dict[int, PoseChange],
) -> Settled:
    """The hypothesis that some of the ``known`` objects moved, with those of the ``touched`` that then left, and what
    arrived. What moved by less than can be seen stayed, and hides what is behind it."""
    stayed = [k for k, c in moved.items() if not _noticeable(known[k], c, ground.believe.still)]
    moved = {k: c for k, c in moved.items() if k not in stayed}
    touched = [k for k in touched if k not in stayed]
    olds = [known[k] for k in sorted(known)]
    placed = [(olds[k], c) for k, c in moved.items()]
    views = without(ground, changed, [olds[k] for k in touched], placed)
    shares = {k: left_by(ground, views, olds[k]) for k in touched if k not in moved}
    removed = {k: share for k, share in shares.items() if share is not None}
    kept = [k for k in touched if k in moved or k in removed]
    if len(kept) < len(touched):  # what never left hides what is behind it after all
        views = without(ground, changed, [olds[k] for k in kept], placed)
    gone = [olds[k] for k in kept]
    places = places_of(gone, [(olds[k], c) for k, c in moved.items()])
    parts = remarkable(ground, newcomers(ground, views, gone), views, places)
    arrived = [consistent(body, [(v.view, v.open) for v in views]) for body in parts]
    # what its colours leave of it must be as believable as the whole was
    arrived = [exactly(ground, body, views) for body in arrived if fresh(views, body) >= ground.believe.arrived]
    return Settled(moved, removed, tuple(arrived), tuple(views), tuple(olds), tuple(touched))


def is_piece(old: Old, others: Sequence[Old]) -> bool:
    """Whether an object is a mere piece of a larger one."""
    return any(old.volume < o.volume and old.within(o) for o in others)


def _noticeable(old: Old, change: PoseChange, still: float) -> bool:
    """Whether any part of the object moved by more than ``still`` pixels."""
    points = torch.from_numpy(old.cloud.points).double()
    shift = (transform(change.new_from_old, points) - points).norm(dim=-1)
    return bool(shift.max() > still * change.pixel)
