"""``refield update WORK PHOTOS``: a few new photos → what changed, and the field of the scene as it is."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from torch import Tensor
from tyro.conf import Positional, arg

from refield.commands.clock import Clock
from refield.commands.page import page
from refield.commands.placing import Placing, placed_photos
from refield.estimate.localize import LocalizeConfig
from refield.estimate.recipe import EstimateConfig, estimate_change
from refield.evaluate import Report, evaluate, looked_over
from refield.field.radiance import Field
from refield.field.render import render_camera
from refield.history import known_objects, retouched, state
from refield.photos.sources import find_sources
from refield.photos.taken import PhotoConfig
from refield.report import PAGE, link_next, summary, write_contact_sheet, write_report
from refield.scene.capture import Capture
from refield.scene.change import PlacedPhoto, SceneChange
from refield.scene.errors import InputError
from refield.scene.load import is_posed, load_new_photos
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.store import save_updated
from refield.update.train import update_field
from refield.workspace import Workspace

SHOWN = 256 * 256
"""pixels, about and at most, of what a field shows of a new photo on the page"""
SHEET = "before-after.png"


@dataclass(frozen=True)
class Update:
    """Find out from a few new photos what moved, left or arrived, and bring the field up to date."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    photos: Annotated[Path, arg(metavar="PHOTOS"), Positional]
    """the new photos: their folder; or a transforms.json or its folder, with poses in the world of the old ones"""
    evaluation: Path | None = None
    """a folder of further photos (transforms.json, images/, masks_in/, masks_out/) to measure by"""
    intake: PhotoConfig = field(default_factory=PhotoConfig)
    """photos without poses: how they are taken in"""
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    """photos without poses: how they are placed"""
    estimate: EstimateConfig = field(default_factory=EstimateConfig)
    update: UpdateConfig = field(default_factory=UpdateConfig)


@dataclass(frozen=True)
class Visit:
    """What an update has made."""

    folder: Path
    change: SceneChange
    evaluation: Report | None

    @property
    def html(self) -> Path:
        return self.folder / PAGE

    @property
    def sheet(self) -> Path:
        """The evaluation's views before and after; there is none without an evaluation or a change."""
        return self.folder / SHEET


def run(options: Update) -> None:
    clock = Clock()
    visit = update(options, clock)
    unclear = visit.change.objects or visit.change.unexplained
    print(summary(visit.change) if unclear else "nothing changed")
    if visit.change.why:
        print(visit.change.why)
    print(f"report: {visit.html}")


def update(options: Update, clock: Clock, facts: Mapping[str, float | str] | None = None) -> Visit:
    """Estimate, update, report: one visit, published whole or not at all.

    Raises:
        InputError: no workspace, or unusable photos.
    """
    workspace = Workspace.open(options.work)
    capture, given = workspace.capture(), None
    if is_posed(options.photos):
        given = load_new_photos(options.photos, capture, warn=clock.warn)
    else:
        find_sources(options.photos)
    if options.evaluation is not None:
        looked_over(options.evaluation)
    models = options.estimate.models.open()
    with workspace.writing(), tempfile.TemporaryDirectory(prefix="refield-") as scratch:
        if given is None:
            how = Placing(options.intake, options.localize, models.describer)
            placed = placed_photos(options.photos, workspace, clock, how)
        else:
            placed = [PlacedPhoto(frame.name, "used", frame=frame) for frame in given]
        frames = [photo.frame for photo in placed if photo.frame is not None]
        clock.stage("load the field")
        number = workspace.visits
        old = state(workspace, number)
        capture = retouched(capture, old, Path(scratch))
        known = known_objects(old)
        change = estimate_change(
            capture, old, frames, options.estimate, on_stage=clock.stage, models=models, known=known
        ).among(placed)
        _need_a_photo(options.photos, change)
        new = _updated(capture, old, change, options.update, clock)
        clock.stage("report")
        before, after = _shown(old, change), None if new is None else _shown(new, change)
        for note in () if new is None else new.notes:
            clock.warn(note)
        evaluation = None
        if options.evaluation is not None:
            evaluation = evaluate(new or old, options.evaluation, old=old if new else None)
        with workspace.new_visit() as folder:
            workspace.keep_change(folder, change)
            if new is not None:
                save_updated(folder, new)
            clock.stop()
            title = f"{options.work.resolve().name}, visit {number + 1}"
            report = page(title, change, (before, after), clock, evaluation, facts or {})
            report = replace(report, world=workspace.world(), number=number + 1, old_frames=capture.frames)
            write_report(folder, report)
            if new is not None and report.evaluation_views:
                write_contact_sheet(folder / SHEET, report.evaluation_views)
        link_next(workspace.visit(number) / PAGE, number + 1)
    return Visit(workspace.visit(number + 1), change, evaluation)


def _need_a_photo(photos: Path, change: SceneChange) -> None:
    if not change.frames:
        reasons = "; ".join(f"{p.name}: {p.why}" for p in change.photos)
        raise InputError(photos, f"none of the photos could be used ({reasons})", "do they show this scene?")


def _updated(
    capture: Capture, old: Field, change: SceneChange, config: UpdateConfig, clock: Clock
) -> UpdatedField | None:
    """The updated field, None if nothing changed."""
    if not change.objects:
        return None
    with clock.training("update") as line:
        return update_field(capture, old, change, config, on_stage=clock.stage, on_progress=line)


def _shown(field: Field, change: SceneChange) -> list[Tensor]:
    """What a field shows from where each used new photo was taken, (H, W, 3) each, of about `SHOWN` pixels at most."""
    return [render_camera(field, f.camera.within(SHOWN), f.world_from_cam).rgb for f in change.frames]
