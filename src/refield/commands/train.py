"""``refield train DATA WORK``: photos, with camera poses or without → a field in a new workspace."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.field.descent import NonFiniteError
from refield.field.fit import FitConfig, ProgressCallback, fit_capture, need_device
from refield.field.fit_nerfacto import REDUCED, NerfactoFitConfig, fit_nerfacto
from refield.field.memory import Memory, memory_fault, memory_of
from refield.field.nerfacto import NerfactoField
from refield.field.photo_size import sizes_told
from refield.field.quality import OPEN, Quality, asked_of, sized
from refield.field.radiance import HashField
from refield.photos.capture import FromPhotosConfig, capture_from_photos
from refield.photos.landmarks import Landmarks, read_landmarks, write_landmarks
from refield.photos.sources import find_sources
from refield.scene.capture import Capture, centres
from refield.scene.errors import InputError
from refield.scene.load import is_posed, load_capture
from refield.scene.refined import in_words
from refield.scene.world import world_of
from refield.workspace import Workspace

EXAMPLES = (
    "refield train before work",
    "refield train before work --quality best --fit.max-seconds 600",
    "refield train work --more",
)


@dataclass(frozen=True)
class Train:
    """Fit a field to photos, and keep both in a new workspace. Where no camera poses are given, they are found."""

    data: Annotated[Path, arg(metavar="DATA"), Positional]
    """a folder of photos or videos, a transforms.json or its folder, or a COLMAP model in sparse/0 with images/"""
    work: Annotated[Path, arg(metavar="WORK"), Positional] = Path()
    """the workspace to make"""
    quality: Quality = "good"
    """draft takes a minute at most, good some minutes, best some tens of minutes. On two cores, and of large captures;
    small ones take less. What ``fit`` options say goes before it; a 0 there leaves it to the quality"""
    more: bool = False
    """go on with the fit of a workspace, given in place of DATA. From where it stood"""
    overwrite: bool = False
    """replace the workspace that is there, with its visits"""
    scale: float | None = None
    """metres per unit of the world, if you know them. Lengths are then told in metres too"""
    poses: FromPhotosConfig = field(default_factory=FromPhotosConfig)
    """photos without poses: how they are taken in, and how their poses are found"""
    architecture: Literal["hash", "nerfacto", "nerfacto-reduced"] = "hash"
    """of the field: hash, for a CPU; nerfacto, for long fits; or that one reduced. Hash fits in less than a minute;
    reduced, NeRFacto trains on a CPU in minutes (and heeds device, limit, seed and photos of ``nerfacto``)"""
    route: Literal["paper", "paper-reduced"] | None = None
    """as refield update wants it with the same option. It is nerfacto, or that reduced; exposures are not sought"""
    fit: FitConfig = OPEN
    nerfacto: NerfactoFitConfig = field(default_factory=NerfactoFitConfig, metadata={"usual": False})
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Train) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    if options.more:
        return _answer(options.data, train_more(options.data, clock, options.fit, options.quality), clock)
    if options.work == Path():
        raise InputError("WORK", "is not given", "name the folder in which to make the workspace")
    check_scale(options.scale)
    task = Sources(options.data, options.work, options.poses, options.scale)
    psnr = train(task, clock, _config_of(options), overwrite=options.overwrite, quality=options.quality)
    return _answer(options.work, psnr, clock)


def _answer(work: Path, psnr: float, clock: Clock) -> Answer:
    known = f"{psnr:.2f} dB on held-out pixels, " if math.isfinite(psnr) else ""
    capture = Workspace.open(work).capture()
    document = {"workspace": work, "photos": len(capture.frames), "held_out_psnr": psnr, "warnings": clock.warnings}
    document |= {"seconds": clock.total, "seconds_per_stage": clock.seconds}
    return Answer(document, [f"The field is in {work} ({known}{clock.total:.1f} s)."])


def _config_of(options: Train) -> FitConfig | NerfactoFitConfig:
    long, architecture = options.nerfacto, options.architecture
    if options.route is not None:
        architecture = "nerfacto" if options.route == "paper" else "nerfacto-reduced"
        if long.photos.exposures is None:
            long = replace(long, photos=replace(long.photos, exposures=False))
    if architecture == "hash":
        return options.fit
    if architecture == "nerfacto":
        return long
    reduced = replace(REDUCED, device=long.device, max_seconds=long.max_seconds, seed=long.seed)
    return replace(reduced, photos=long.photos, size=long.size)


@dataclass(frozen=True)
class Sources:
    """What a workspace is made from."""

    data: Path
    work: Path
    poses: FromPhotosConfig = field(default_factory=FromPhotosConfig)
    scale: float | None = None


def train(
    task: Sources,
    clock: Clock,
    config: FitConfig | NerfactoFitConfig,
    *,
    overwrite: bool,
    made_by: str = "train",
    quality: Quality | None = None,
) -> float:
    """Load, fit, keep. Returns the PSNR on held-out pixels, dB (NaN where none is held out).

    A ``quality`` says what the default config leaves open, see `refield.field.quality`.

    Raises:
        InputError: as `load_capture`, `capture_from_photos` and `Workspace.building`, or the photos do not fit into
            memory.
    """
    Workspace.refuse_unless_free(task.work, overwrite=overwrite)
    need_device(config.device)
    capture, landmarks = _loaded(task, clock)
    if quality is not None and isinstance(config, FitConfig):
        config = sized(config, capture.train, quality)
    elif isinstance(config, NerfactoFitConfig):
        config = replace(config, photos=asked_of(capture.train, config.photos))
    needed = memory_of(capture, config)
    _check_memory(task.data, needed)
    _check_cameras(task.data, capture)
    with Workspace.building(task.work, overwrite=overwrite, made_by=made_by) as workspace:
        capture = workspace.keep_capture(capture)
        workspace.keep_world(world_of(capture, task.scale))
        if landmarks is not None:
            write_landmarks(workspace.landmarks, landmarks)
        clock.stage(f"fit a field to {len(capture.train)} photos")
        _tell(capture, config, needed, clock)
        try:
            with clock.training("fit") as line:
                fitted, found = _fitted(capture, config, line)
        except NonFiniteError as error:
            if error.field is None or error.steps == 0:
                raise
            fitted, found = error.field, capture
            clock.warn(f"{error}; the last good state is kept, look at it before you use it")
        if line.cut_short is not None:
            done = f"its time was over after {100 * line.cut_short:.0f} % of its steps"
            clock.warn(f"the fit: {done}; refield train {task.work} --more goes on with it")
        clock.stage("keep the field")
        workspace.keep_field(fitted, line.psnr)
        workspace.keep_refined(capture, found)
        _tell_found(capture, found, clock)
    clock.stop()
    return line.psnr


def train_more(work: Path, clock: Clock, config: FitConfig, quality: Quality) -> float:
    """Go on with the fit of a workspace; the field that shows held-out photos better is kept. Returns its PSNR, dB.

    Raises:
        InputError: no workspace, one of another architecture, or one with visits, which stand on the field as it is.
    """
    workspace = Workspace.open(work)
    if workspace.visits:
        raise InputError(work, "has visits, which stand on its field as it is", "train a workspace of its own")
    field, capture = workspace.field(), workspace.capture()
    if not isinstance(field, HashField):
        raise InputError(work, f"holds a field of the kind {type(field).__name__}", "train anew")
    config = sized(config, capture.train, quality)
    clock.stage(f"go on with the fit to {len(capture.train)} photos")
    _tell(capture, config, memory_of(capture, replace(config, field=field.config)), clock)
    before = workspace.held_out_psnr()
    with clock.training("fit") as line:
        done = fit_capture(capture, config, line, start=field, goes_on=True)
    if line.psnr < before:
        clock.warn(f"no better on held-out photos ({line.psnr:.2f} dB, before {before:.2f}): what was there stays")
    else:
        clock.stage("keep the field")
        given = workspace.given_capture()
        landmarks = read_landmarks(workspace.landmarks, given)
        with Workspace.building(work, overwrite=True, made_by=Workspace.made_by(work) or "train") as renewed:
            renewed.keep_capture(given)
            renewed.keep_world(workspace.world())
            if landmarks is not None:
                write_landmarks(renewed.landmarks, landmarks)
            renewed.keep_field(done.field, line.psnr)
            renewed.keep_refined(given, done.capture)
        _tell_found(capture, done.capture, clock)
    clock.stop()
    return max(line.psnr, before) if math.isfinite(before) else line.psnr


def _tell(capture: Capture, config: FitConfig | NerfactoFitConfig, needed: Memory, clock: Clock) -> None:
    """What is known before it begins: sizes, memory, time."""
    told = [sizes_told(capture, config.size) or "", f"memory: {needed}"]
    if isinstance(config, FitConfig):
        most = "" if config.max_seconds is None else f", {config.max_seconds:.0f} s at most"
        told.append(f"work: {config.steps} steps of {config.samples} samples{most}")
    for line in told:
        if line:
            clock.console.print(f"           {line}", markup=False)


def _tell_found(given: Capture, found: Capture, clock: Clock) -> None:
    if said := in_words(given, found):
        clock.console.print(f"           of the photos: {said}", markup=False)


def _fitted(
    capture: Capture, config: FitConfig | NerfactoFitConfig, on_progress: ProgressCallback
) -> tuple[HashField | NerfactoField, Capture]:
    """The field, and the capture with what became known of its photos."""
    if isinstance(config, FitConfig):
        done = fit_capture(capture, config, on_progress)
        return done.field, done.capture
    fit = fit_nerfacto(capture, config, on_progress)
    return fit.field, fit.capture


def _loaded(task: Sources, clock: Clock) -> tuple[Capture, Landmarks | None]:
    if is_posed(task.data):
        clock.stage("load the capture")
        return load_capture(task.data, warn=clock.warn), None
    find_sources(task.data)
    clock.stage("find where the photos were taken")
    with Workspace.caching(task.work) as cache, clock.counters() as counting:
        found = capture_from_photos(task.data, cache, task.poses, warn=clock.warn, counting=counting)
    placed = f"{len(found.capture.frames)} of {found.photos} photos placed"
    clock.console.print(f"           {placed}, {len(found.capture.points)} points", markup=False)
    return found.capture, found.landmarks


def check_scale(scale: float | None) -> None:
    if scale is not None and not 0 < scale < 1e6:
        raise InputError("--scale", f"{scale:g} is no length", "give how many metres one unit of the world is")


def _check_cameras(data: Path, capture: Capture) -> None:
    """Refuse photos that show nothing in depth."""
    at = centres(capture.frames)
    spread = float((at - at.mean(0)).norm(dim=-1).max())
    if len(at) < 3 or spread < 1e-9 * (1 + float(at.abs().max())):
        what = f"its {len(at)} photos were taken from {'one place' if len(at) >= 3 else 'too few places'}"
        raise InputError(data, what, "give photos from many sides, 50 or more")


def _check_memory(data: Path, needed: Memory) -> None:
    """Refuse what would not fit, with the number, before the machine starts to swap."""
    fault = memory_fault(needed)
    if fault is not None:
        raise InputError(data, *fault)
