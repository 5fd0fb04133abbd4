"""What a rehearsal tells: which changes were found as what they are, and how exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import torch
from torch import Tensor

from refield.scene.change import ObjectChange, SceneChange
from refield.scene.pose import angle_between, transform


@dataclass(frozen=True)
class ObjectScore:
    """One object that changed, and what was found of it."""

    kind: str
    found: str | None
    """the kind that was told; None: it was not found"""
    shift_error: float | None = None
    """of a moved object found as such: the distance between where its middle was put and where it is, world units"""
    turn_error_deg: float | None = None


@dataclass(frozen=True)
class ChangeScore:
    """All objects of a rehearsal."""

    objects: tuple[ObjectScore, ...]
    extra: tuple[str, ...]
    """kinds of what was found though nothing of the kind is there"""

    @property
    def right(self) -> int:
        """objects whose kind was told rightly"""
        return sum(o.found == o.kind for o in self.objects)

    @property
    def all_right(self) -> bool:
        return self.right == len(self.objects) and not self.extra

    def to_dict(self) -> dict[str, Any]:
        return {"objects": [asdict(o) for o in self.objects], "extra": list(self.extra), "all_right": self.all_right}


def score_change(found: SceneChange, truth: SceneChange) -> ChangeScore:
    """Each true change beside a found one that lies within the object's own size of it, the nearest pairs first."""
    pairs = _pairs(found.objects, truth.objects)
    scores = [
        _scored(true, found.objects[pairs[t]]) if t in pairs else ObjectScore(true.kind, None)
        for t, true in enumerate(truth.objects)
    ]
    return ChangeScore(tuple(scores), tuple(o.kind for f, o in enumerate(found.objects) if f not in pairs.values()))


def _pairs(found: Sequence[ObjectChange], truth: Sequence[ObjectChange]) -> dict[int, int]:
    """True object → found one."""
    sizes = [float((box[1] - box[0]).norm()) for box in (true.grid.tight_aabb() for true in truth)]
    near = sorted((_apart(a, b), t, f) for (t, a), (f, b) in product(enumerate(truth), enumerate(found)))
    pairs: dict[int, int] = {}
    for distance, t, f in near:
        if distance < sizes[t] and t not in pairs and f not in pairs.values():
            pairs[t] = f
    return pairs


def _apart(true: ObjectChange, other: ObjectChange) -> float:
    """Distance between the places at which two changes show: old from old or new from new, the smaller."""
    pairs = [(_old(true), _old(other)), (_new(true), _new(other))]
    return min((float((a - b).norm()) for a, b in pairs if a is not None and b is not None), default=float("inf"))


def _old(o: ObjectChange) -> Tensor | None:
    return None if o.kind == "added" else _middle(o)


def _new(o: ObjectChange) -> Tensor | None:
    if o.kind == "removed":
        return None
    return _middle(o) if o.new_from_old is None else transform(o.new_from_old, _middle(o))


def _middle(o: ObjectChange) -> Tensor:
    return o.grid.tight_aabb().double().mean(0)


def _scored(true: ObjectChange, match: ObjectChange) -> ObjectScore:
    a, b = match.new_from_old, true.new_from_old
    if a is None or b is None:
        return ObjectScore(true.kind, match.kind)
    middle = _middle(true)
    shift = float(torch.linalg.vector_norm(transform(a, middle) - transform(b, middle)))
    return ObjectScore(true.kind, match.kind, shift, float(angle_between(a, b)))
