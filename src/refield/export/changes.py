"""What changed, for programs that keep track of things.

``changes.json`` is for a robot's scene graph; ``changes.glb`` says the same by nodes, one where each object was and one
where it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from refield.export.gltf import Glb
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.files import write_bytes, write_json
from refield.scene.pose import rigid
from refield.scene.world import World

_BEFORE, _NOW = (0.9, 0.25, 0.05, 0.35), (0.05, 0.6, 0.2, 0.35)  # linear, with opacity


@dataclass(frozen=True)
class Box:
    """An oriented box around an object, upright where the object was told of."""

    world_from_box: Tensor
    """(4, 4) float64: from axes along its sides, z up, with the origin in its middle"""
    size: tuple[float, float, float]
    """along its own axes, world units"""


def box_of(change: ObjectChange, world: World) -> Box:
    """The smallest upright box around the occupied part of an object's grid."""
    points = change.grid.occupied().double()
    points = points if len(points) else change.grid.aabb.double()
    level = _level_axes(world)
    local = points @ level
    middle, sides, turn = cv2.minAreaRect(np.ascontiguousarray(local[:, :2].numpy(), np.float32))
    angle = torch.deg2rad(torch.tensor(turn, dtype=torch.float64))
    cosine, sine = float(angle.cos()), float(angle.sin())
    spin = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    low, high = float(local[:, 2].min()), float(local[:, 2].max())
    at = torch.tensor([*middle, (low + high) / 2], dtype=torch.float64)
    cell = float(change.grid.cell.mean())  # a node stands for half a cell on each side of it
    size = (sides[0] + cell, sides[1] + cell, high - low + cell)
    return Box(rigid(level @ spin, level @ at), size)


def _level_axes(world: World) -> Tensor:
    """(3, 3) float64: columns are two level axes and up, right-handed; the world's own x and y where its z is up."""
    up = torch.tensor(world.up, dtype=torch.float64)
    up = up / up.norm()
    x = torch.eye(3, dtype=torch.float64)[int(up.abs()[:2].argmin())]
    x = x - (x @ up) * up
    x = x / x.norm()
    return torch.stack([x, torch.linalg.cross(up, x), up], -1)


def told(change: SceneChange, world: World, visit: int) -> dict[str, Any]:
    """All of a visit's change for JSON; poses are 4x4 rows of numbers, lengths in the world's units."""
    return {
        "format": "refield changes",
        "version": 1,
        "visit": visit,
        "world": {
            "up": list(world.up),
            "unit": "the capture's own",
            "metres_per_unit": world.metres_per_unit,
            "size": world.size,
        },
        "why": change.why,
        "objects": [_object(o, world, visit, i) for i, o in enumerate(change.objects, start=1)],
    }


def name_of(visit: int, index: int) -> str:
    """What an object, numbered from 1 in its visit, is called in every file."""
    return f"visit_{visit}_object_{index}"


def _object(o: ObjectChange, world: World, visit: int, index: int) -> dict[str, Any]:
    box = box_of(o, world)
    old, new = _places(o, box)
    return {
        "id": name_of(visit, index),
        "kind": o.kind,
        "confidence": o.confidence,
        "note": o.note,
        "box_size": list(box.size),
        "world_from_box_old": _rows(old),
        "world_from_box_new": _rows(new),
        "new_from_old": _rows(o.new_from_old),
        "old_from_new": None if o.new_from_old is None else _rows(o.old_from_new),
        "covariance": _rows(o.covariance),
        "centre": o.centre.tolist(),
        "shift": _rows(o.shift),
        "turned_deg": o.turn_deg,
    }


def _places(o: ObjectChange, box: Box) -> tuple[Tensor | None, Tensor | None]:
    """Where an object's box was and where it is; None where it was, or is, not there."""
    if o.kind == "moved" and o.new_from_old is not None:
        return box.world_from_box, o.new_from_old.double() @ box.world_from_box
    return (box.world_from_box, None) if o.kind == "removed" else (None, box.world_from_box)


def _rows(values: Tensor | None) -> Any:
    return None if values is None else values.double().tolist()


def write_changes(folder: Path, change: SceneChange, world: World, visit: int) -> list[Path]:
    """Both files."""
    data = told(change, world, visit)
    write_json(folder / "changes.json", data)
    file = Glb(world, {"visit": visit})
    for o, facts in zip(change.objects, data["objects"]):
        box = box_of(o, world)
        for pose, word, colour in zip(_places(o, box), ("old", "new"), (_BEFORE, _NOW)):
            if pose is not None:
                shape = file.add_box(box.size, colour)
                file.add_node(f"{facts['id']}_{word}", pose, mesh=shape, extras={**facts, "place": word})
    write_bytes(folder / "changes.glb", file.to_bytes())
    return [folder / "changes.json", folder / "changes.glb"]
