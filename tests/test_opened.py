"""`refield.open`: a workspace from Python is the workspace of the command line, step for step."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import refield
from refield.artefacts import locked
from refield.cli import main
from refield.field.render import render_frame
from refield.scene.change import ObjectChange, OccupancyGrid
from refield.scene.images import read_image, write_image
from refield.update.config import UpdateConfig
from refield.update.fit_helper import HelperConfig
from refield.update.relight import RelightConfig
from refield.visits.make import VisitConfig
from tests.folders import contents
from tests.test_cli import FEW, believing

CONFIG = VisitConfig(
    update=UpdateConfig(fit=HelperConfig(steps=2, samples=512), relight=RelightConfig(still=False, moved=False))
)
"""what `FEW` says on the command line"""


@pytest.fixture
def place(tiny, tmp_path, monkeypatch):
    for name in ("data", "new", "work"):
        shutil.copytree(tiny / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def what_was_found(visit: Path) -> dict:
    """A report without what differs from run to run."""
    report = json.loads((visit / "report.json").read_text())
    return {k: v for k, v in report.items() if k not in ("made", "seconds")} | {"stages": list(report["seconds"])}


def test_a_scene_is_what_the_workspace_holds(place):
    scene = refield.open("work")
    assert repr(scene) == "<refield scene in work: 0 visits>" and scene.path == Path("work")
    assert scene.visits == () and len(scene.capture().frames) == 12
    view = scene.capture().frames[0]
    shown = scene.render(view)
    assert shown.rgb.shape == (24, 32, 3) and shown.depth.shape == shown.opacity.shape == (24, 32)
    assert torch.equal(shown.rgb, render_frame(refield.Workspace.open("work").field(), view).rgb)
    aside = view.world_from_cam.clone()
    aside[:3, 3] += 0.3 * aside[:3, 0]
    camera = view.camera.scaled(16, 12)
    assert torch.equal(scene.render(camera, view.world_from_cam).rgb, scene.render(replace(view, camera=camera)).rgb)
    assert not torch.equal(scene.render(view, aside).rgb, shown.rgb)
    assert scene.field() is scene.field(0)  # read once
    with pytest.raises(refield.InputError, match="has had no visit; update it first"):
        scene.change()
    with pytest.raises(refield.InputError, match="there is no visit 1; give one of 0"):
        scene.field(1)


def test_an_update_from_python_is_that_of_the_command_line(place, monkeypatch, capsys, caplog):
    shutil.copytree("work", "other")
    shutil.move("other", place / "elsewhere" / "work")  # by the same name, which the report tells
    believing(monkeypatch, "moved", "added")
    assert main(["update", "elsewhere/work", "new", "--evaluation", "new", *FEW, "--update.fit.check-every", "1"]) == 0
    scene, stages, looks = refield.open(place / "work"), [], []
    config = replace(CONFIG, update=replace(CONFIG.update, fit=replace(CONFIG.update.fit, check_every=1)))
    made = scene.update("new", config, evaluation="new", on_stage=stages.append, on_progress=looks.append)
    assert capsys.readouterr().err.count("load the field") == 1  # of the command; Python hears, and prints nothing
    here, there = contents(place / "work"), contents(place / "elsewhere/work")
    told = {f"visits/001/{name}" for name in ("report.json", "report.html")}  # they hold seconds
    assert here.keys() == there.keys() and {k for k in here if here[k] != there[k]} <= told
    assert what_was_found(place / "work/visits/001") == what_was_found(place / "elsewhere/work/visits/001")
    assert stages[0] == "load the field" and stages[-1] == "report" and [look.step for look in looks] == [1, 2]

    assert made.number == 1 and made.sheet.is_file() and made.evaluation.pooled.psnr > 0
    assert [o.kind for o in made.change.objects] == ["moved", "added"]
    assert main(["visits", "work", "--json"]) == 0
    assert [v["visit"] for v in json.loads(capsys.readouterr().out)["visits"]] == [1]


def test_visits_are_seen_rendered_and_taken_back(place, monkeypatch, capsys):
    before, scene = contents(place / "work"), refield.open("work")
    view = scene.capture().frames[0]
    was = scene.render(view).rgb
    believing(monkeypatch, "removed")
    scene.update(Path("new"), CONFIG)
    believing(monkeypatch)
    assert main(["update", "work", "new"]) == 0  # an open scene sees what the command line does
    first, second = scene.visits
    assert repr(first) == "<visit 1: 1 object changed: 1 removed; seen in 3 new photos (1 rejected).>"
    assert "Nothing changed" in second.summary and second.report["why"] == "because" and first.html.is_file()
    assert scene.change(1).objects[0].masks and not scene.change().objects
    now = scene.render(view).rgb
    assert torch.equal(scene.render(view, visit=0).rgb, was) and not torch.equal(now, was)
    assert scene.field(1) is scene.field(2)  # nothing changed at the second

    capsys.readouterr()
    assert main(["render", "work", "--cameras", "data/transforms.json", "--out", "pictures"]) == 0
    written = read_image(place / "pictures/000.png")
    assert torch.equal(written, (now.clamp(0, 1) * 255).round().to(torch.uint8))
    assert scene.undo() == 2 and main(["undo", "work"]) == 0
    assert scene.visits == () and torch.equal(scene.render(view).rgb, was) and contents(place / "work") == before
    with pytest.raises(refield.InputError, match="nothing to take back"):
        scene.undo()


def test_frames_are_new_photos_too(place, monkeypatch, caplog):
    scene = refield.open("work")
    frames = refield.load_new_photos("new", scene.capture())
    believing(monkeypatch, "removed")
    with caplog.at_level(logging.WARNING, "refield"):
        scene.update(frames, CONFIG)
        by_hand = contents(place / "work")
        scene.undo()
        scene.update("new/transforms.json", CONFIG)
    by_folder = contents(place / "work")
    told = {f"visits/001/{name}" for name in ("report.json", "report.html")}
    assert {k for k in by_hand if by_hand[k] != by_folder[k]} <= told
    with pytest.raises(refield.InputError, match="the new photos: there are none; give one or more"):
        scene.update([], CONFIG)
    with pytest.raises(refield.InputError, match=r"several are called 'images/000.png'"):
        scene.update([frames[0], frames[0]], CONFIG)
    frames[1].path.unlink()
    with pytest.raises(refield.InputError, match="there is no such image"):
        scene.update(frames, CONFIG)
    assert len(scene.visits) == 1


def test_what_cannot_be_used_leaves_the_workspace_as_it_was(place):
    scene, before = refield.open("work"), contents(place / "work")
    with pytest.raises(refield.InputError, match="nowhere: there is no such file or folder"):
        scene.update("nowhere")
    with pytest.raises(refield.InputError, match="being written by another refield"), locked(place / "work"):
        scene.update("new")
    with pytest.raises(refield.InputError, match="is not a refield workspace; make one with: refield train DATA new"):
        refield.open("new")
    assert contents(place / "work") == before


def test_wrong_types_are_told_in_a_sentence(place):
    """A row each: what is called, and the sentence."""
    scene, workspace = refield.open("work"), refield.Workspace.open("work")
    capture = refield.load_capture("data")
    frames, field = refield.load_new_photos("new", capture), scene.field()
    before = contents(place)
    rows = [
        (lambda: refield.open(7), "the workspace is an int (7); give a path, as text or as a pathlib.Path"),
        (lambda: refield.open(None), "the workspace is None; give a path"),
        (lambda: refield.Workspace.open(scene), "the workspace is a Scene; give a path"),
        (lambda: refield.load_capture(capture), "the capture to load is a Capture; give a path"),
        (
            lambda: refield.load_new_photos("new", "data"),
            "the capture is a str ('data'); give a Capture, as refield.load",
        ),
        (lambda: refield.load_new_photos(capture, "new"), "the new photos to load is a Capture; give a path"),
        (lambda: refield.fit_field("data"), "the capture is a str ('data'); give a Capture"),
        (
            lambda: refield.fit_field(capture, 100),
            "the config of a fit is an int (100); give a refield.field.fit.FitConfig",
        ),
        (lambda: refield.estimate_change(field, capture, frames), "the capture is a HashField; give a Capture"),
        (
            lambda: refield.estimate_change(capture, "work", frames),
            "the field is a str ('work'); give one as refield.fit",
        ),
        (
            lambda: refield.estimate_change(capture, field, "new"),
            "what is given as frames is a str ('new'); give a list",
        ),
        (lambda: refield.estimate_change(capture, field, ["new"]), "frame 0 is a str ('new'); give a list of frames"),
        (lambda: refield.update_field(capture, field, frames), "the change is a list; give a SceneChange"),
        (lambda: refield.render_frame(field, "000.png"), "the frame to render is a str ('000.png'); give a Frame"),
        (
            lambda: refield.render_frame(frames[0], field),
            "the field is a Frame; give one as refield.fit_field makes it",
        ),
        (lambda: refield.write_image("a.png", "b.png"), "the picture is a str ('b.png'); give a tensor (H, W, 3)"),
        (lambda: refield.known_by(capture, "work"), "what is given as the capture's landmarks is a str ('work')"),
        (lambda: refield.localize_photos("new", capture, "cache"), "what the photos are placed in is a Capture; give"),
        (lambda: refield.capture_from_photos("new", None), "the cache is None; give a path"),
        (lambda: workspace.field().save(3), "the field's folder is an int (3); give a path"),
        (lambda: scene.update(4), "what is given as new photos is an int (4); give their folder"),
        (
            lambda: scene.update(["new/images/000.png"]),
            "new photo 0 is a str ('new/images/000.png'); give their folder",
        ),
        (lambda: scene.update("new", FEW), "the config of an update is a list; give a refield.visits.make.VisitConfig"),
        (lambda: scene.render("000.png"), "the view to render is a str ('000.png'); give a Frame, or a Camera"),
        (lambda: scene.render(frames[0].camera), "the camera's pose, world_from_cam, is None; give a (4, 4) tensor"),
        (lambda: scene.field("1"), "the number of a visit is a str ('1'); give a whole number"),
    ]
    for call, sentence in rows:
        with pytest.raises(TypeError) as caught:
            call()
        assert str(caught.value).startswith(sentence), (sentence, str(caught.value))
    with pytest.raises(refield.InputError, match="the new photos: there are none"):
        refield.estimate_change(capture, field, [])
    with pytest.raises(ValueError, match=r"a picture of the shape \(4, 4, 7\) cannot be written"):
        refield.write_image("a.png", torch.zeros(4, 4, 7))
    assert contents(place) == before


@pytest.mark.parametrize("kind", [str, Path])
def test_text_and_paths_are_alike(place, kind):
    capture = refield.load_capture(kind("data"))
    assert len(refield.load_new_photos(kind("new/transforms.json"), capture)) == 4
    refield.write_image(kind("out/a.png"), torch.zeros(3, 4, 3))
    assert read_image(place / "out/a.png").shape == (3, 4, 3)
    field = refield.open(kind("work")).field()
    field.save(kind("out"))
    assert refield.HashField.load(kind("out")).config == field.config
    with refield.Workspace.building(kind("mine")) as workspace:
        workspace.keep_capture(capture)
        workspace.keep_field(field)
    assert refield.open(kind("mine")).visits == () and refield.Workspace.made_by(kind("mine")) == "train"


def pictures(html: str) -> int:
    return html.count('<img src="data:image/jpeg;base64,')


def test_notebooks_show_captures_changes_and_fields(place, monkeypatch):
    scene = refield.open("work")
    capture = scene.capture()
    assert repr(capture) == "Capture(12 photos, 1 held out, 0 points)"
    assert repr(capture.frames[0]).startswith("Frame('images/0000.png', 32 x 24, at (3, 0, 1.2))")
    html = capture._repr_html_()
    assert pictures(html) == 6 and "32 x 24, focal length 40 px" in html
    assert "HashField(hash grid of 2 levels" in repr(scene.field()) and len(repr(scene.field())) < 300
    assert "networks" in scene.field()._repr_html_()
    believing(monkeypatch, "moved", "added")
    visit = scene.update("new", CONFIG)
    change = scene.change()
    assert "moved from (0, 0, 0) by 0.5, turned 0.0°, confidence 1.00" in repr(change)
    html = change._repr_html_()
    assert pictures(html) == 3 and "blurred" in html and "<td" in html and "because" in html
    html = scene.field()._repr_html_()
    assert pictures(html) == 2 and "1 moved, 1 added" in html
    assert repr(scene.field()).startswith("UpdatedField(1 moved, 1 added; before: HashField(")
    html = scene._repr_html_()
    assert (place / "work/visits/001/report.html").as_uri() in html and pictures(html) == 6
    assert visit.html.resolve().as_uri() in visit._repr_html_()
    assert scene.render(capture.frames[0])._repr_png_()[:4] == b"\x89PNG"


def test_what_a_notebook_shows_is_escaped_and_may_lack_its_photos(place):
    capture = refield.load_capture("data")
    strange = [replace(f, name="<script>", path=Path("gone.png")) for f in capture.frames[:1]]
    html = replace(capture, frames=tuple(strange))._repr_html_()
    assert "<script>" not in html and "&lt;script&gt;" in html and "no picture" in html and pictures(html) == 0


def test_masks_are_laid_over_the_photos(place):
    """What is new is seen in its colour on the thumbnail."""
    from refield.scene.notebook import inked, thumbnail

    write_image(Path("grey.png"), torch.full((48, 64, 3), 0.5))
    frame = replace(refield.load_capture("data").frames[0], path=Path("grey.png"))
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[:, :32] = True
    image = inked(thumbnail(frame), [(mask, (255, 0, 0))])
    (left, right) = (image.getpixel((x, 24)) for x in (8, 56))
    assert left[0] > 160 and left[1] < 90 and right == (128, 128, 128)


def test_objects_say_what_became_of_them():
    grid = OccupancyGrid(torch.tensor([[0.0, 0, 0], [1, 1, 1]]), torch.ones(3, 4, 5))
    gone = ObjectChange("removed", grid, confidence=0.5)
    assert repr(gone) == "ObjectChange(removed at (0.5, 0.5, 0.5), confidence 0.50)" and gone.turn_deg is None
    assert repr(grid).startswith("OccupancyGrid(3 x 4 x 5, from (")
    assert repr(refield.SceneChange()) == "SceneChange(nothing changed; 0 of 0 photos used)"
