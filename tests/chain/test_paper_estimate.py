"""The paper's estimate on a fitted field with nothing but what needs no weights: GrabCut, its colours, SIFT."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from refield.cli import main
from refield.estimate.paper.config import PaperConfig
from refield.estimate.paper.refine import RefineConfig
from refield.estimate.paper.route import estimate_change_paper
from refield.evaluate import pose_error
from refield.scene.load import load_new_photos
from refield.synthetic.worlds import WORLDS
from refield.workspace import Workspace

pytestmark = pytest.mark.chain

CONFIG = dataclasses.replace(PaperConfig(), survey=4, refine=RefineConfig(rays=1024, steps=200))
FARTHEST, MOST_TURNED = 0.01, 1.5  # metres, degrees


def test_the_papers_estimate_without_weights(tmp_path: Path) -> None:
    world, work = WORLDS["cube"](0), str(tmp_path / "work")
    assert main(["synth", "cube", str(tmp_path), "--size", "160", "--spp", "24", "--cameras", "40"]) == 0
    assert main(["train", str(tmp_path / "before"), work, "--fit.steps", "1000"]) == 0
    workspace = Workspace.open(Path(work))
    capture = workspace.capture()
    frames = load_new_photos(tmp_path / "after", capture)
    change = estimate_change_paper(capture, workspace.field(), frames, config=CONFIG)
    (true,), (found,) = world.changes, change.objects
    assert found.kind == "moved", change.why
    assert true.old is not None and true.new_from_old is not None and found.new_from_old is not None
    distance, turn = pose_error(found.new_from_old, true.new_from_old, true.old.world_from_item[:3, 3])
    assert distance < FARTHEST and turn < MOST_TURNED, (distance, turn, change.why)
