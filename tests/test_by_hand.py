"""Things moved by hand: picked out of the field, kept as a visit without photos, told as such, taken back."""

import json
import shutil

import pytest
import torch

import refield
from refield.cli import main
from refield.field.render import render_many
from refield.scene.capture import Rays
from refield.scene.pose import exp
from refield.visits.picking import surface_at
from tests.export.solid import BOX, CELL, make_workspace
from tests.folders import contents

NEW_FROM_OLD = exp(torch.tensor([0.9, 0.3, 0.0, 0.0, 0.0, 0.4], dtype=torch.float64))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("by_hand")
    make_workspace(folder)
    return folder / "work"


@pytest.fixture
def work(made, tmp_path):
    shutil.copytree(made, tmp_path / "work")
    return tmp_path / "work"


def height_at(field, x, y):
    """Of the surface above a point of the ground, seen from above."""
    rays = Rays(torch.tensor([[x, y, 1.5]]), torch.tensor([[0.0, 0.0, -1.0]]))
    return 1.5 - float(render_many(field, rays).depth[0])


def test_a_thing_is_cut_out_by_a_point_on_it(made):
    scene = refield.open(made)
    at = surface_at(scene.field(), torch.tensor([0.1, 0.1, 1.5]).double(), torch.tensor([0.0, 0.0, -1.0]).double())
    assert at is not None and float(at[2]) == pytest.approx(0.25, abs=2 * CELL)
    grid = scene.thing_at(at)
    assert grid is not None
    assert torch.allclose(grid.tight_aabb(), BOX, atol=3 * CELL)
    assert scene.thing_at(torch.tensor([0.7, 0.7, -0.25])) is None  # the ground
    assert scene.thing_at(torch.tensor([0.0, 0.0, 1.0])) is None  # the air
    with pytest.raises(TypeError, match=r"the place of a thing is None; give a world point"):
        scene.thing_at(None)


def test_a_move_by_hand_is_a_visit(work, capsys):
    scene = refield.open(work)
    before = contents(work)
    grid = scene.thing_at(torch.tensor([0.1, 0.1, 0.25]))
    visit = scene.move(grid, NEW_FROM_OLD)
    assert visit.number == 2 and visit.summary == "1 object changed: 1 moved; by hand."
    assert scene.change().by_hand and scene.change().photos == () and not scene.change(1).by_hand
    x, y = NEW_FROM_OLD[:2, 3].tolist()
    assert height_at(scene.field(1), 0, 0) == pytest.approx(0.25, abs=2 * CELL)
    assert height_at(scene.field(2), x, y) == pytest.approx(0.25, abs=2 * CELL)
    assert height_at(scene.field(2), 0, 0) < 0 and height_at(scene.field(1), x, y) < 0
    (now,) = (g for g in scene.things() if bool(g.contains(torch.tensor([x, y, 0.0]))))
    assert float((now.centre[:2] - NEW_FROM_OLD[:2, 3]).norm()) < CELL
    page = visit.html.read_text()
    assert "One object moved, by hand" in page and "moved by hand" in page and page.count("<img") >= 2
    assert main(["visits", str(work)]) == 0
    assert "by hand" in capsys.readouterr().out
    assert main(["visits", str(work), "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["visits"]
    assert [v["by_hand"] for v in listed] == [False, True]
    assert main(["report", str(work)]) == 0 and "One object moved, by hand" in (work / "report.html").read_text()
    assert main(["undo", str(work)]) == 0
    assert contents(work) == before


@pytest.mark.parametrize(
    ("motion", "fault"),
    [
        (torch.eye(3), r"no \(4, 4\) of finite numbers"),
        (torch.full((4, 4), torch.nan), r"no \(4, 4\) of finite numbers"),
        (torch.diag(torch.tensor([2.0, 1, 1, 1])), "not rigid"),
        (torch.diag(torch.tensor([-1.0, 1, 1, 1])), "not rigid"),
        (torch.eye(4), "leaves the thing where it is"),
    ],
)
def test_motions_that_are_none(made, motion, fault):
    scene, before = refield.open(made), contents(made)
    grid = scene.change(1).objects[1].grid
    with pytest.raises(refield.InputError, match=fault):
        scene.move(grid, motion)
    with pytest.raises(TypeError, match=r"the thing to move is None; give one of scene\.things"):
        scene.move(None, motion)
    assert contents(made) == before
