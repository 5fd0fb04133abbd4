"""What is drawn beside a state: changed things as numbered boxes with arrows, and photos where they were taken.

Orange is where a thing was, blue-green where it is, as on the report's pages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from refield.report.words import up_of
from refield.scene.boxes import UprightBox, upright_box
from refield.scene.capture import Frame
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.images import frame_image
from refield.scene.notebook import inked
from refield.scene.world import World
from refield.view.stage import Array, Stage

if TYPE_CHECKING:
    from viser import SceneApi

WAS, IS = (249, 115, 22), (16, 185, 199)
MARKS, CAMERAS = "/marks", "/photos"
_OLD, _NEW = (120, 120, 128), (147, 51, 234)  # frames of old and of new photos
_LINE, _ARROW = 2.5, 0.012  # pixels; units of the stage
_FRUSTUM = 0.15  # units of the stage, of which so much is left where photos crowd
_THUMBNAIL = {False: 96, True: 256}  # pixels of the longer side, of old and of new photos
_MOST_OLD = 60
_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]


@dataclass(frozen=True)
class Place:
    """A box at which a thing was, or is."""

    number: int
    """the thing's, from 1"""
    now: bool
    box: UprightBox


def places_of(change: SceneChange, world: World | None) -> list[Place]:
    """Where the things of a change were, and where they are."""
    return [place for number, o in enumerate(change.objects, 1) for place in _places(number, o, up_of(world))]


def _places(number: int, o: ObjectChange, up: Tensor) -> Iterator[Place]:
    box = upright_box(o.grid, up)
    if o.kind != "added":
        yield Place(number, False, box)
    if o.kind == "added":
        yield Place(number, True, box)
    if o.new_from_old is not None:
        yield Place(number, True, replace(box, world_from_box=o.new_from_old.double() @ box.world_from_box))


def draw_marks(scene: SceneApi, stage: Stage, change: SceneChange, world: World, under: str = MARKS) -> None:
    """Boxes, numbers and arrows of a change, as nodes below ``under``."""
    places = places_of(change, world)
    for i, place in enumerate(places):
        corners = place.box.corners
        name = f"{under}/{i}"
        colour = IS if place.now else WAS
        scene.add_line_segments(
            f"{name}/box", edges(stage.points(corners)), colour, thickness=_LINE, thickness_units="screen"
        )
        told = str(place.number) if place.now or _left(change, place) else f"{place.number}: before"
        scene.add_label(f"{name}/number", told, position=stage.point(_top(place)), anchor="bottom-center")
    moved = [o.kind == "moved" for o in change.objects]
    if any(moved):
        tops = {(p.number, p.now): _top(p) for p in places}
        pairs = [(tops[n, False], tops[n, True]) for n, went in enumerate(moved, 1) if went]
        ends = stage.points(torch.stack([torch.stack(pair) for pair in pairs]))
        thick = min(_ARROW, 0.1 * float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1).min()))
        scene.add_arrows(
            f"{under}/arrows", ends, IS, shaft_radius=thick, head_radius=2.5 * thick, head_length=6 * thick
        )


def edges(corners: Array) -> Array:
    """The twelve edges (12, 2, 3) of a box by its corners (8, 3), as `UprightBox.corners` has them."""
    return np.stack([corners[[a, b]] for a, b in _EDGES])


def _top(place: Place) -> Tensor:
    """(3,) the middle of a box's upper side, where nothing hides an arrow."""
    pose = place.box.world_from_box
    return pose[:3, 3] + pose[:3, 2] * place.box.size[2] / 2


def _left(change: SceneChange, place: Place) -> bool:
    return change.objects[place.number - 1].kind == "removed"


@dataclass(frozen=True)
class Shot:
    """A photo to be drawn where it was taken."""

    name: str
    frame: Frame
    new: bool
    picture: NDPicture | None = None
    """what it shows, (h, w, 3) uint8"""
    masks: tuple[tuple[Tensor, tuple[int, int, int]], ...] = ()
    """(H, W) bool each, to be laid over it in a colour"""


NDPicture = np.ndarray[Any, np.dtype[np.uint8]]


def shots_of(old: Sequence[Frame], change: SceneChange | None) -> list[Shot]:
    """The photos of a state, still without pictures: some of the old ones, and all of those that a visit brought, with
    those of its masks that were read."""
    from refield.estimate.look import spread_out

    few = [Shot(f"old_{i}", f, False) for i, f in enumerate(spread_out(old, _MOST_OLD))]
    if change is None:
        return few
    kinds = ((change.masks_out, WAS), (change.masks_in, IS), (change.unexplained, _NEW))
    masks = [tuple((kind[i], ink) for kind, ink in kinds if kind) for i in range(len(change.frames))]
    return few + [Shot(f"new_{i}", f, True, masks=m) for i, (f, m) in enumerate(zip(change.frames, masks))]


def pictured(shot: Shot) -> Shot:
    """The same with its photo, small.

    Raises:
        InputError: its file cannot be read.
    """
    image = frame_image(shot.frame).numpy()
    part = min(1.0, _THUMBNAIL[shot.new] / max(image.shape[:2]))
    size = max(round(image.shape[1] * part), 1), max(round(image.shape[0] * part), 1)
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return replace(shot, picture=np.asarray(inked(Image.fromarray(small), shot.masks)))


def draw_shot(
    scene: SceneApi,
    stage: Stage,
    shot: Shot,
    size: float,
    on_click: Callable[[Frame], None] | None = None,
    under: str = CAMERAS,
) -> None:
    """A photo as a frustum of ``size`` (`frustum_size`), a node below ``under``; ``on_click`` hears that somebody
    clicked on it."""
    camera = shot.frame.camera
    handle = scene.add_camera_frustum(
        f"{under}/{shot.name}",
        fov=2 * math.atan(camera.height / 2 / camera.fy),
        aspect=camera.width / camera.height,
        scale=size,
        thickness=1.5,
        thickness_units="screen",
        color=_NEW if shot.new else _OLD,
        image=shot.picture,
        **stage.pose(shot.frame.world_from_cam),
    )
    if on_click is not None:
        handle.on_click(lambda _: on_click(shot.frame))


def frustum_size(stage: Stage, frames: Sequence[Frame]) -> float:
    """Units of the stage: no larger than that neighbours stay apart."""
    at = torch.from_numpy(stage.points(torch.stack([f.centre for f in frames])))
    if len(at) < 2:
        return _FRUSTUM
    apart = torch.cdist(at, at).fill_diagonal_(torch.inf).amin(1)
    return min(_FRUSTUM, max(0.6 * float(apart.median()), 0.25 * _FRUSTUM))
