"""A scene's photos with known objects and a known change put into them: ``before/ after/ eval/ truth/``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.rehearse.plan import Plan, plan_of, plans_of
from refield.rehearse.spots import Site, sites_of
from refield.rehearse.surfaces import Standing, Surfaces, View, depth_in, surfaces_of
from refield.scene.capture import Capture, Frame
from refield.scene.change_files import save_change
from refield.scene.errors import InputError
from refield.scene.files import write_json
from refield.scene.images import frame_image, scaled_image, write_image
from refield.scene.pose import invert, transform
from refield.scene.transforms_json import save_transforms
from refield.scene.world import world_of
from refield.synthetic.insert import Shot, inserted, seen_in
from refield.synthetic.looks import gain_of, look_of
from refield.synthetic.shading import CastShadow
from refield.synthetic.state import State, World
from refield.synthetic.write import masks_of, true_change

Count = Callable[[int, int], None]

NEW = 4
"""photos of the new state, and as many to measure by"""
FEWEST = 20
"""photos that a capture must have to be rehearsed in"""


@dataclass(frozen=True)
class Divided:
    """A capture's photos: of before the change, of after it, and to measure by."""

    before: tuple[Frame, ...]
    after: tuple[Frame, ...]
    evaluation: tuple[Frame, ...]


def divided(capture: Capture) -> Divided:
    """Every so-many-th photo shows the new state, one half-way between two of these is measured by.

    Raises:
        InputError: there are too few.
    """
    frames, count = capture.frames, len(capture.frames)
    if count < FEWEST:
        raise InputError("the capture", f"has {count} photos", f"a rehearsal needs {FEWEST} or more")
    after = [int((i + 0.25) * count / NEW) for i in range(NEW)]
    evaluation = [int((i + 0.75) * count / NEW) for i in range(NEW)]
    rest = tuple(f for i, f in enumerate(frames) if i not in after and i not in evaluation)
    return Divided(rest, tuple(frames[i] for i in after), tuple(frames[i] for i in evaluation))


@dataclass(frozen=True)
class Scenery:
    """A scene in which things can be rehearsed."""

    field: Field
    capture: Capture
    photos: Divided
    surfaces: Surfaces
    up: Tensor
    """(3,) float64"""


def scenery_of(field: Field, capture: Capture, on_progress: Count | None = None) -> Scenery:
    """Of a field and the photos it was fitted to: found once, for any number of rehearsals.

    Raises:
        InputError: there are too few photos.
    """
    photos = divided(capture)
    up = torch.tensor(world_of(capture).up, dtype=torch.float64)
    surfaces = surfaces_of(field, capture.frames, up, on_progress)
    if len(surfaces.points) == 0:
        raise InputError("the field", "shows nothing solid from where its photos were taken", "train it again")
    return Scenery(field, capture, photos, surfaces, up)


def compose(scenery: Scenery, out: Path, seed: int, on_progress: Count | None = None) -> Plan:
    """Write a rehearsal into the folder ``out``. Everything random is from ``seed``.

    Raises:
        NoRoomError: there is no free place that enough photos see.
    """
    plan = plan_of(_sites(scenery, seed), seed)
    _photographed(scenery, [(plan, out)], out, on_progress)
    return plan


def compose_several(scenery: Scenery, out: Path, seed: int, count: int, on_progress: Count | None = None) -> list[Path]:
    """Write ``before/`` into the folder ``out``, and into a folder in it for each of several changes all else that a
    rehearsal has; those folders. Everything random is from ``seed``.

    Raises:
        NoRoomError: there is no free place that enough photos see.
    """
    plans = plans_of(_sites(scenery, seed), seed, count)
    folders = [out / f"change-{k:02d}" for k in range(count)]
    _photographed(scenery, list(zip(plans, folders)), out, on_progress)
    return folders


def _sites(scenery: Scenery, seed: int) -> list[Site]:
    photos, surfaces = scenery.photos, scenery.surfaces
    views = {id(view.frame): view for view in surfaces.views}

    def group(frames: Sequence[Frame]) -> list[View]:
        return [views[id(frame)] for frame in frames]

    groups = (group(photos.before), group(photos.after), group(photos.evaluation))
    return sites_of(surfaces, scenery.up, groups, seed)


def _photographed(scenery: Scenery, plans: Sequence[tuple[Plan, Path]], out: Path, on_progress: Count | None) -> None:
    """Write the photos before, which plans have in common, into ``out``; what came after into a folder for each."""
    photos, studio = scenery.photos, _Studio(scenery, [plan for plan, _ in plans])
    fresh = len(photos.after) + len(photos.evaluation)
    total, done = len(photos.before) + len(plans) * fresh, 0

    def taken(folder: Path, frames: Sequence[Frame], state: State) -> Capture:
        nonlocal done
        first, done = done, done + len(frames)
        tell = None if on_progress is None else partial(_tell, on_progress, first, total)
        return studio.photograph(folder, frames, state, tell)

    before = taken(out / "before", photos.before, plans[0][0].world.before)
    for plan, place in plans:
        world, captures = plan.world, {"before": before}
        for folder, frames in (("after", photos.after), ("eval", photos.evaluation)):
            captures[folder] = taken(place / folder, frames, world.after)
            studio.write_masks(place / folder, captures[folder], world)
        (place / "truth").mkdir(exist_ok=True)
        save_change(place / "truth", true_change(world, before, captures["after"].frames, studio.seen))
        write_json(place / "truth" / "world.json", plan.facts | _size(captures))


