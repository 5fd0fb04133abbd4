"""``refield evaluate WORK EVAL``: how well the field shows photos that it has never seen (§11.2)."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated

from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.artefacts import writable
from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.estimate.localize import LocalizeConfig
from refield.evaluate import EvaluateConfig, Report, Scores, evaluate, looked_over, need_masks
from refield.history import state
from refield.photos.sources import find_sources
from refield.photos.taken import PhotoConfig, Taken
from refield.scene.change import PlacedPhoto
from refield.scene.errors import InputError
from refield.scene.files import read_json, write_json
from refield.scene.load import is_posed
from refield.vision.perceptual import Perceptual, open_lpips
from refield.vision.weights import WeightsError
from refield.visits.placing import Placing, placed_photos
from refield.workspace import Workspace, refuse_inside

EXAMPLES = ("refield evaluate work eval", "refield evaluate work eval --out numbers.json")


@dataclass(frozen=True)
class Evaluate:
    """Compare renderings with photos: PSNR, SSIM and LPIPS, inside the masks and on untouched pixels."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    eval: Annotated[Path, arg(metavar="EVAL"), Positional]
    """a folder with images/, masks_in/ and masks_out/ (PNGs with the images' names), and transforms.json: without
    it the photos are placed by what they show, no more exactly than that"""
    visit: int | None = None
    """the state to measure: 0 is before any visit; the latest by default, beside the state before any"""
    out: Path | None = None
    """a JSON file for the numbers"""
    lpips: Path | None = None
    """a folder with the weights of AlexNet or VGG16 and of LPIPS (docs/weights.md); without them LPIPS is left out"""
    intake: PhotoConfig = field(default_factory=PhotoConfig)
    """photos without poses: how they are taken in"""
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    """photos without poses: how they are placed"""
    config: EvaluateConfig = field(default_factory=EvaluateConfig)
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Evaluate) -> Answer:
    if options.out is not None:
        _refuse_unless_free(options.out)
    perceptual = _opened(options.lpips)
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    workspace = Workspace.open(options.work)
    visit = workspace.chosen_visit(options.visit)
    with contextlib.ExitStack() as held:
        placed = [] if is_posed(options.eval) else _placed(options, workspace, clock, held)
        views = looked_over(options.eval, [p.frame for p in placed if p.frame is not None] or None)
        clock.stage(f"load the field as of visit {visit}")
        now = state(workspace, visit)
        before = state(workspace, 0) if visit else None
        clock.stage("evaluate")
        report = evaluate(now, options.eval, old=before, frames=views, config=options.config, perceptual=perceptual)
    clock.stop()
    left_out = [{"name": p.name, "why": p.why} for p in placed if p.frame is None]
    numbers = report.to_dict() | {"left_out": left_out}
    if options.out is not None:
        with writable(options.out):
            write_json(options.out, numbers)
    about = {"workspace": options.work, "visit": visit, "seconds_per_stage": clock.seconds, "warnings": clock.warnings}
    return Answer(about | numbers, [table(report, f"visit {visit}")])


def _refuse_unless_free(out: Path) -> None:
    """Raises InputError: the numbers would replace what is none, or lie in what a workspace keeps."""
    refuse_inside(out)
    if out.is_dir():
        raise InputError(out, "is a folder, not a file", "choose another --out")
    if out.exists() and not _holds_numbers(out):
        raise InputError(out, "is there and holds no numbers of refield evaluate", "choose another --out")


def _holds_numbers(path: Path) -> bool:
    try:
        return {"pooled", "views"} <= read_json(path).keys()
    except InputError:
        return False


def _placed(options: Evaluate, workspace: Workspace, clock: Clock, held: contextlib.ExitStack) -> list[PlacedPhoto]:
    """Photos without poses, in the workspace's world; their upright copies lie in its cache."""
    inner = options.eval / "images"
    photos = inner if inner.is_dir() else options.eval  # masks are no photos
    find_sources(photos)
    held.enter_context(workspace.writing())
    how = Placing(options.intake, options.localize)

    def check(photo: Taken) -> None:
        need_masks(options.eval, photo.name, (photo.height, photo.width))

    return placed_photos(photos, workspace, clock, how, check)


def _opened(folder: Path | None) -> Perceptual | None:
    """LPIPS, if there are weights for it. Raises InputError: they cannot be used."""
    if folder is None:
        return None
    try:
        return open_lpips(folder)
    except WeightsError as error:
        raise InputError(error.folder, error.what, error.remedy) from error


def table(report: Report, name: str) -> Table:
    """One row per view and one for all, each number beside the old field's."""
    columns = [f.name for f in fields(Scores) if getattr(report.pooled, f.name) is not None]
    out = Table(title=f"{name} (in brackets: before)" if report.pooled_before else name)
    out.add_column("view")
    for column in columns:
        out.add_column(column.replace("_", "-"), justify="right")
    rows = [(v.name, v.scores, v.scores_before) for v in report.views]
    for label, scores, before in [*rows, ("all", report.pooled, report.pooled_before)]:
        out.add_row(label.rpartition("/")[2], *(_cell(scores, before, column) for column in columns))
    return out


def _cell(scores: Scores, before: Scores | None, column: str) -> str:
    digits = 3 if column.startswith(("ssim", "lpips")) else 2
    values = [getattr(s, column) for s in (scores, before) if s is not None]
    shown = ["-" if v is None else f"{v:.{digits}f}" for v in values]
    return shown[0] if len(shown) == 1 else f"{shown[0]} ({shown[1]})"
