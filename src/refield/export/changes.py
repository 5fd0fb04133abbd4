"""What changed, for programs that keep track of things.

``changes.json`` is for a robot's scene graph; ``changes.glb`` says the same by nodes, one where each object was and one
where it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refield.export.gltf import Glb
from refield.scene.boxes import UprightBox, upright_box
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.files import write_bytes, write_json
from refield.scene.world import World

_BEFORE, _NOW = (0.9, 0.25, 0.05, 0.35), (0.05, 0.6, 0.2, 0.35)  # linear, with opacity


def box_of(change: ObjectChange, world: World) -> UprightBox:
    """The upright box around an object, where it was told of."""
    up = torch.tensor(world.up, dtype=torch.float64)
    return upright_box(change.grid, up / up.norm())


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
        "alternatives": [_rows(pose) for pose in o.alternatives],
        "centre": o.centre.tolist(),
        "shift": _rows(o.shift),
        "turned_deg": o.turn_deg,
    }


def _places(o: ObjectChange, box: UprightBox) -> tuple[Tensor | None, Tensor | None]:
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
