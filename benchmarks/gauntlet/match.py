"""True objects, and how far off found ones are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refield.evaluate import pose_error
from refield.scene.change import ObjectChange, OccupancyGrid
from refield.scene.change_files import NAME, load_change
from refield.scene.pose import transform

_BOX = 32  # nodes a side of the grid of an object of which only a box is known

Row = dict[str, Any]


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
