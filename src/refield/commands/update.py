"""``refield update WORK PHOTOS``: a few new photos → what changed, and the field of the scene as it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer, Exit
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.commands.visits import visit_facts
from refield.estimate.localize import LocalizeConfig
from refield.estimate.recipe import EstimateConfig
from refield.history import changed_visits
from refield.photos.taken import PhotoConfig
from refield.report import summary
from refield.scene.files import read_json
from refield.update.config import UpdateConfig
from refield.visits.make import VisitConfig, make_visit
from refield.visits.visit import Visit
from refield.workspace import Workspace

_USUAL = {
    "detect": 3.6, "hull": 1.3, "pose": 5.2, "segment": 0.4, "move": 1.2, "light": 2.8, "supervise": 4.0,
    "freeze": 2.3, "train": 3.4, "show": 1.0, "report": 3.4,
}  # fmt: skip
"""seconds that the stages of the demo's update take on two cores"""
_SURE = 10.0  # seconds
EXAMPLES = (
    "refield update work after",
    "refield update work after --exit-code --json > change.json",
    "refield update work after --route paper-reduced",
)


@dataclass(frozen=True)
class Update:
    """Find out from a few new photos what moved, left or arrived, and bring the field up to date."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    photos: Annotated[Path, arg(metavar="PHOTOS"), Positional]
    """the new photos: their folder; or a transforms.json or its folder, with poses in the world of the old ones"""
    route: Literal["refield", "paper", "paper-reduced"] | None = None
    """the steps of refield, those of the paper, or these with fewer rays, for a CPU. Those of the paper take a
    workspace that refield train made with the same option. Sets both estimate.route and update.route, which choose one
    half each"""
    evaluation: Path | None = None
    """a folder of further photos, to measure by. With transforms.json, images/, masks_in/ and masks_out/"""
    exit_code: Annotated[bool, FlagCreatePairsOff] = False
    """end with 10 if objects changed, 11 if something changed that is not understood, 0 if nothing did"""
    intake: PhotoConfig = field(default_factory=PhotoConfig)
    """photos without poses: how they are taken in"""
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    """photos without poses: how they are placed"""
    estimate: EstimateConfig = field(default_factory=EstimateConfig)
    update: UpdateConfig = field(default_factory=UpdateConfig)
    output: OmitArgPrefixes[Output] = PLAIN


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
        **visit_facts(Workspace(work), visit.number),
        "photos": [{"name": p.name, "status": p.status, "why": p.why} for p in visit.change.photos],
        "evaluation": None if visit.evaluation is None else visit.evaluation.to_dict(),
    }


def _by_route(options: Update) -> tuple[EstimateConfig, UpdateConfig]:
    """How to estimate and how to update, ``--route`` first."""
    if options.route is None:
        return options.estimate, options.update
    estimate = replace(options.estimate, route="refield" if options.route == "refield" else "paper")
    return estimate, replace(options.update, route=options.route)


def update(options: Update, clock: Clock, facts: Mapping[str, float | str] | None = None) -> Visit:
    """One visit, see `refield.visits.make.make_visit`.

    Raises:
        InputError: no workspace, or unusable photos.
    """
    config = VisitConfig(options.intake, options.localize, *_by_route(options))
    workspace = Workspace.open(options.work)
    return make_visit(workspace, options.photos, clock, config, evaluation=options.evaluation, facts=facts)
