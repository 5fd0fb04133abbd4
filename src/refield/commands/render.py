"""``refield render WORK --out FILM|DIR``: pictures and films of it as it was, is, or went from the one to the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.commands.outputs import (
    KIND,
    SCALE,
    STEPS,
    Places,
    depth_scale,
    fitting,
    places_of,
    write_layers,
    write_scale,
    written,
)
from refield.commands.viewpoints import Pace, Views, refuse_size, sized, views_of
from refield.field.blend import Blend, Transition
from refield.history import state
from refield.scene.capture import Frame
from refield.scene.errors import InputError, did_you_mean
from refield.scene.exposure import Exposure
from refield.scene.film import is_film
from refield.scene.transforms_json import stem
from refield.workspace import Workspace

EXAMPLES = (
    "refield render work --orbit --out around.webp",
    "refield render work --like-photos --out pictures --visit 0",
    "refield render work --between 0 1 --out change.gif",
)


@dataclass(frozen=True)
class Render:
    """Pictures, or a film, of a workspace from where you say: one of --orbit, --like-photos, --path and --cameras is
    needed, or --between."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    out: Path
    """a film, if it ends in .mp4, .gif or .webp; else the folder for the pictures, as PNG. MP4 needs
    the extra 'video'"""
    orbit: bool = False
    """around what the photos look at. From where photographers stood; ends where it began"""
    like_photos: bool = False
    """as each photo of the capture was taken, one by one"""
    path: Path | None = None
    """through the views of a transforms.json; or the word photos, for a tour of their own places. The path is smooth;
    the views are in the world of the workspace's photos, and their images need not exist"""
    cameras: Path | None = None
    """the views of a transforms.json, one by one. The PNGs have their names"""
    visit: int | None = None
    """which state: 0 is before any visit; the latest by default"""
    between: tuple[int, ...] = ()
    """from state to state, as 0 1, or 0 1 2. On the way that is chosen, or standing where most changes"""
    blend: Blend = "wipe"
    """how one state goes over into the next. A fade takes longer on a way, as both are rendered"""
    frames: int | None = None
    """how many pictures"""
    seconds: float | None = None
    """how long the film is. By default 6 for an orbit, 1.5 for each part of a path, 10 for a tour, 4 for each change"""
    fps: float | None = None
    """pictures a second. 24 by default, 2 of views that are shown one by one"""
    size: int | None = None
    """the longer side in pixels. By default the photos', on a path 960 at most"""
    depth: bool = False
    """depths too, as 16-bit PNGs in a folder of their own. With scale.json"""
    opacity: bool = False
    """opacities too, as 8-bit PNGs in a folder of their own. How much of the light each pixel holds back"""
    look: str | None = None
    """a photo of the capture that the pictures are to look like. They have its exposure, white balance and vignetting;
    by default the photos' mean exposure, and no vignetting"""
    overwrite: bool = False
    """replace what refield did not write at ``out``"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Render) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    workspace = Workspace.open(options.work)
    visits = _visits(options, workspace)
    refuse_size(options.size)
    pace = Pace(options.frames, options.seconds, options.fps)
    ways = options.cameras, options.like_photos, options.orbit, options.path
    views = views_of(workspace, *ways, options.between, pace, clock.warn)
    exposure = None if options.look is None else exposure_of(workspace, options.look)
    layers = {"depth": options.depth, "opacity": options.opacity}
    places = places_of(options.out, views, options.cameras or options.work, **layers, overwrite=options.overwrite)
    clock.stage(f"load the field as of visit {' and '.join(str(v) for v in sorted(set(visits)))}")
    states = {visit: state(workspace, visit) for visit in sorted(set(visits))}
    fields = [states[visit] for visit in visits]
    frames = views.frames(fields, clock.warn)
    even = options.out.suffix.lower() == ".mp4"
    cameras = [sized(frame.camera, options.size, views.longest, even=even) for frame in frames]
    if is_film(options.out):
        cameras = fitting(cameras)
    frames = [replace(frame, camera=camera) for frame, camera in zip(frames, cameras)]
    show = Transition(fields, options.blend, standing=views.standing)
    scale = depth_scale(workspace.world())
    clock.stage(f"render {len(frames)} views")
    beyond = 0
    with written(options.out, places, frames, views.fps) as write, clock.counters() as counting:
        tell = counting("pictures")
        for i, frame in enumerate(frames):
            shown = show(frame, i / max(len(frames) - 1, 1))
            rgb = shown.rgb if exposure is None else exposure.taken(shown.rgb, frame.camera)
            write(i, rgb)
            beyond += write_layers(i, shown, places, scale)
            tell(i + 1, len(frames))
        if places.depths:
            write_scale(places.depths[0].parent / SCALE, scale, workspace.world())
    clock.stop()
    document = {"workspace": options.work, "visits": visits, "out": options.out, "pictures": places.pictures}
    document |= {"count": len(frames)}
    document |= {"depths": places.depths, "depth_step": scale, "opacities": places.opacities}
    document |= {"seconds_per_stage": clock.seconds, "warnings": clock.warnings}
    return Answer(document, list(_told(options, views, places, frames, scale, beyond)))


def _visits(options: Render, workspace: Workspace) -> list[int]:
    """The states that are shown, in order."""
    if not options.between:
        return [workspace.chosen_visit(options.visit)]
    if options.visit is not None:
        raise InputError("--visit", "and --between both say which state to show", "give one of them")
    visits = [workspace.chosen_visit(n) for n in options.between]
    if len(visits) < 2 or any(a == b for a, b in pairwise(visits)):
        what = f"{' '.join(map(str, visits))} is no way from one state to another"
        raise InputError("--between", what, "name two or more states, such as 0 1")
    return visits


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


def _told(
    options: Render, views: Views, places: Places, frames: Sequence[Frame], scale: float, beyond: int
) -> Iterator[str]:
    if is_film(options.out):
        camera = frames[0].camera
        seconds = len(frames) / views.fps
        yield f"{len(frames)} pictures of {camera.width}x{camera.height}, {seconds:.3g} s, in {options.out}"
    else:
        yield f"{len(frames)} pictures in {options.out}"
    if places.depths:
        far = f"; {beyond} pixels lie farther off than {scale * STEPS:.3g} and hold {STEPS}" if beyond else ""
        yield f"depths in {places.depths[0].parent}: {KIND} in steps of {scale:g} units, 0 where nothing is{far}"
    if places.opacities:
        yield f"opacities in {places.opacities[0].parent}"
