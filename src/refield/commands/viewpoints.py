"""From where ``refield render`` looks: views of a file, the photos' own, around the scene, along a path, or one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_frame, render_many
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, Rays
from refield.scene.errors import InputError
from refield.scene.left_out import Warn
from refield.scene.paths import SPREADS, orbit, smooth_path, tour, typical_camera
from refield.scene.transforms_json import load_cameras
from refield.scene.world import World
from refield.workspace import Workspace

PHOTOS = Path("photos")
"""in place of a file of keyframes: a tour through the photos' own places"""
_USUAL, _LONGEST = 960, 8192  # sides of the pictures of a path, where nothing is said, and of any
_ONE_BY_ONE = 2.0  # views a second in a film of views that are no path
_MOVING = 24.0
_SECONDS = {"orbit": 6.0, "tour": 10.0, "between": 4.0, "keyframe": 1.5}
_MOST = 100_000
_SMALL, _FEW = 96, 12  # pixels and views by which one is chosen to stand at
_CLEAR = 0.02  # of the scene's size: how much nearer than that nothing may stand in an orbit's way


@dataclass(frozen=True)
class Views:
    """Where the pictures are taken from; known before any field is loaded, but for the places themselves."""

    count: int
    fps: float
    """pictures a second in a film"""
    frames: Callable[[Sequence[Field], Warn], list[Frame]]
    """the places, for the states of the field that are shown"""
    given: tuple[Frame, ...] | None = None
    """views with names of their own"""
    standing: bool = False
    """all are the same"""

    @property
    def longest(self) -> int | None:
        """The longest side where none is asked for; None: each camera's own."""
        return None if self.given is not None else _USUAL


@dataclass(frozen=True)
class Pace:
    """How many pictures, and how fast; what is None follows from the rest."""

    frames: int | None = None
    seconds: float | None = None
    fps: float | None = None

    def of_path(self, usual: float) -> tuple[int, float]:
        """Pictures, and pictures a second, of a path that takes ``usual`` seconds where nothing is said.

        Raises:
            InputError: they contradict each other, or are none.
        """
        self._check()
        if self.frames is not None:
            return self.frames, self.fps or (self.frames / self.seconds if self.seconds else _MOVING)
        fps = self.fps or _MOVING
        count = max(round((self.seconds or usual) * fps), 1)
        if count > _MOST:
            raise InputError("--seconds", f"makes {count} pictures", f"stay below {_MOST}")
        return count, fps

    def of_views(self, count: int) -> float:
        """Views a second of so many that are shown one by one.

        Raises:
            InputError: as `of_path`, or a number of pictures is asked for.
        """
        if self.frames is not None:
            what = "goes with --orbit, --path and a standing --between"
            raise InputError("--frames", what, "leave it out: each view is one picture")
        self._check()
        if self.fps is not None and self.seconds is not None:
            raise InputError("--fps", f"and --seconds both say how fast {count} views pass", "give one of them")
        return self.fps or (count / self.seconds if self.seconds else _ONE_BY_ONE)

    def _check(self) -> None:
        for name, value in (("--frames", self.frames), ("--seconds", self.seconds), ("--fps", self.fps)):
            if value is not None and not 0 < value <= _MOST:
                raise InputError(name, f"{value:g} is none", f"give a number above 0 and up to {_MOST}")
        if None not in (self.frames, self.seconds, self.fps):
            raise InputError("--frames", "with --seconds and --fps says too much", "give two of the three")


def views_of(
    workspace: Workspace,
    cameras: Path | None,
    like_photos: bool,
    around: bool,
    path: Path | None,
    between: Sequence[int],
    pace: Pace,
    warn: Warn,
) -> Views:
    """Where the pictures are taken from, by what the command was given.

    Raises:
        InputError: nothing was, or more than one; or what was given cannot be used.
    """
    said = {"--cameras": cameras, "--like-photos": like_photos, "--orbit": around, "--path": path}
    chosen = [name for name, value in said.items() if value]
    if len(chosen) > 1:
        raise InputError(" and ".join(chosen), "are two ways to say from where to look", "give one of them")
    if cameras is not None:
        return _one_by_one(load_cameras(cameras, warn=warn), pace)
    if not chosen and not between:
        what = "it was not said from where to look"
        ways = (
            "--orbit (around the scene), --like-photos (as each photo), --path FILE (through its views), --path photos"
        )
        ways += " (a tour through the photos' places), --cameras FILE (each of its views)"
        raise InputError("render", what, f"give one of {ways}, or --between 0 1 (from visit to visit)")
    capture = workspace.capture()
    if like_photos:
        return _one_by_one(list(capture.frames), pace)
    if around:
        count, fps = pace.of_path(_SECONDS["orbit"])
        camera, world = typical_camera(capture.frames), workspace.world()

        def places(fields: Sequence[Field], warn: Warn) -> list[Frame]:
            return _numbered([(camera, pose) for pose in free_orbit(capture.frames, world, fields, count, warn)])

        return Views(count, fps, places)
    if path is not None:
        return _along(path, capture, pace, warn)
    count, fps = pace.of_path(_SECONDS["between"] * (len(between) - 1))
    candidates = _new_photos(workspace, between) or _evenly(capture.frames)
    return Views(count, fps, lambda fields, _: _standing(candidates, fields, count), standing=True)


