"""``refield render WORK --cameras FILE --out DIR [--visit N] [--look PHOTO]``: pictures of it as it was or is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.artefacts import writable
from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.field.radiance import Field
from refield.field.render import render_frame
from refield.history import state
from refield.scene.capture import Frame
from refield.scene.errors import InputError, did_you_mean
from refield.scene.exposure import Exposure
from refield.scene.images import is_ours, write_image
from refield.scene.left_out import named
from refield.scene.transforms_json import load_cameras, stem
from refield.workspace import Workspace, refuse_inside

EXAMPLES = (
    "refield render work --cameras work/visits/001/photos/transforms.json --out pictures",
    "refield render work --cameras before/transforms.json --out pictures --visit 0",
)


@dataclass(frozen=True)
class Render:
    """Render the views of a transforms.json, one PNG per frame with the frame's file name."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    cameras: Path
    """a transforms.json (its images need not exist), in the world of the workspace's photos"""
    out: Path
    """the folder for the pictures"""
    visit: int | None = None
    """the state to show: 0 is before any visit; the latest by default"""
    look: str | None = None
    """a photo of the workspace's capture whose exposure, white balance and vignetting the pictures have; by default the
    photos' mean exposure, and no vignetting"""
    overwrite: bool = False
    """replace pictures in ``out`` that refield did not write"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Render) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    workspace = Workspace.open(options.work)
    visit = workspace.chosen_visit(options.visit)
    frames = load_cameras(options.cameras, warn=clock.warn)
    exposure = None if options.look is None else exposure_of(workspace, options.look)
    paths = output_paths(options.cameras, frames, options.out, overwrite=options.overwrite)
    clock.stage(f"load the field as of visit {visit}")
    render(state(workspace, visit), frames, paths, clock, exposure)
    facts = {"workspace": options.work, "visit": visit, "pictures": paths, "seconds_per_stage": clock.seconds}
    return Answer(facts | {"warnings": clock.warnings}, [f"{len(paths)} pictures in {options.out}"])


def exposure_of(workspace: Workspace, photo: str) -> Exposure:
    """How a photo of the workspace's capture, named by its file or by that without its ending, was exposed.

    Raises:
        InputError: there is no such photo.
    """
    frames = workspace.capture().frames
    for frame in frames:
        if photo in (frame.name, Path(frame.name).name, stem(frame)):
            return frame.exposure or Exposure()
    where = workspace.path / "capture" / "transforms.json"
    near = did_you_mean(photo, [frame.name for frame in frames])
    raise InputError(where, f"names no photo {photo!r}", f"{near}give one of its photos, such as {frames[0].name}")


def render(
    field: Field, frames: list[Frame], paths: list[Path], clock: Clock, exposure: Exposure | None = None
) -> None:
    """Write one picture per frame, neutral or as a photo of that exposure."""
    clock.stage(f"render {len(frames)} views")
    with clock.counters() as counters:
        count = counters("views")
        for done, (frame, path) in enumerate(zip(frames, paths), 1):
            _render(field, frame, path, exposure)
            count(done, len(frames))
    clock.stop()


def _render(field: Field, frame: Frame, path: Path, exposure: Exposure | None) -> None:
    picture = render_frame(field, frame).rgb
    if exposure is not None:
        picture = exposure.taken(picture, frame.camera)
    with writable(path):
        write_image(path, picture)


def output_paths(cameras: Path, frames: list[Frame], out: Path, *, overwrite: bool) -> list[Path]:
    """Where each frame's picture goes.

    Raises:
        InputError: two frames share a name, a name is none, a picture that is not ours or is one of the cameras' own
            photos would be replaced, or they would lie in what a workspace keeps.
    """
    stems = [stem(frame) for frame in frames]
    twice = sorted({s for s in stems if stems.count(s) > 1})
    if twice:
        what = f"several frames would be written as {named([s + '.png' for s in twice])}"
        raise InputError(cameras, what, "give every frame its own file name")
    unnamed = [f.name for f, s in zip(frames, stems) if s in ("", ".", "..")]
    if unnamed:
        raise InputError(cameras, f"the frame {unnamed[0]!r} has no file name", "name its image")
    if out.exists() and not out.is_dir():
        raise InputError(out, "is a file, not a folder", "choose another output folder")
    paths = [out / f"{s}.png" for s in stems]
    refuse_inside(out, *paths)
    photos = {frame.path.resolve() for frame in frames}  # refield may have written them too: those of a made-up world
    foreign = [p.name for p in paths if p.exists() and (not is_ours(p) or p.resolve() in photos)]
    if foreign and not overwrite:
        what = f"holds pictures that refield render did not write ({named(foreign)})"
        raise InputError(out, what, "choose another output folder, or pass --overwrite")
    return paths
