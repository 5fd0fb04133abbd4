"""``refield update WORK PHOTOS``: a few new photos → what changed, and the field of the scene as it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from refield.commands.clock import Clock
from refield.estimate.localize import LocalizeConfig
from refield.estimate.recipe import EstimateConfig
from refield.photos.taken import PhotoConfig
from refield.report import summary
from refield.update.config import UpdateConfig
from refield.visits.make import VisitConfig, make_visit
from refield.visits.visit import Visit
from refield.workspace import Workspace


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


def run(options: Update) -> None:
    clock = Clock()
    visit = update(options, clock)
    unclear = visit.change.objects or visit.change.unexplained
    print(summary(visit.change) if unclear else "nothing changed")
    if visit.change.why:
        print(visit.change.why)
    print(f"report: {visit.html}")


def update(options: Update, clock: Clock, facts: Mapping[str, float | str] | None = None) -> Visit:
    """One visit, see `refield.visits.make.make_visit`.

    Raises:
        InputError: no workspace, or unusable photos.
    """
    config = VisitConfig(options.intake, options.localize, options.estimate, options.update)
    workspace = Workspace.open(options.work)
    return make_visit(workspace, options.photos, clock, config, evaluation=options.evaluation, facts=facts)
