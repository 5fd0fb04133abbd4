"""What ``refield render`` writes: PNGs in a folder or one film, and depths and opacities beside them."""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from refield.artefacts import writable
from refield.commands.viewpoints import Views
from refield.field.volrend import Rendering
from refield.scene.camera import Camera
from refield.scene.capture import Frame
from refield.scene.errors import InputError
from refield.scene.files import read_json, write_json
from refield.scene.film import SUFFIXES as FILMS
from refield.scene.film import film, is_film, is_our_film, refuse_unless_possible
from refield.scene.images import SUFFIXES, is_ours, write_image
from refield.scene.left_out import named
from refield.scene.transforms_json import stem
from refield.scene.world import World
from refield.workspace import refuse_inside

SCALE = "scale.json"
KIND = "distance along the ray"
STEPS = 65535
_FARTHEST = 8.0  # sizes of the scene, told as a depth
_OTHER_FILMS = (".mov", ".avi", ".mkv", ".webm", ".m4v")


@dataclass(frozen=True)
class Places:
    """Where each picture goes."""

    pictures: list[Path]
    """PNGs; none if a film is made"""
    depths: list[Path]
    opacities: list[Path]


def places_of(
    out: Path, views: Views, cameras: Path, *, depth: bool = False, opacity: bool = False, overwrite: bool = False
) -> Places:
    """Where each picture goes. ``cameras`` is where ``views`` that have names come from.

    Raises:
        InputError: two views share a name, a name is none, a film or picture that is not ours or is one of the cameras'
            own photos would be replaced, they would lie in what a workspace keeps, or a film cannot be written.
    """
    asfilm = is_film(out)
    if not asfilm and out.suffix.lower() in (*_OTHER_FILMS, *SUFFIXES):
        raise InputError(out, f"is no name of a film ({', '.join(FILMS)}) or of a folder", "choose another --out")
    names = [f"{i:05d}" for i in range(views.count)] if views.given is None or asfilm else _names(cameras, views.given)
    if asfilm and out.is_dir():
        raise InputError(out, "is a folder, and a film would get its name", "choose another --out")
    if not asfilm and out.exists() and not out.is_dir():
        raise InputError(out, "is a file, not a folder", "choose another output folder")

    def layer(kind: str) -> Path:
        return out.with_name(f"{out.stem}-{kind}") if asfilm else out / kind

    pictures = [] if asfilm else [out / f"{name}.png" for name in names]
    depths = [layer("depth") / f"{name}.png" for name in names] if depth else []
    opacities = [layer("opacity") / f"{name}.png" for name in names] if opacity else []
    scale = [layer("depth") / SCALE] if depth else []
    pngs = [*pictures, *depths, *opacities]
    refuse_inside(out, *pngs, *scale)
    photos = {frame.path.resolve() for frame in views.given or ()}  # refield may have written them too: made-up worlds
    foreign = [p.name for p in pngs if p.exists() and (not is_ours(p) or p.resolve() in photos)]
    foreign += [p.name for p in scale if p.exists() and not _is_scale(p)]
    if foreign and not overwrite:
        what = f"holds pictures that refield render did not write ({named(foreign)})"
        raise InputError(out, what, "choose another output folder, or pass --overwrite")
    if asfilm:
        refuse_unless_possible(out, views.fps)
        if out.exists() and not is_our_film(out) and not overwrite:
            raise InputError(out, "is there and was not made by refield", "choose another --out, or pass --overwrite")
    return Places(pictures, depths, opacities)


def _names(where: Path, frames: Sequence[Frame]) -> list[str]:
    stems = [stem(frame) for frame in frames]
    twice = sorted({s for s in stems if stems.count(s) > 1})
    if twice:
        what = f"several frames would be written as {named([s + '.png' for s in twice])}"
        raise InputError(where, what, "give every frame its own file name")
    unnamed = [f.name for f, s in zip(frames, stems) if s in ("", ".", "..")]
    if unnamed:
        raise InputError(where, f"the frame {unnamed[0]!r} has no file name", "name its image")
    return stems


def fitting(cameras: Sequence[Camera]) -> list[Camera]:
    """All pictures of a film have the size of most; others are shrunk to fit into it, and stand in its middle."""
    (width, height), _ = Counter((c.width, c.height) for c in cameras).most_common(1)[0]
    return [_within(c, width, height) for c in cameras]


def _within(camera: Camera, width: int, height: int) -> Camera:
    if (camera.width, camera.height) == (width, height):
        return camera
    part = min(width / camera.width, height / camera.height)
    return camera.scaled(max(round(camera.width * part), 1), max(round(camera.height * part), 1))


@contextlib.contextmanager
def written(out: Path, places: Places, frames: Sequence[Frame], fps: float) -> Iterator[Callable[[int, Tensor], None]]:
    """Call it with the number of each view and its picture (H, W, 3) in [0, 1], in order. A film appears when the block
    ends well."""
    if places.pictures:
        yield lambda i, picture: _write(places.pictures[i], picture)
        return
    width, height = (max(getattr(f.camera, side) for f in frames) for side in ("width", "height"))
    with writable(out), film(out, fps, (width, height)) as add:
        yield lambda _, picture: add(_centred((picture.clamp(0, 1) * 255).round().to(torch.uint8), width, height))


def _write(path: Path, image: Tensor) -> None:
    with writable(path):
        write_image(path, image)


def _centred(picture: Tensor, width: int, height: int) -> Tensor:
    """In the middle of a black picture of that size."""
    high, wide = picture.shape[:2]
    if (wide, high) == (width, height):
        return picture
    top, left = (height - high) // 2, (width - wide) // 2
    return functional.pad(picture, (0, 0, left, width - wide - left, top, height - high - top))


def depth_scale(world: World) -> float:
    """World units to one step of a 16-bit depth: 1, 2 or 5 times a power of ten, so that several sizes of the scene
    can be told."""
    least = _FARTHEST * (world.size or 1.0) / STEPS
    power = 10.0 ** math.floor(math.log10(least))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= least)


def write_layers(i: int, shown: Rendering, places: Places, scale: float) -> int:
    """Depth and opacity, if asked for; how many pixels lie beyond what a depth can tell."""
    beyond = 0
    if places.depths:
        steps = (shown.depth.double() / scale).round()
        beyond = int((steps > STEPS).sum())
        _write(places.depths[i], steps.clamp(0, STEPS).to(torch.uint16))
    if places.opacities:
        _write(places.opacities[i], shown.opacity)
    return beyond


def write_scale(path: Path, scale: float, world: World) -> None:
    metres = world.metres_per_unit
    what = {
        "made_by": "refield render",
        "units_per_step": scale,
        "metres_per_step": None if metres is None else scale * metres,
        "kind": KIND,
        "nothing_there": 0,
        "farthest": STEPS,
    }
    with writable(path):
        write_json(path, what)


def _is_scale(path: Path) -> bool:
    try:
        return read_json(path).get("made_by") == "refield render"
    except InputError:
        return False
