"""An estimated change beside the true one: which objects were found, as what, where, and in what shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from refield.evaluate import pose_error
from refield.rehearse.matching import overlap
from refield.scene.change import ObjectChange, SceneChange
from refield.synthetic.worlds import Item, TrueChange, World

_FOUND = 0.25  # IoU of two grids from which on they are one object
_SYMMETRIC = ("Sphere",)


@dataclass(frozen=True)
class Found:
    """One true object, and what was said of it."""

    name: str
    kind: str
    said: str | None
    """the kind that was found; None if the object was not"""
    iou: float
    """of the occupancy grids"""
    distance: float | None = None
    """of the pose change at the object's centre, world units; None unless it moved and was found to"""
    angle: float | None = None
    """degrees"""
    flagged: bool = False
    """a turn that the photos do not show was said to be unknown"""
    symmetric: bool = False

    @property
    def right(self) -> bool:
        return self.said == self.kind


@dataclass(frozen=True)
class Score:
    """One estimate."""

    objects: tuple[Found, ...]
    false_alarms: int
    """objects said to have changed that did not"""
    mask_in: float | None
    """IoU of the new photos' masks, pooled over photos; None where both are empty"""
    mask_out: float | None


def score(change: SceneChange, world: World, truth: SceneChange) -> Score:
    """Pair what was found with what is true, by place and shape.

    ``truth``: the same world's true masks on the photos that were used.
    """
    true = world.changes
    shared = np.array([[_iou(found, _item_of(t)) for t in true] for found in change.objects])
    pairs: dict[int, int] = {}
    if shared.size:
        pairs = {int(t): int(f) for f, t in zip(*linear_sum_assignment(-shared)) if shared[f, t] > _FOUND}
    objects = tuple(
        _found(t, change.objects[pairs[k]] if k in pairs else None, shared[pairs[k], k] if k in pairs else 0.0)
        for k, t in enumerate(true)
    )
    alarms = len(change.objects) - len(pairs)
    masks = [
        pooled_iou(a, b) if a and b else None
        for a, b in ((change.masks_in, truth.masks_in), (change.masks_out, truth.masks_out))
    ]
    return Score(objects, alarms, masks[0], masks[1])


def _item_of(change: TrueChange) -> Item:
    item = change.old or change.new
    assert item is not None  # a change has one side at least
    return item


def _found(true: TrueChange, found: ObjectChange | None, iou: float) -> Found:
    item = _item_of(true)
    base = Found(item.name, true.kind, found.kind if found else None, float(iou), symmetric=_is_symmetric(item))
    if found is None or found.new_from_old is None or true.new_from_old is None:
        return base
    distance, angle = pose_error(found.new_from_old, true.new_from_old, item.world_from_item[:3, 3])
    return Found(
        base.name, base.kind, base.said, base.iou, distance, angle, "do not show its turn" in found.note, base.symmetric
    )


def _is_symmetric(item: Item) -> bool:
    return type(item.solid).__name__ in _SYMMETRIC


def _iou(found: ObjectChange, item: Item) -> float:
    return overlap(found.grid, item.box().float(), lambda x: item.distance(x.double()) < 0)


def pooled_iou(a: Sequence[Tensor], b: Sequence[Tensor]) -> float | None:
    """Of masks (H, W) bool that go together, over all their pixels; None where both are empty."""
    both = sum(int((x & y).sum()) for x, y in zip(a, b))
    any_ = sum(int((x | y).sum()) for x, y in zip(a, b))
    return both / any_ if any_ else None
