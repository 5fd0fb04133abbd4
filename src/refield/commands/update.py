"""``refield update WORK PHOTOS``: a few new photos → what changed, and the field of the scene as it is."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from torch import Tensor
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer, Exit
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.commands.page import page
from refield.commands.placing import Placing, placed_photos
from refield.commands.visits import visit_facts
from refield.estimate.localize import LocalizeConfig
from refield.estimate.recipe import EstimateConfig, estimate_change
from refield.evaluate import Report, evaluate, looked_over
from refield.field.radiance import Field
from refield.field.render import render_camera
from refield.history import changed_visits, known_objects, retouched, state
from refield.photos.sources import find_sources
from refield.photos.taken import PhotoConfig
from refield.report import summary, write_contact_sheet, write_report
from refield.scene.capture import Capture
from refield.scene.change import PlacedPhoto, SceneChange
from refield.scene.errors import InputError
from refield.scene.files import read_json
from refield.scene.load import is_posed, load_new_photos
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.store import save_updated
from refield.update.train import update_field
from refield.workspace import Workspace

SHOWN = 256 * 256
"""pixels, about and at most, of what a field shows of a new photo on the page"""
SHEET = "before-after.png"
_USUAL = {
    "detect": 3.6, "hull": 1.3, "pose": 5.2, "segment": 0.4, "move": 1.2, "light": 2.8, "supervise": 4.0,
    "freeze": 2.3, "train": 3.4, "show": 1.0, "report": 3.4,
}  # fmt: skip
"""seconds that the stages of the demo's update take on two cores"""
_SURE = 10.0  # seconds
EXAMPLES = (
    "refield update work after",
    "refield update work after --exit-code --json > change.json",
)


@dataclass(frozen=True)
class Update:
    """Find out from a few new photos what moved, left or arrived, and bring the field up to date."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    photos: Annotated[Path, arg(metavar="PHOTOS"), Positional]
    """the new photos: their folder; or a transforms.json or its folder, with poses in the world of the old ones"""
    evaluation: Path | None = None
    """a folder of further photos (transforms.json, images/, masks_in/, masks_out/) to measure by"""
    exit_code: Annotated[bool, FlagCreatePairsOff] = False
    """end with 10 if objects changed, 11 if something changed that is not understood, 0 if nothing did"""
    intake: PhotoConfig = field(default_factory=PhotoConfig)
    """photos without poses: how they are taken in"""
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    """photos without poses: how they are placed"""
    estimate: EstimateConfig = field(default_factory=EstimateConfig)
    update: UpdateConfig = field(default_factory=UpdateConfig)
    output: OmitArgPrefixes[Output] = PLAIN


@dataclass(frozen=True)
class Visit:
    """What an update has made."""

    folder: Path
    change: SceneChange
    evaluation: Report | None

    @property
    def html(self) -> Path:
        return self.folder / "report.html"

    @property
    def sheet(self) -> Path:
        """The evaluation's views before and after; there is none without an evaluation or a change."""
        return self.folder / SHEET


def run(options: Update) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    _expect(Workspace.open(options.work), clock)
    visit = update(options, clock)
    change = visit.change
    unclear = change.objects or change.unexplained
    words = [summary(change) if unclear else "nothing changed", change.why, f"report: {visit.html}"]
    code = Exit.CHANGED if change.objects else Exit.UNCLEAR if change.unexplained else Exit.DONE
    document = facts_of(options.work, visit) | {"warnings": clock.warnings, "seconds_per_stage": clock.seconds}
    return Answer(document, [line for line in words if line], code if options.exit_code else Exit.DONE)


def _expect(workspace: Workspace, clock: Clock) -> None:
    """As long as the workspace's last visit that changed something; without one the stages' shares are the usual."""
    for number in reversed(changed_visits(workspace, workspace.visits)):
        report = workspace.visit(number) / "report.json"
        taken = read_json(report).get("seconds", {}) if report.is_file() else {}
        if isinstance(taken, dict) and _USUAL.keys() <= taken.keys():
            stages = {name: float(taken[name] or 0) for name in ("localize", *_USUAL) if name in taken}
            return clock.expect(stages, sure=_SURE)
    clock.expect(_USUAL)


def facts_of(work: Path, visit: Visit) -> dict[str, Any]:
    """A visit as ``refield visits --json`` tells it, its photos one by one, and the numbers of its evaluation."""
    return {
        "workspace": work,
        **visit_facts(Workspace(work), int(visit.folder.name)),
        "photos": [{"name": p.name, "status": p.status, "why": p.why} for p in visit.change.photos],
        "evaluation": None if visit.evaluation is None else visit.evaluation.to_dict(),
    }


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
            write_report(folder, replace(report, world=workspace.world()))
            if new is not None and report.evaluation_views:
                write_contact_sheet(folder / SHEET, report.evaluation_views)
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
