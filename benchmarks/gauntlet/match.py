"""Found objects beside true ones: which is which, as what, and how far off."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import torch
from change_score import overlap
from torch import Tensor

from refield.evaluate import pose_error
from refield.scene.change import ObjectChange, OccupancyGrid
from refield.scene.change_files import NAME, load_change
from refield.scene.pose import transform

_BOX = 32  # nodes a side of the grid of an object of which only a box is known

Row = dict[str, Any]


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


def pose_row(found: ObjectChange, true: ObjectChange, cameras: Tensor) -> Row:
    """How far a moved object's pose is off, absolute and as a part of the distance from ``cameras`` (N, 3) to it."""
    if found.new_from_old is None or true.new_from_old is None:
        return {}
    centre = true.grid.tight_aabb().mean(0).double()
    off, degrees = pose_error(found.new_from_old, true.new_from_old, centre)
    away = float((cameras - transform(true.new_from_old.double(), centre)).norm(dim=-1).mean())
    return {"off": off, "off, % of distance": 100 * off / away, "off, °": degrees}


def true_objects(data: Path) -> tuple[ObjectChange, ...] | None:
    """What really changed; None if nothing is told of it."""
    if (data / "truth" / NAME).is_file():
        return load_change(data / "truth", masks=False).objects
    if (data / "truth.json").is_file():
        return tuple(_boxed(record) for record in json.loads((data / "truth.json").read_text(encoding="utf-8")))
    return None


def _boxed(record: dict[str, Any]) -> ObjectChange:
    """An object of which kind, pose change and an upright box are told."""
    centre, half = (torch.tensor(record[name], dtype=torch.float32) for name in ("centre", "half_size"))
    middle = torch.ones(_BOX, _BOX, _BOX)
    aabb = torch.stack([centre - half, centre + half])
    motion = torch.tensor(record["T"], dtype=torch.float64) if record["kind"] == "moved" else None
    return ObjectChange(record["kind"], OccupancyGrid(aabb, middle), motion)
