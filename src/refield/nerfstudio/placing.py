"""Where a run's own axes lie in the world of its photos, and what it found out about their poses.

nerfstudio turns, shifts and scales all poses before it trains (``dataparser_transforms.json``), from the axes that the
photos had before ns-process-data turned them (``applied_transform``). The world here is that of the transforms.json.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refield.nerfstudio.run import TRANSFORM, Run
from refield.scene.capture import Capture, Frame
from refield.scene.errors import InputError
from refield.scene.files import read_json
from refield.scene.pose import exp, nearest_rotation, rigid

_LEGACY = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]  # applied before ns-process-data noted it
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Placing:
    """run = turn @ (world - centre) / radius"""

    centre: Tensor
    """(3,) float64, the run's origin in the world"""
    turn: Tensor
    """(3, 3) float64, the rotation from world to run axes"""
    radius: float
    """a run unit in world units"""

    def adjusted(self, world_from_cam: Tensor, twist: Tensor, mode: str) -> Tensor:
        """A pose (4, 4) float64 as the run trained with it: turned and shifted by its camera optimiser, (6,)."""
        motion = exp(twist) if mode == "SE3" else exp(torch.cat([torch.zeros_like(twist[:3]), twist[3:]]))
        shift = motion[:3, 3] if mode == "SE3" else twist[:3]
        turned = self.turn.T @ motion[:3, :3] @ self.turn @ world_from_cam[:3, :3]
        return rigid(nearest_rotation(turned), world_from_cam[:3, 3] + self.radius * self.turn.T @ shift)


def placing_of(run: Run, transforms: Path) -> Placing:
    """How the run's axes lie in the world of a transforms.json.

    Raises:
        InputError: dataparser_transforms.json is missing or no similarity.
    """
    path = run.folder / TRANSFORM
    told, poses = read_json(path), read_json(transforms)
    applied, applied_scale = poses.get("applied_transform"), poses.get("applied_scale", 1.0)
    if applied is None and (transforms.parent / "colmap" / "sparse" / "0").exists():
        applied = _LEGACY
    run_from_given = _matrix(told.get("transform"), f"{path}: transform")
    given_from_file = torch.eye(4).double() if applied is None else _matrix(applied, f"{transforms}: applied_transform")
    scale = _number(told.get("scale"), f"{path}: scale") / _number(applied_scale, f"{transforms}: applied_scale")
    run_from_world = run_from_given @ torch.linalg.inv(given_from_file)
    turn = run_from_world[:3, :3]
    if float((turn @ turn.T - torch.eye(3)).abs().max()) > _TOLERANCE or float(torch.linalg.det(turn)) < 0:
        what = f"does not turn the axes of {transforms}"
        raise InputError(path, what, "is this transforms.json the one that the run was trained on?")
    turn = nearest_rotation(turn)
    return Placing(-turn.T @ run_from_world[:3, 3], turn, 1 / scale)


def trained_on(run: Run, capture: Capture, transforms: Path) -> tuple[list[int], list[int]] | None:
    """Which of a capture's frames the run was trained on, in its order, and which it left out; None where that cannot
    be told."""
    told = read_json(transforms)
    if len(told["frames"]) != len(capture.frames):
        return None
    order = sorted(range(len(capture.frames)), key=lambda i: Path(capture.frames[i].name))
    # photos that were scaled down for it lie in one folder, so that folders no longer count
    if order != sorted(order, key=lambda i: Path(capture.frames[i].name).name):
        return None
    frames = [capture.frames[i] for i in order]
    chosen = _chosen(run.parser, frames, told)
    if chosen is None:
        return None
    rest = sorted(set(range(len(order))) - set(chosen))
    return [order[i] for i in chosen], [order[i] for i in rest]


def _chosen(parser: dict[str, Any], frames: list[Frame], told: dict[str, Any]) -> list[int] | None:
    """Positions of the frames for training, ascending."""
    count, mode = len(frames), parser.get("eval_mode", "fraction")
    if isinstance(told.get("train_filenames"), list):
        names = set(told["train_filenames"])
        return [i for i, f in enumerate(frames) if f.name in names]
    if mode == "fraction":
        kept = int(np.ceil(count * float(parser.get("train_split_fraction", 0.9))))
        return [int(i) for i in np.linspace(0, count - 1, kept, dtype=int)]
    if mode == "interval":
        return [i for i in range(count) if i % int(parser.get("eval_interval", 8)) != 0]
    if mode == "filename":
        return [i for i, f in enumerate(frames) if "train" in Path(f.name).name]
    return list(range(count)) if mode == "all" else None


def with_poses(capture: Capture, placing: Placing, chosen: list[int], adjustment: Tensor, mode: str) -> Capture:
    """The capture with the poses that the run trained with; ``adjustment`` (T, 6) of the chosen frames in turn."""
    frames = list(capture.frames)
    for i, twist in zip(chosen, adjustment.double(), strict=True):
        frames[i] = replace(frames[i], world_from_cam=placing.adjusted(frames[i].world_from_cam, twist, mode))
    return replace(capture, frames=tuple(frames))


def _matrix(rows: Any, where: str) -> Tensor:
    """(4, 4) float64 of three or four rows."""
    try:
        matrix = torch.tensor(rows, dtype=torch.float64)
        if matrix.shape not in ((3, 4), (4, 4)) or not bool(matrix.isfinite().all()):
            raise ValueError
    except (TypeError, ValueError, RuntimeError):
        raise InputError(where, "is not a 3x4 matrix", "restore the file that nerfstudio wrote") from None
    return torch.cat([matrix[:3], torch.tensor([[0.0, 0.0, 0.0, 1.0]]).double()])


def _number(value: Any, where: str) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not value > 0:
        raise InputError(where, f"{value!r} is not a scale", "restore the file that nerfstudio wrote")
    return float(value)
