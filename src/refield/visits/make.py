"""One visit, made whole or not at all: new photos → what changed, the field brought up to date, a report."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from refield.estimate.localize import LocalizeConfig
from refield.estimate.models import Models
from refield.estimate.recipe import EstimateConfig, estimate_change
from refield.evaluate import evaluate, looked_over
from refield.field.radiance import Field
from refield.field.render import render_camera
from refield.field.volrend import Rendering
from refield.history import known_objects, retouched, state
from refield.photos.sources import find_sources
from refield.photos.taken import PhotoConfig
from refield.report import PAGE, is_our_page, link_next, write_contact_sheet, write_report
from refield.scene.capture import Capture, Frame, check_frames
from refield.scene.change import PlacedPhoto, SceneChange
from refield.scene.errors import InputError
from refield.scene.images import frame_image
from refield.scene.load import is_posed, load_new_photos
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.paper.field import PaperField
from refield.update.paper.route import need_nerfacto
from refield.update.store import save_updated
from refield.update.train import update_field
from refield.visits.page import page
from refield.visits.placing import Placing, placed_photos
from refield.visits.telling import Telling
from refield.visits.visit import SHEET, Visit
from refield.workspace import Workspace

SHOWN = 256 * 256
"""pixels, about and at most, of what a field shows of a new photo on the page"""


@dataclass(frozen=True)
class VisitConfig:
    """Every step's settings."""

    intake: PhotoConfig = field(default_factory=PhotoConfig)
    """photos without poses: how they are taken in"""
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    """photos without poses: how they are placed"""
    estimate: EstimateConfig = field(default_factory=EstimateConfig)
    """what changed"""
    update: UpdateConfig = field(default_factory=UpdateConfig)
    """how the field is brought up to date"""


def make_visit(
    workspace: Workspace,
    photos: Path | Sequence[Frame],
    telling: Telling,
    config: VisitConfig = VisitConfig(),
    *,
    evaluation: Path | None = None,
    facts: Mapping[str, float | str] | None = None,
) -> Visit:
    """Estimate, update, report: one visit, published whole or not at all.

    Args:
        photos: the new photos' folder, a transforms.json, or frames with poses in the capture's world.
        evaluation: a folder of further photos with poses to measure by.
        facts: further numbers for the report.

    Raises:
        InputError: unusable photos, or the workspace is being written.
    """
    capture = workspace.capture()
    given = _given(photos, capture, telling)
    if evaluation is not None:
        looked_over(evaluation)
    models = config.estimate.models.open()
    with workspace.writing(), tempfile.TemporaryDirectory(prefix="refield-") as scratch:
        if given is not None:
            placed = [PlacedPhoto(frame.name, "used", frame=frame) for frame in given]
        else:
            assert isinstance(photos, Path)
            placed = placed_photos(
                photos, workspace, telling, Placing(config.intake, config.localize, models.describer)
            )
        frames = [photo.frame for photo in placed if photo.frame is not None]
        telling.stage("load the field")
        number = workspace.visits
        old = state(workspace, number)
        if config.update.route != "refield":
            need_nerfacto(old, workspace.path)
        capture = retouched(capture, old, Path(scratch))
        change = _estimated(capture, old, frames, config.estimate, models, telling).among(placed)
        _need_a_photo(photos, change)
        new = _updated(capture, old, change, config.update, telling)
        telling.stage("report")
        before, after = _shown(old, change), None if new is None else _shown(new, change)
        for note in () if new is None else new.notes:
            telling.warn(note)
        measured = None
        if evaluation is not None:
            measured = evaluate(new or old, evaluation, old=old if new else None)
        with workspace.new_visit() as folder:
            workspace.keep_change(folder, change)
            if new is not None:
                save_updated(folder, new)
            telling.stop()
            title = f"{workspace.path.resolve().name}, visit {number + 1}"
            report = page(title, change, (before, after), telling, measured, facts or {})
            report = replace(report, world=workspace.world(), number=number + 1, old_frames=capture.frames)
            write_report(folder, report)
            if new is not None and report.evaluation_views:
                write_contact_sheet(folder / SHEET, report.evaluation_views)
        link_next(workspace.visit(number) / PAGE, number + 1)
    return Visit(number + 1, workspace.visit(number + 1), change, measured)


def take_back(workspace: Workspace) -> int:
    """Remove the last visit, as if its photos had never been given. Returns its number.

    Raises:
        InputError: there is none, or the workspace is being written.
    """
    with workspace.writing():
        number = workspace.visits
        if number == 0:
            what = "has had no visit, so there is nothing to take back"
            raise InputError(workspace.path, what, f"make one with: refield update {workspace.path} PHOTOS")
        workspace.drop_last_visit()
        link_next(workspace.visit(number - 1) / PAGE, None)
        history = workspace.path / PAGE  # it would tell of the visit, and link to it
        if is_our_page(history):
            with contextlib.suppress(OSError):
                history.unlink()
    return number


def _given(photos: Path | Sequence[Frame], capture: Capture, telling: Telling) -> list[Frame] | None:
    """The new photos that have poses; None if they are to be placed. Whatever cannot be used is found here."""
    if not isinstance(photos, Path):
        check_frames(photos)
        for frame in photos:
            frame_image(frame)
        return list(photos)
    if is_posed(photos):
        return load_new_photos(photos, capture, warn=telling.warn)
    find_sources(photos)
    return None


def _need_a_photo(photos: Path | Sequence[Frame], change: SceneChange) -> None:
    if not change.frames:
        reasons = "; ".join(f"{p.name}: {p.why}" for p in change.photos)
        where = photos if isinstance(photos, Path) else "the new photos"
        raise InputError(where, f"none of the photos could be used ({reasons})", "do they show this scene?")


def _estimated(
    capture: Capture, old: Field, frames: Sequence[Frame], config: EstimateConfig, models: Models, telling: Telling
) -> SceneChange:
    with telling.counters() as counting:
        line = cache(lambda: counting("explanations tried"))  # begun when there is something to count
        return estimate_change(
            capture, old, frames, config, on_stage=telling.stage, models=models, known=known_objects(old),
            on_count=lambda done, total: line()(done, total),
        )  # fmt: skip


def _updated(
    capture: Capture, old: Field, change: SceneChange, config: UpdateConfig, telling: Telling
) -> UpdatedField | PaperField | None:
    """The updated field, None if nothing changed."""
    if not change.objects:
        return None
    with telling.training("update") as line:
        return update_field(capture, old, change, config, on_stage=telling.stage, on_progress=line)


def _shown(field: Field, change: SceneChange) -> list[Rendering]:
    """What a field shows from where each used new photo was taken, of about `SHOWN` pixels at most."""
    return [render_camera(field, f.camera.within(SHOWN), f.world_from_cam) for f in change.frames]
