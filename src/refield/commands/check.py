"""``refield check DATA``: a capture looked over before any time is spent on it."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.artefacts import writable
from refield.check.picture import camera_picture
from refield.check.survey import Survey, survey_capture, survey_document, survey_photos, told
from refield.commands.answer import Answer
from refield.commands.clock import Clock, duration
from refield.commands.options import PLAIN, Output
from refield.field.fit import FitConfig
from refield.field.quality import OPEN, Quality
from refield.photos.capture import FromPhotosConfig, capture_from_photos
from refield.photos.gather import gather
from refield.photos.look import stops, usual_sharpness
from refield.scene.errors import InputError
from refield.scene.images import is_ours, write_image
from refield.scene.left_out import named
from refield.scene.load import is_posed, load_capture
from refield.workspace import MARKER, Workspace, refuse_inside

EXAMPLES = ("refield check before", "refield check before --work work")


@dataclass(frozen=True)
class Check:
    """Look a capture over: what is there, what will be skipped and why, what it costs. Ends with 2 if not usable."""

    data: Annotated[Path, arg(metavar="DATA"), Positional]
    """what `refield train` takes, or a workspace"""
    work: Path | None = None
    """find the poses of photos without them too, and keep them in this (future) workspace for `refield train`"""
    picture: Path = Path("refield-check.png")
    """where the picture of the cameras around the points goes"""
    poses: FromPhotosConfig = field(default_factory=FromPhotosConfig)
    """photos without poses: how they are taken in, and how their poses are found"""
    quality: Quality = "good"
    """of the fit, for its memory and time"""
    fit: FitConfig = field(default=OPEN, metadata={"usual": False})
    """what would be fitted"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Check) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    refuse_inside(options.picture, *([] if options.work is None else [options.work]))
    if options.picture.exists() and not is_ours(options.picture):
        raise InputError(options.picture, "is there and was not made by refield", "choose another --picture")
    survey = check(options, clock)
    clock.stop()
    words: list[str | Table] = [_table(survey), *(f"skipped: {name}: {why}" for name, why in survey.left_out)]
    words += [f"advice: {line}" for line in survey.advice]
    picture = None
    if survey.capture is not None and survey.world is not None:
        with writable(options.picture):
            write_image(options.picture, camera_picture(survey.capture, survey.world))
        picture = options.picture
        words.append(f"cameras: {picture}")
    elif not survey.faults:
        words.append(f"cameras: not known yet; refield check {options.data} --work WORK finds and keeps them for train")
    document = {"data": options.data, **survey_document(survey), "picture": picture, "warnings": clock.warnings}
    if survey.faults:
        return Answer(document, words, stop=InputError(options.data, "not usable", "; ".join(survey.faults)))
    return Answer(document, [*words, told(options.data, survey)])


def check(options: Check, clock: Clock) -> Survey:
    """Look over what is given, as far as that does not take long; with ``work`` also where photos were taken.

    Raises:
        InputError: it cannot even be read.
    """
    if (options.data / MARKER).is_file():
        return _posed(options, clock, workspace=True)
    if is_posed(options.data):
        return _posed(options, clock)
    if options.work is not None:
        clock.stage("find where the photos were taken")
        with Workspace.caching(options.work) as cache, clock.counters() as counting:
            found = capture_from_photos(options.data, cache, options.poses, warn=_silent, counting=counting)
            clock.stage("look at the photos")
            return survey_capture(found.capture, (options.fit, options.quality), found.left_out, counting("photos"))
    clock.stage("look at the photos")
    with tempfile.TemporaryDirectory(prefix="refield-") as folder, clock.counters() as counting:
        gathered = gather(options.data, Path(folder), options.poses.photos, counting("photos"))
        return survey_photos(gathered, (options.fit, options.quality), options.poses.motion)


def _posed(options: Check, clock: Clock, *, workspace: bool = False) -> Survey:
    clock.stage("look at the photos")
    capture = Workspace.open(options.data).capture() if workspace else load_capture(options.data, warn=clock.warn)
    with clock.counters() as counting:
        return survey_capture(capture, (options.fit, options.quality), (), counting("photos"))


def _silent(message: str) -> None:
    """What is left out is listed with the rest."""


def _table(survey: Survey) -> Table:
    table = Table("", "", title="what is there", show_header=False)
    sizes = ", ".join(f"{n} of {w}x{h}" for (w, h), n in survey.sizes.most_common(4))
    table.add_row("photos", f"{len(survey.names)} usable, {len(survey.left_out)} skipped")
    table.add_row("sizes", sizes + (", …" if len(survey.sizes) > 4 else ""))
    table.add_row("cameras", str(survey.cameras))
    worst = sorted(zip(survey.looks, survey.names), key=lambda pair: pair[0].sharpness)[:3]
    softest = named([f"{name} {look.sharpness:.2f}" for look, name in worst])
    table.add_row("sharpness", f"{usual_sharpness(survey.looks):.2f} (1: no detail); least: {softest}")
    table.add_row("brightness", f"spreads over {stops(survey.looks):.1f} stops")
    if survey.coverage is not None and survey.world is not None and survey.capture is not None:
        c = survey.coverage
        table.add_row("from", f"{c.around:.0f}° around, {c.lowest:.0f}° to {c.highest:.0f}° above what they look at")
        seen = "" if c.seen_by is None else f", each in {c.seen_by:.0f} photos (median)"
        table.add_row("points", f"{len(survey.capture.points)}{seen}")
        table.add_row("size", f"{survey.world.size:.3g} units between the outermost cameras")
    table.add_row("memory for the fit", str(survey.memory))
    for stage, seconds in survey.seconds.items():
        table.add_row(f"time: {stage}", f"about {duration(seconds)} on this machine")
    return table