def refuse_size(longest: int | None) -> None:
    """Check what the user asks for as the longer side.

    Raises:
        InputError: no picture has that size.
    """
    if longest is not None and not 2 <= longest <= _LONGEST:
        raise InputError("--size", f"{longest} is no size of a picture", f"give 2 to {_LONGEST} pixels")


def sized(camera: Camera, longest: int | None, usual: int | None, *, even: bool = False) -> Camera:
    """The same lens on a sensor whose longer side has ``longest`` pixels, or no more than ``usual``; sides ``even``
    where a film needs that."""
    side = max(camera.width, camera.height)
    goal = longest or min(side, usual or side)
    width, height = (max(round(n * goal / side), 1) for n in (camera.width, camera.height))
    if even:
        width, height = (max(round(n / 2) * 2, 2) for n in (width, height))
    return camera if (width, height) == (camera.width, camera.height) else camera.scaled(width, height)


def _one_by_one(frames: list[Frame], pace: Pace) -> Views:
    return Views(len(frames), pace.of_views(len(frames)), lambda *_: frames, tuple(frames))


def _numbered(cameras: Sequence[tuple[Camera, Tensor]]) -> list[Frame]:
    return [Frame(Path(f"{i:05d}.png"), c, f"{i:05d}.png", world_from_cam=pose) for i, (c, pose) in enumerate(cameras)]


def free_orbit(frames: Sequence[Frame], world: World, fields: Sequence[Field], count: int, warn: Warn) -> list[Tensor]:
    """Of the orbits around what ``frames`` look at the smoothest that nothing stands in the way of, in any of
    ``fields``; (4, 4) poses. If there is none, that with the fewest such places, and a warning."""
    blocked, poses = count + 1, list[Tensor]()
    for spread in SPREADS:
        found = orbit(frames, torch.tensor(world.up), count, spread)
        steps = max(_blocked(field, found, _CLEAR * world.size) for field in fields)
        if steps < blocked:
            blocked, poses = steps, found
        if blocked == 0:
            break
    if blocked:
        warn(f"something stands in the orbit's way at {blocked} of {count} places; --path photos keeps to the photos'")
    return poses


def _blocked(field: Field, poses: Sequence[Tensor], clear: float) -> int:
    """From how many places the way on (from the last, to the first) meets something, or ends right before it."""
    at = torch.stack([pose[:3, 3] for pose in poses])
    way = at.roll(-1, 0) - at
    length = way.norm(dim=1).float()
    if float(length.max()) == 0:
        return 0
    some = length > 0
    device = field.sampler.grid.device
    rays = Rays(at[some].float().to(device), (way[some] / way[some].norm(dim=1, keepdim=True)).float().to(device))
    seen = render_many(field, rays)
    return int(((seen.opacity.cpu() > 0.5) & (seen.depth.cpu() < length[some] + clear)).sum())


def _along(path: Path, capture: Capture, pace: Pace, warn: Warn) -> Views:
    """Through the keyframes of a file, or through the photos' places."""
    if path == PHOTOS:
        count, fps = pace.of_path(_SECONDS["tour"])
        camera = typical_camera(capture.frames)
        keyframes = [replace(frame, camera=camera) for frame in tour(capture.frames)]
    else:
        keyframes = load_cameras(path, warn=warn)
        if len(keyframes) < 2:
            raise InputError(
                path, "holds one view, and a path leads through two or more", "add views, or use --cameras"
            )
        count, fps = pace.of_path(_SECONDS["keyframe"] * (len(keyframes) - 1))
    return Views(count, fps, lambda *_: _numbered(smooth_path(keyframes, count)))


def _new_photos(workspace: Workspace, between: Sequence[int]) -> list[Frame]:
    """Those by which the visits from the first to the last of ``between`` were told."""
    visits = range(min(between) + 1, max(between) + 1)
    return [f for n in visits for f in workspace.change(n, masks=False).frames]


def _evenly(frames: Sequence[Frame]) -> list[Frame]:
    return [frames[i * len(frames) // min(len(frames), _FEW)] for i in range(min(len(frames), _FEW))]


def _standing(places: Sequence[Frame], fields: Sequence[Field], count: int) -> list[Frame]:
    """The view in which most changes, seen small."""

    def differs(frame: Frame) -> float:
        small = replace(frame, camera=sized(frame.camera, None, _SMALL))
        shown = [render_frame(field, small).rgb for field in fields]
        return sum(float((a - b).abs().mean()) for a, b in pairwise(shown))

    best = max(places, key=differs) if len(places) > 1 else places[0]
    return _numbered([(best.camera, best.world_from_cam)] * count)
