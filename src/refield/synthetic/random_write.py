"""A random world → photos on disk, as `write` lays them out, and ``truth/world.json`` with all that was chosen.

Photos of ``before/`` and ``after/`` are disturbed as the seed says, their poses too; those of ``eval/`` are clean, at
true poses, and masks, depths and the true change belong to the true poses everywhere. The photos of a folder have
light in common: all of it is scaled by one factor, so that the old photos are about as bright as the seed says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.change_files import save_change
from refield.scene.files import write_json
from refield.scene.images import frame_image, write_image
from refield.scene.srgb import to_linear, to_srgb
from refield.scene.transforms_json import NAME, save_transforms
from refield.synthetic.disturb import Disturbance, disturbed_photo, disturbed_pose
from refield.synthetic.pathtrace import PathTracer, mitsuba
from refield.synthetic.random_worlds import RandomWorld, random_world
from refield.synthetic.state import State
from refield.synthetic.write import Progress, SynthConfig, shoot_state, true_change, write_masks

_METERED, _METER_PIXELS, _METER_PATHS = 6, 32, 64  # photos that the exposure is metered on, their size, their paths
_DARKLY = 1e-4  # of the light: for metering
_CLEANER = 4  # times as many paths a pixel for the photos of evaluation: half the noise
_LATER = 1_000_003  # to the disturbance's seed, for the later visit
_ROUNDS = 30  # of halving the interval of the factor's logarithm


def write_random(out: Path, config: SynthConfig, on_progress: Progress | None = None) -> RandomWorld:
    """Render the random world of ``config.seed`` into the folder ``out``.

    Raises:
        InputError: Mitsuba is not installed, or nothing that was drawn fitted.
    """
    mitsuba()
    drawn = random_world(config.seed, config.photos, config.path, config.mixed)
    part = config.size / max(drawn.camera.width, drawn.camera.height)
    camera = drawn.camera.shrunk(part)
    factor = exposure_factor(drawn.world.before, camera, drawn.old, drawn.brightness)
    before, after = (state.brightened(factor) for state in (drawn.world.before, drawn.world.after))
    world = replace(drawn.world, before=before, after=after)
    total, done = len(drawn.old) + len(drawn.new) + len(drawn.evaluation), 0

    def shoot(folder: str, state: State, poses: Sequence[Tensor], spp: int = config.spp) -> Capture:
        nonlocal done
        first, done = done, done + len(poses)
        tell = None if on_progress is None else lambda k: on_progress(first + k, total)
        cameras = [c.shrunk(part) for c in drawn.cameras(folder, len(poses))]
        return shoot_state(state, out / folder, (cameras, poses), (spp, config.seed * 100_003 + first), tell)

    old, new = shoot("before", before, drawn.old), shoot("after", after, drawn.new)
    evaluation = shoot("eval", after, drawn.evaluation, _CLEANER * config.spp)
    for folder, capture in (("after", new), ("eval", evaluation)):
        write_masks(world, out / folder, capture)
    (out / "truth").mkdir(exist_ok=True)
    save_change(out / "truth", true_change(world, old, new.frames))
    if drawn.disturbance is not None:
        later = replace(drawn.disturbance, seed=drawn.disturbance.seed + _LATER)  # photos of one name differ
        disturb_in_place(old, out / "before", drawn.disturbance, world.target)
        disturb_in_place(new, out / "after", later, world.target)
    facts = drawn.facts | {"width": camera.width, "height": camera.height, "spp": config.spp, "light_factor": factor}
    write_json(out / "truth" / "world.json", facts)
    return replace(drawn, world=world, facts=facts)


def exposure_factor(state: State, camera: Camera, poses: Sequence[Tensor], brightness: float) -> float:
    """By how much all light is to be scaled so that small photos have the mean ``brightness``, sRGB in [0, 1].

    They are rendered so dark that nothing is clipped, and the factor is found by halving an interval.
    """
    small = camera.shrunk(_METER_PIXELS / max(camera.width, camera.height))
    tracer = PathTracer(state.brightened(_DARKLY))
    chosen = [poses[i] for i in np.linspace(0, len(poses) - 1, _METERED).round().astype(int)]
    linear = to_linear(np.stack([tracer.photo(small, pose, _METER_PATHS, 0).numpy() for pose in chosen]))
    low, high = np.log(1e-2), np.log(1e8)
    for _ in range(_ROUNDS):
        middle = (low + high) / 2
        dark = float(to_srgb(np.exp(middle) * linear).mean()) < brightness
        low, high = (middle, high) if dark else (low, middle)
    return float(f"{_DARKLY * np.exp((low + high) / 2):.3g}")


def disturb_in_place(
    capture: Capture, folder: Path, disturbance: Disturbance, target: tuple[float, float, float]
) -> None:
    """Photos and poses of a capture, replaced by what a phone would have made of them.

    ``target``, world, lies at the scene's distance, at which the disturbance's pose error is measured.
    """
    frames: list[Frame] = []
    for frame in capture.frames:
        distance = float((frame.centre - torch.tensor(target, dtype=torch.float64)).norm())
        write_image(frame.path, disturbed_photo(frame_image(frame), disturbance, frame.name))
        frames.append(replace(frame, world_from_cam=disturbed_pose(frame, disturbance, distance)))
    save_transforms(folder / NAME, replace(capture, frames=tuple(frames)))
