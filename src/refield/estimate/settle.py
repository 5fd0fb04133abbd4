"""What became of everything that changed: the hypothesis by which the new photos are explained best.

Begun with the objects placed one by one, then changed by one exchange at a time while that leaves less unexplained.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np
import torch

from refield.estimate.arrive import arrivals, fresh, newcomers, remarkable, shadow_of
from refield.estimate.associate import may_have_changed, place_all, places_of, without
from refield.estimate.consist import consistent
from refield.estimate.detect import Changed
from refield.estimate.fit import left_by, slid
from refield.estimate.ground import Ground
from refield.estimate.lattice import Lattice, Voxels
from refield.estimate.likelihood import Settled, unexplained_by
from refield.estimate.look import Array
from refield.estimate.objects import Old
from refield.estimate.outline import standing
from refield.estimate.past import changed_share
from refield.estimate.pose_change import PoseChange
from refield.scene.pose import transform
from refield.vision import pixels


def settle(ground: Ground, olds: Sequence[Old], changed: Sequence[Changed]) -> Settled:
    """Find each old object's new place or that it left, and what else arrived."""
    touched = {k: old for k, old in enumerate(olds) if may_have_changed(ground, changed, old)}
    moved, placed = place_all(ground, touched, changed, count(len(olds)))
    best = _completed(ground, dict(enumerate(olds)) | placed, list(placed), changed, moved)
    least, tried = unexplained_by(ground, best), _Wholes(ground)
    while True:
        others = [(unexplained_by(ground, other), other) for other in _exchanges(ground, olds, changed, best, tried)]
        left, other = min(others, key=lambda o: o[0], default=(least, best))
        if not left < least - 1:  # pixel
            break
        best, least = other, left
    still = ground.believe.still
    return replace(best, moved={k: c for k, c in best.moved.items() if _noticeable(best.olds[k], c, still)})


@dataclass(frozen=True)
class _Wholes:
    """The things that outlines are pieces of, looked for once."""

    ground: Ground
    known: dict[int, tuple[Old, Old | None]] = field(default_factory=dict)
    """by the piece's identity, which it keeps for as long as it is here"""

    def of(self, pieces: dict[int, Old]) -> list[tuple[int, Old]]:
        """The whole things, where they stand free, each once, by one of its pieces."""
        out: list[tuple[int, Old]] = []
        for k, piece in pieces.items():
            if piece.remembered or any(piece.within(whole) for _, whole in out):
                continue
            if id(piece) not in self.known:
                g = self.ground
                self.known[id(piece)] = piece, standing(g.field, g.photographed, piece, g.planes, g.shape)
            whole = self.known[id(piece)][1]
            out += [(k, whole)] if whole is not None else []
        return out


def _exchanges(
    ground: Ground, first: Sequence[Old], changed: Sequence[Changed], best: Settled, wholes: _Wholes
) -> Iterator[Settled]:
    """The hypothesis with one object less that moved, as it was outlined at ``first``, or with one that slid."""
    olds = dict(enumerate(best.olds))
    for k in best.moved:
        whole = {k: first[k]} if k < len(first) else {}
        rests = [j for j in best.touched if j >= len(first) and j != k and whole and olds[j].within(first[k])]
        touched = [j for j in best.touched if j not in rests]
        others = {j: c for j, c in best.moved.items() if j != k and j in touched}
        yield _completed(ground, olds | whole, touched, changed, others)
    if best.arrived or not (best.moved or best.removed):
        yield from _slides(ground, changed, best, wholes)


def _slides(ground: Ground, changed: Sequence[Changed], best: Settled, wholes: _Wholes) -> Iterator[Settled]:
    """The hypothesis with one object that slid about where it was, by less than its width.

    Those are not looked for before: what seems to have arrived is where they were, and most of them to have stayed.
    """
    olds = dict(enumerate(best.olds))
    came = [_box(ground.hull.lattice, part) for part in best.arrived]
    some = {k: old for k, old in olds.items() if k not in best.removed and _beside(_box(old.lattice, old.voxels), came)}
    asked = [(k, one) for k, old in some.items() for one in (old, old.instead) if one is not None]
    for k, one in [*asked, *wholes.of(some)]:
        apart = [j for j in best.touched if j != k and not olds[j].within(one)]
        others = {j: c for j, c in best.moved.items() if j in apart}
        gone = [one, *(olds[j] for j in apart if j in best.moved or j in best.removed)]
        views = without(ground, changed, gone, [(olds[j], c) for j, c in others.items()])
        fit = slid(ground, one, gone, views)
        if fit is not None and _noticeable(fit.old, fit.change, ground.believe.still):
            yield _completed(ground, olds | {k: fit.old}, [k, *apart], changed, others | {k: fit.change})


def _box(lattice: Lattice, voxels: Voxels) -> Array:
    """The box around some voxels, (2, 3) world."""
    at = lattice.centres[voxels]
    return np.stack([at.min(0), at.max(0)])


def _beside(box: Array, others: Sequence[Array]) -> bool:
    """Whether a box is no further from one of the others than either is long, in each direction; true of none."""
    apart = [
        np.maximum(box[0] - o[1], o[0] - box[1]).max() - max((b[1] - b[0]).max() for b in (box, o)) for o in others
    ]
    return not apart or min(apart) <= 0


def _completed(
    ground: Ground,
    known: dict[int, Old],
    touched: Sequence[int],
    changed: Sequence[Changed],
    moved: dict[int, PoseChange],
) -> Settled:
    """The hypothesis that some of the ``known`` objects moved, with those of the ``touched`` that then left, and what
    arrived."""
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
    arrived = remarkable(ground, newcomers(ground, arrivals(ground, views, gone), views), views, places)
    arrived = [consistent(ground.hull.lattice, p, [(v.view, v.open) for v in views]) for p in arrived]
    # what its colours leave of it must be as believable as the whole was
    arrived = [p for p in arrived if fresh(views, ground.hull.lattice, p) >= ground.believe.arrived]
    return Settled(moved, removed, tuple(arrived), tuple(views), tuple(olds), tuple(touched))


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


def looks_gone(ground: Ground, changed: Sequence[Changed], old: Old) -> bool:
    """Whether an object's pixels changed and show what was behind it."""
    if changed_share(changed, old) < ground.believe.touched:
        return False
    return left_by(ground, without(ground, changed, [old]), old) is not None


def _noticeable(old: Old, change: PoseChange, still: float) -> bool:
    """Whether any part of the object moved by more than ``still`` pixels."""
    points = torch.from_numpy(old.cloud.points).double()
    shift = (transform(change.new_from_old, points) - points).norm(dim=-1)
    return bool(shift.max() > still * change.pixel)
