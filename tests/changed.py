"""A tiny scene before and after: two balls over a floor, photographed by formula; one of them moved."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from refield.field.fit import FitConfig
from refield.field.radiance import HashFieldConfig
from refield.field.render import render_camera
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.change import ObjectChange, PlacedPhoto, SceneChange
from refield.scene.change_files import save_change
from refield.scene.images import write_image
from refield.scene.transforms_json import save_transforms
from tests.captures import looking_at
from tests.update.worlds import Ball, BallWorld, at, moved

CAMERA = Camera(width=64, height=48, fx=77.0, fy=77.0, cx=32.0, cy=24.0)
FIT = FitConfig(steps=250, samples=2048, field=HashFieldConfig(levels=6, log2_table=12, width=16))
"""about 22 dB in five seconds: enough to see the ball move"""
FIT_OPTIONS = ["--fit.steps", "250", "--fit.samples", "2048", "--fit.field.levels", "6"]
FIT_OPTIONS += ["--fit.field.log2-table", "12", "--fit.field.width", "16"]

STAYS, GOES = Ball(at(-0.6, 0.4, 0.25), 0.25), Ball(at(0.4, -0.3, 0.3), 0.3)
THERE = at(-0.2, -0.6, 0.3, 0.7)


@dataclass(frozen=True)
class Changed:
    """The scene on disk: ``before/``, ``after/``, ``eval/`` and ``truth/``, as `refield synth` names them."""

    folder: Path
    truth: ObjectChange


def write_changed(folder: Path) -> Changed:
    """24 photos before, 4 after and 2 to measure by."""
    before, after = BallWorld((GOES, STAYS)), BallWorld((Ball(THERE, GOES.radius), STAYS))
    _photograph(folder / "before", before, 24, 0.0)
    new = _photograph(folder / "after", after, 4, 0.3)
    _photograph(folder / "eval", after, 2, 0.9)
    truth = moved(GOES, THERE)
    (folder / "truth").mkdir()
    photos = tuple(PlacedPhoto(frame.name, "used", frame=frame) for frame in new)
    save_change(folder / "truth", SceneChange((truth,), photos))
    return Changed(folder, truth)


def _photograph(folder: Path, world: BallWorld, count: int, turn: float) -> tuple[Frame, ...]:
    """From a ring around the scene, high and low in turns."""
    frames = []
    for i in range(count):
        angle = torch.tensor(2 * torch.pi * i / count + turn, dtype=torch.float64)
        eye = torch.stack([2.6 * angle.cos(), 2.6 * angle.sin(), torch.full_like(angle, (0.9, 1.6)[i % 2])])
        pose = looking_at(eye, torch.tensor([0, 0, 0.1], dtype=torch.float64))
        name = f"images/{i:03d}.png"
        write_image(folder / name, render_camera(world, CAMERA, pose).rgb)
        frames.append(Frame(folder / name, CAMERA, name, pose))
    save_transforms(folder / "transforms.json", Capture(tuple(frames)))
    return tuple(frames)
