"""Found objects beside true ones: which is which."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from refield.scene.change import ObjectChange, OccupancyGrid

_PROBES = 60_000  # points that an IoU is measured with: to a part in a hundred of an object


@dataclass(frozen=True)
class Matched:
    """Which found object is which true one."""

    pairs: dict[int, int]
    """true → found"""
    pieces: tuple[int, ...]
    """found objects where a true one is or was that another one is matched with"""
    false: tuple[int, ...]
    """found objects where nothing changed"""

    def missed(self, count: int) -> int:
        """Of so many true objects."""
        return count - len(self.pairs)


def matched(found: Sequence[ObjectChange], true: Sequence[ObjectChange]) -> Matched:
    """The nearest first: by the IoU of where they are or were, and where none overlaps by their centres' distance."""
    near = {(t, f): closeness(a, b) for (t, a), (f, b) in product(enumerate(true), enumerate(found))}
    pairs: dict[int, int] = {}
    for (t, f), value in sorted(near.items(), key=lambda item: -item[1]):
        if value > 0 and t not in pairs and f not in pairs.values():
            pairs[t] = f
    rest = [f for f in range(len(found)) if f not in pairs.values()]
    pieces = [f for f in rest if any(near[t, f] > 0 for t in range(len(true)))]
    return Matched(pairs, tuple(pieces), tuple(f for f in rest if f not in pieces))


def closeness(a: ObjectChange, b: ObjectChange) -> float:
    """How much two objects are one: 0 not at all, 1 to 2 where they overlap, below where they are only beside.

    Places are compared with like places, where it was and where it is, so that one that moved and was taken for one
    that left is found at the place that it left.
    """
    sides = zip((_old(a), a.grid_now), (_old(b), b.grid_now))
    return max((_near(x, y) for x, y in sides if x is not None and y is not None), default=0.0)


def _old(o: ObjectChange) -> OccupancyGrid | None:
    return None if o.kind == "added" else o.grid


def _near(a: OccupancyGrid, b: OccupancyGrid) -> float:
    boxes = a.tight_aabb(), b.tight_aabb()
    away = float((boxes[0].mean(0) - boxes[1].mean(0)).norm())
    reach = sum(float((box[1] - box[0]).norm()) for box in boxes) / 4  # the mean of half their diagonals
    if away > 2 * reach:
        return 0.0
    iou = overlap(a, boxes[1], b.contains)
    return 1 + iou if iou > 0 else max(0.0, 1 - away / reach)


def overlap(grid: OccupancyGrid, box: Tensor, inside: Callable[[Tensor], Tensor]) -> float:
    """IoU of what a grid holds and another shape: ``inside`` says of points (N, 3) whether they are in it, and its
    ``box`` (2, 3) holds all of it."""
    lo, hi = torch.minimum(grid.tight_aabb()[0], box[0]), torch.maximum(grid.tight_aabb()[1], box[1])
    x = lo + (hi - lo) * torch.rand(_PROBES, 3, generator=torch.Generator().manual_seed(0))
    a, b = grid.contains(x), inside(x)
    return float((a & b).sum() / (a | b).sum().clamp_min(1))
