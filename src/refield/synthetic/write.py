"""A world → photos on disk: ``before/``, ``after/``, ``eval/`` and the true change in ``truth/``.

``before``, ``after`` and ``eval`` are captures (transforms.json + images/). ``after`` and ``eval`` also have
``masks_in/`` (where the object is now visible), ``masks_out/`` (where the old one would be) and ``depth/``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.change import ObjectChange, PlacedPhoto, SceneChange
from refield.scene.change_files import save_change
from refield.scene.errors import InputError, did_you_mean
from refield.scene.images import write_image
from refield.scene.transforms_json import save_transforms
from refield.synthetic.cameras import hemisphere, ring, square_camera
from refield.synthetic.grounds import Ground, on_ground
from refield.synthetic.pathtrace import PathTracer
from refield.synthetic.state import Item, State, TrueChange, World
from refield.synthetic.visibility import view_hits
from refield.synthetic.worlds import WORLDS

CAMERAS = 180
"""old photos, unless told otherwise (§11.1)"""
Progress = Callable[[int, int], None]
"""Called with the pictures done and their number."""
Seen = Callable[[State, Frame], Tensor]
"""Which item of a state each pixel's centre of a photo shows, (H, W) integers, -1 for none."""


@dataclass(frozen=True)
class SynthConfig:
    """How a world is photographed."""

    size: int = 128
    """pixels a side; the longer one of the world random"""
    spp: int = 64
    """light paths a pixel"""
    cameras: int | None = None
    """of the old photos, on 10 heights; 180 if not given. Not for the world random"""  # §11.1
    photos: int | None = None
    """old photos of the world random; if not given, as many as its seed says: 30 to 120, from 2000 on 20 to 300"""
    path: Literal["orbit", "half orbit", "hand-held", "dome", "forward", "inside-out", "walk"] | None = None
    """family of the cameras' path in the world random; if not given, as its seed says"""
    mixed: bool = False
    """portrait and landscape photos in the world random, whatever its seed says"""
    ground: Ground = "flat"
    """what objects stand on in a world with a name, where they all stand on its floor"""
    seed: int = 0
    """of textures, surroundings and the paths; of everything in the world random"""

    def __post_init__(self) -> None:
        for name, least in (("size", 8), ("spp", 1), ("cameras", 10), ("photos", 10), ("seed", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"--{name}", f"is {value}", f"give at least {least}")


def write_world(
    name: str,
    out: Path,
    *,
    size: int = 128,
    spp: int = 64,
    cameras: int | None = None,
    ground: Ground = "flat",
    seed: int = 0,
    on_progress: Progress | None = None,
) -> World:
    """Render the world called ``name`` into the folder ``out``; for the world random see `random_write`.

    Raises:
        InputError: there is no such world, it cannot have this ground, a number is out of range, or Mitsuba is not
            installed.
    """
    if name not in WORLDS:
        near = did_you_mean(name, ["random", *WORLDS])
        raise InputError(
            f"world {name!r}", "there is no such world", f"{near}choose one of random, {', '.join(WORLDS)}"
        )
    world = on_ground(WORLDS[name](seed), ground, seed)
    photograph(world, out, SynthConfig(size, spp, cameras, seed=seed), on_progress)
    return world


def photograph(world: World, out: Path, config: SynthConfig, on_progress: Progress | None = None) -> None:
    """Render a world's old photos, new photos (every other one for evaluation), masks and the truth."""
    camera = square_camera(config.size)
    old, new = hemisphere(config.cameras or CAMERAS, world.target), ring(world.target)
    total, done = len(old) + len(new), 0

    def shoot(folder: str, state: State, poses: Sequence[Tensor]) -> Capture:
        nonlocal done
        first, done = done, done + len(poses)
        tell = None if on_progress is None else lambda k: on_progress(first + k, total)
        return shoot_state(state, out / folder, (camera, poses), (config.spp, config.seed * 100_003 + first), tell)

    before = shoot("before", world.before, old)
    after = shoot("after", world.after, new[0::2])
    evaluation = shoot("eval", world.after, new[1::2])
    for folder, capture in (("after", after), ("eval", evaluation)):
        write_masks(world, out / folder, capture)
    (out / "truth").mkdir(exist_ok=True)
    save_change(out / "truth", true_change(world, before, after.frames))


def shoot_state(
    state: State,
    folder: Path,
    cameras: tuple[Camera | Sequence[Camera], Sequence[Tensor]],
    paths: tuple[int, int] = (64, 0),
    on_photo: Callable[[int], None] | None = None,
) -> Capture:
    """Photograph a state into a capture's folder (transforms.json, images/).

    Args:
        cameras: the camera, or one for each photo, and where it stands: ``world_from_cam`` (4, 4) each.
        paths: light paths a pixel, and the seed of the first photo's.
        on_photo: called with the number of photos done.
    """
    (camera, poses), (spp, seed) = cameras, paths
    tracer, frames = PathTracer(state), []
    each = [camera] * len(poses) if isinstance(camera, Camera) else camera
    for i, (one, pose) in enumerate(zip(each, poses)):
        path = folder / "images" / f"{i:04d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, tracer.photo(one, pose, spp, seed + i))
        frames.append(Frame(path, one, f"images/{path.name}", pose))
        if on_photo is not None:
            on_photo(i + 1)
    capture = Capture(tuple(frames))
    save_transforms(folder / "transforms.json", capture)
    return capture


def _alone(state: State, frame: Frame) -> Tensor:
    """What a photo shows of a world in which there is nothing else."""
    return seen_items(state, frame.camera, frame.world_from_cam)


def true_change(world: World, before: Capture, frames: Sequence[Frame], seen: Seen = _alone) -> SceneChange:
    """What `estimate` should find: masks as in ``before.train``, and the new photos all used."""
    then, now = ([seen(state, f) for f in before.train] for state in (world.before, world.after))
    pairs = [masks_of(world, f, seen) for f in frames]
    return SceneChange(
        objects=tuple(_object_change(world, change, then, now) for change in world.changes),
        photos=tuple(PlacedPhoto(frame.name, "used", frame=frame) for frame in frames),
        why="known from the world's description",
        masks_in=tuple(now for now, _ in pairs),
        masks_out=tuple(then for _, then in pairs),
    )


def seen_items(state: State, camera: Camera, world_from_cam: Tensor) -> Tensor:
    """Which item each pixel's centre shows, (H, W) int64, -1 for none."""
    return view_hits(state, camera, world_from_cam).item


def masks(world: World, camera: Camera, world_from_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Move-in (what arrived, visible now) and move-out (what was there, visible then), (H, W) bool each."""
    then, now = (seen_items(state, camera, world_from_cam) for state in (world.before, world.after))
    return _masks(world, then, now)


def masks_of(world: World, frame: Frame, seen: Seen) -> tuple[Tensor, Tensor]:
    """`masks` of a photo, by what it shows."""
    return _masks(world, seen(world.before, frame), seen(world.after, frame))


def _masks(world: World, then: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
    none = torch.zeros_like(now, dtype=torch.bool)
    news = [_shows(world.after, c.new, now) for c in world.changes if c.new]
    olds = [_shows(world.before, c.old, then) for c in world.changes if c.old]
    return reduce(torch.logical_or, news, none), reduce(torch.logical_or, olds, none)


def _shows(state: State, item: Item, index: Tensor) -> Tensor:
    return index == [other.name for other in state.items].index(item.name)


def _object_change(world: World, change: TrueChange, then: Sequence[Tensor], now: Sequence[Tensor]) -> ObjectChange:
    item = change.old or change.new
    assert item is not None  # a change has one side at least
    return ObjectChange(
        kind=change.kind,
        grid=item.grid(),
        new_from_old=change.new_from_old,
        masks=tuple(_shows(world.before, change.old, index) for index in then) if change.old else (),
        masks_in=tuple(_shows(world.after, change.new, index) for index in now) if change.new else (),
    )


def write_masks(world: World, folder: Path, capture: Capture) -> None:
    """The true masks and depths of photos of the new state: ``masks_in/``, ``masks_out/`` and ``depth/``."""
    for kind in ("masks_in", "masks_out", "depth"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for frame in capture.frames:
        hits = view_hits(world.after, frame.camera, frame.world_from_cam)
        now, then = _masks(world, seen_items(world.before, frame.camera, frame.world_from_cam), hits.item)
        write_image(folder / "masks_in" / frame.path.name, now)
        write_image(folder / "masks_out" / frame.path.name, then)
        np.savez_compressed(folder / "depth" / f"{frame.path.stem}.npz", depth=hits.depth.numpy())