def _tell(on_progress: Count, first: int, total: int, done: int) -> None:
    on_progress(first + done, total)


def _size(captures: dict[str, Capture]) -> dict[str, Any]:
    world = world_of(captures["before"])
    return {"scene_size": world.size, "photos": {name: len(c.frames) for name, c in captures.items()}}


@dataclass(frozen=True)
class _Crop:
    """A map of items without its empty border: many photos are large, and each is asked of several states."""

    shape: tuple[int, int]
    corner: tuple[int, int]
    items: Tensor
    """(h, w) int8, -1 for none"""

    @staticmethod
    def of(items: Tensor) -> _Crop:
        at = (items >= 0).nonzero()
        low, high = (at.amin(0), at.amax(0) + 1) if len(at) else (at.new_zeros(2), at.new_zeros(2))
        (i, j), (k, m) = low.tolist(), high.tolist()
        return _Crop((items.shape[0], items.shape[1]), (i, j), items[i:k, j:m].to(torch.int8).clone())

    def whole(self) -> Tensor:
        out = torch.full(self.shape, -1, dtype=torch.int8)
        (i, j), (h, w) = self.corner, self.items.shape
        out[i : i + h, j : j + w] = self.items
        return out


class _Studio:
    """Puts plans' objects into photos, and remembers what each shows of which; they begin with the same state."""

    def __init__(self, scenery: Scenery, plans: Sequence[Plan]) -> None:
        self._scenery, self._light, site = scenery, plans[0].light, plans[0].site
        self._states = [plans[0].world.before, *(plan.world.after for plan in plans)]
        self._standing, plane = None, None
        if site.offset is not None:
            self._standing = Standing(site.up, site.offset, 2 * site.even)
            plane = (site.up, site.offset, 2 * site.even)
        self._shadows = [CastShadow(state, self._light, plane) for state in self._states]
        self._items: dict[tuple[Path, int], _Crop] = {}  # of every photo, in the states that are asked of it
        self._depth: dict[Path, Tensor] = {}  # of those of new states, until they are written

    def _number(self, state: State) -> int:
        return next(k for k, one in enumerate(self._states) if one is state)

    def photograph(
        self, folder: Path, frames: Sequence[Frame], state: State, tell: Callable[[int], None] | None
    ) -> Capture:
        """Write the photos of a state (transforms.json, images/)."""
        number, kept = self._number(state), []
        asked = range(len(self._states)) if number == 0 else (0, number)
        # the photos before do not depend on how many changes follow
        close = self._states[:1] if number == 0 and len(self._states) > 2 else [self._states[k] for k in asked]
        for i, frame in enumerate(frames):
            path = folder / "images" / f"{i:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            shot = self._shot(frame, close)
            picture = inserted(shot, state, self._light, self._shadows[number], seed=i)
            write_image(path, picture.image)
            for k in asked:
                item = picture.item if k == number else seen_in(shot, self._states[k])
                self._items[path, k] = _Crop.of(item)
            if number > 0:
                self._depth[path] = picture.depth
            kept.append(replace(frame, path=path, name=f"images/{path.name}"))
            if tell is not None:
                tell(i + 1)
        capture = Capture(tuple(kept))
        save_transforms(folder / "transforms.json", capture)
        return capture

    def write_masks(self, folder: Path, capture: Capture, world: World) -> None:
        """``masks_in/``, ``masks_out/`` and ``depth/`` of photos of the new state."""
        for kind in ("masks_in", "masks_out", "depth"):
            (folder / kind).mkdir(parents=True, exist_ok=True)
        for frame in capture.frames:
            now, then = masks_of(world, frame, self.seen)
            write_image(folder / "masks_in" / frame.path.name, now)
            write_image(folder / "masks_out" / frame.path.name, then)
            depth = self._depth.pop(frame.path).numpy()
            np.savez_compressed(folder / "depth" / f"{frame.path.stem}.npz", depth=depth)

    def seen(self, state: State, frame: Frame) -> Tensor:
        """Which item of a state each pixel of a photo would show, (H, W) int8, -1 for none: the truth's `Seen`."""
        return self._items[frame.path, self._number(state)].whole()

    def _shot(self, frame: Frame, states: Sequence[State]) -> Shot:
        """A photo with what is known of it, most exactly where the objects of some states are."""
        scenery = self._scenery
        image = frame_image(frame)
        view = next(v for v in scenery.surfaces.views if v.frame is frame)
        gain = gain_of(scaled_image(frame, view.camera), view.rgb, view.depth.isfinite())
        surface, limit = depth_in(scenery.field, scenery.surfaces, frame, self._box(frame, states), self._standing)
        return Shot(image, frame.camera, frame.world_from_cam, surface, limit, look_of(image, gain))

    def _box(self, frame: Frame, states: Sequence[State]) -> tuple[int, int, int, int]:
        """Left, top, right, bottom of the part of a photo in which objects stand, in any of the states."""
        items = [item for state in states for item in state.items]
        corners = torch.cat([torch.cartesian_prod(*item.box().T) for item in items])
        pixels, z = frame.camera.project(transform(invert(frame.world_from_cam), corners))
        if not bool((z > 0).all()):
            return 0, 0, 0, 0
        size = pixels.new_tensor([frame.camera.width, frame.camera.height])
        lo, hi = (torch.minimum(x.clamp_min(0), size) for x in (pixels.amin(0) - 8, pixels.amax(0) + 8))
        return int(lo[0]), int(lo[1]), int(hi[0]), int(hi[1])
