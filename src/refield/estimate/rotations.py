"""The rotation of an object at a place, out of all there are: of one that was found and is explained less than the
field shows, and of one that left where something arrived.

Registration compares the colours of surface points, which of a thing some pixels wide tell the place and hardly the
rotation. What its composite explains of the photos rises towards the true one on all sides, yet descent follows that
from some 10 degrees alone; so rotations are compared by that as they are, and the best is climbed from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from refield.estimate.explain import FEWEST, explained
from refield.estimate.fit import SHIFTS, believed, detail_for, finest, finished, shown_right
from refield.estimate.ground import Ground
from refield.estimate.layers import Layers, Sight, layers_at
from refield.estimate.look import Array
from refield.estimate.objects import Old
from refield.estimate.past import Past
from refield.estimate.pose_change import FINER, SIDE, PoseChange, refine, shared_out
from refield.estimate.register import super_fibonacci
from refield.scene.pose import rigid, transform

_LIKELY = 0.1  # of all rotations, by the object's surface points, are compared by the field as well: three times as
# many as it took to hold the best four in six objects of three worlds (docs/results.md, "Rotations by surface points")


def may_be_turned(ground: Ground, old: Old, past: Sequence[Past], change: PoseChange) -> bool:
    """Whether the photos show less of an object at its pose than old photos show of what the field has of it, by more
    than refinement shifts that. At later visits old photos show what the field has of everything: it is not asked."""
    return bool(ground.photographed) and change.explained < shown_right(ground, old, past) - SHIFTS


def best_rotations(ground: Ground, sight: Sight, change: PoseChange) -> list[tuple[Old, PoseChange]]:
    """The pose of an object, and the few rotations about its place that explain most and are believed, all refined
    alike to the end, each with the object without what cannot be there; the pose itself comes first. None if that
    explains enough, once it is refined so."""
    as_it_is = finished(ground, sight, change)
    if as_it_is is None or not may_be_turned(ground, sight.old, sight.past, as_it_is[1]):
        return []
    found = finest(ground, sight, _starts(ground, sight, change.new_from_old))
    if found:
        old, best = max(found, key=lambda one: one[1].explained)
        found.append((old, _climbed(ground, sight, old, best.new_from_old) or best))
    return [as_it_is, *(one for one in found if believed(ground, one[0], sight.past, one[1]))]


def rotated_at(ground: Ground, sight: Sight, place: Array) -> list[tuple[Old, PoseChange]]:
    """The few rotations of an object with its middle at a place (3,) that explain most, refined to the end; whether it
    is there is not said."""
    shift = torch.from_numpy(place - sight.old.centre).double()
    return finest(ground, sight, _starts(ground, sight, rigid(torch.eye(3, dtype=torch.float64), shift)))


def _starts(ground: Ground, sight: Sight, pose: Tensor) -> list[Tensor]:
    """The rotations about the object's middle that explain most as they are, as poses (4, 4)."""
    centre = torch.from_numpy(sight.old.centre).double()
    place = transform(pose, centre)
    poses = [rigid(r, place - r @ centre) for r in torch.from_numpy(super_fibonacci(ground.search.rotations))]
    few = ground.believe.refined
    by_field = layers_at(sight, pose, shared_out(ground.fine.rays[0], len(sight.past)), turning=True)
    if not by_field.crops:  # no photo shows the place
        return []
    by_points = replace(by_field, by_points=True)
    for ready, kept in ((by_points, max(few, round(_LIKELY * len(poses)))), (by_field, few)):
        parts = [_part(ready, p) for p in poses]
        if ready is by_points and not any(parts):  # so few, or so far apart, that they tell nothing
            continue
        poses = [poses[k] for k in np.argsort(parts, kind="stable")[::-1][:kept]]
    return poses


def _climbed(ground: Ground, sight: Sight, old: Old, pose: Tensor) -> PoseChange | None:
    """A pose (4, 4) rotated on about each axis, by half of how far apart the rotations are, then a quarter, then an
    eighth, where that explains more; and refined again."""
    detail = detail_for(ground, sight.old, sight.past, pose)
    sight = replace(sight, old=old, detail=detail)
    ready = layers_at(sight, pose, shared_out(ground.fine.rays[0], len(sight.past)), turning=True)
    apart = (8 * math.pi**2 / ground.search.rotations) ** (1 / 3)  # all of SO(3) holds 8 pi^2, in radians
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    twists = torch.cat([torch.zeros_like(axes), axes], -1)  # no shift
    most = _part(ready, pose)
    for angle in apart * np.array([0.5, 0.25, 0.125]):
        for twist in twists * angle:
            other = ready.moved(pose, twist)
            part = _part(ready, other)
            if part > most:
                pose, most = other, part
    return refine(sight, pose, ground.fine, FINER)


def _part(ready: Layers, pose: Tensor) -> float:
    """The part of the object's pixels that show it at a pose; none if too few show a side that is known."""
    told = explained(ready.compared(pose), SIDE * ready.apparent)
    return told.part if told.pixels >= FEWEST else 0.0
