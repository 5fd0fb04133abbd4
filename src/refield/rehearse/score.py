"""What a rehearsal tells: which changes were found as what they are, and how exactly."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch

from refield.rehearse.matching import matched
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
    """Each true change beside the found one that is the same (`refield.rehearse.matching`)."""
    match = matched(found.objects, truth.objects)
    scores = [
        _scored(true, found.objects[match.pairs[t]]) if t in match.pairs else ObjectScore(true.kind, None)
        for t, true in enumerate(truth.objects)
    ]
    extra = sorted(match.pieces + match.false)
    return ChangeScore(tuple(scores), tuple(found.objects[f].kind for f in extra))


def _scored(true: ObjectChange, match: ObjectChange) -> ObjectScore:
    a, b = match.new_from_old, true.new_from_old
    if a is None or b is None:
        return ObjectScore(true.kind, match.kind)
    middle = true.grid.tight_aabb().double().mean(0)
    shift = float(torch.linalg.vector_norm(transform(a, middle) - transform(b, middle)))
    return ObjectScore(true.kind, match.kind, shift, float(angle_between(a, b)))
