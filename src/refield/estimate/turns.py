"""How an object is turned where it was found, all turns asked: of one that is explained less than its field is right.

Registration compares the colours of surface points, which of a thing some pixels wide tell the place and hardly the
turn. What its composite explains of the photos rises towards the true turn on all sides, but descent follows that from
some 10 degrees alone: turns are asked as closely, and the best is turned on by hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from refield.estimate.explain import explained
from refield.estimate.fit import SHIFTS, detail_for, finest, shown_right
from refield.estimate.ground import Ground
from refield.estimate.layers import Layers, Sight, layers_at
from refield.estimate.objects import Old
from refield.estimate.past import Past
from refield.estimate.pose_change import FINER, SIDE, PoseChange, refine, shared_out
from refield.estimate.register import super_fibonacci
from refield.scene.pose import rigid, transform

_GLANCE = 1_500  # rays over all new photos in which all turns are looked at
_LIKELY = 0.1  # of them are looked at again
_ON = 12.0, 6.0, 3.0  # degrees by which the best is turned on: half of how far apart the turns are, then halved


def may_be_turned(ground: Ground, old: Old, past: Sequence[Past], change: PoseChange) -> bool:
    """Whether the photos show less of an object at its pose than old photos show of what the field has of it."""
    return change.explained < shown_right(ground, old, past) - SHIFTS


def turned(ground: Ground, sight: Sight, change: PoseChange) -> list[tuple[Old, PoseChange]]:
    """The few turns of an object, about the place at which a pose puts it, that explain most, refined to the end; each
    with the object without what cannot be there. The best comes first."""
    found = finest(ground, sight, _starts(ground, sight, change.new_from_old))
    found.sort(key=lambda one: -one[1].explained)
    on = _turned_on(ground, sight, *found[0]) if found else None
    return found if on is None or on.explained <= found[0][1].explained else [(found[0][0], on), *found[1:]]


def _starts(ground: Ground, sight: Sight, pose: Tensor) -> list[Tensor]:
    """The turns about the object's middle that explain most as they are, as poses (4, 4)."""
    centre = torch.from_numpy(sight.old.centre).double()
    place = transform(pose, centre)
    poses = [rigid(r, place - r @ centre) for r in torch.from_numpy(super_fibonacci(ground.search.rotations))]
    for rays, kept in ((_GLANCE, round(_LIKELY * len(poses))), (ground.fine.rays[0], ground.believe.refined)):
        ready = layers_at(sight, pose, shared_out(rays, len(sight.past)))
        poses = sorted(poses, key=lambda p: -_told(ready, p))[:kept]
    return poses


def _turned_on(ground: Ground, sight: Sight, old: Old, change: PoseChange) -> PoseChange | None:
    """A pose turned on about each axis by less and less, while that explains more, and refined again."""
    pose = change.new_from_old
    sight = replace(sight, old=old, detail=detail_for(ground, sight.old, sight.past, pose))
    ready = layers_at(sight, pose, shared_out(ground.fine.rays[0], len(sight.past)))
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    twists = torch.cat([torch.zeros_like(axes), axes], -1)  # no shift
    most = _told(ready, pose)
    for degrees in _ON:
        for twist in twists * math.radians(degrees):
            other = ready.moved(pose, twist)
            told = _told(ready, other)
            if told > most:
                pose, most = other, told
    return refine(sight, pose, ground.fine, FINER)


def _told(ready: Layers, pose: Tensor) -> float:
    """The part of the object's pixels that show it at a pose."""
    return explained(ready.compared(pose), SIDE * ready.apparent).part
