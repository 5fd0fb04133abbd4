"""What is shown in Python is run as it stands, scripts with their arguments and the README line by line, on a scene
that is tiny: the steps' settings are small, and what several ask for alike, a fit or an estimate, is made once. The
manual's tour is walked on the demo's scene."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path
from urllib.request import urlopen

import pytest
import torch

import refield
from refield.cli import main
from refield.estimate import recipe
from refield.estimate.hull import HullConfig
from refield.estimate.outline import ObjectConfig
from refield.estimate.pose_change import RefineConfig
from refield.estimate.recipe import EstimateConfig
from refield.estimate.register import RegisterConfig
from refield.field import fit
from refield.scene.images import read_image
from refield.update.config import UpdateConfig
from refield.update.fit_helper import HelperConfig
from refield.update.train import update_field
from refield.view.server import Viewer
from refield.visits import opened
from refield.visits.make import VisitConfig
from tests.changed import FIT, FIT_OPTIONS, Changed, write_changed
from tests.test_manual import typed

pytestmark = pytest.mark.chain  # a minute or two in all
ROOT = Path(__file__).parent.parent
FEW = UpdateConfig(fit=HelperConfig(steps=40))
COARSE = EstimateConfig(
    hull=HullConfig(longest=64),
    objects=ObjectConfig(longest=48, rays=20000),
    register=RegisterConfig(rotations=200, turns=24),
    refine=RefineConfig(rays=(2000, 8000), detail_rays=8000),
)


@pytest.fixture(scope="module")
def changed(tmp_path_factory) -> Changed:
    return write_changed(tmp_path_factory.mktemp("changed"))


@pytest.fixture(scope="module")
def known() -> dict:
    """What was made, by what it was made from."""
    return {}


@pytest.fixture(scope="module")
def work(changed, tmp_path_factory) -> Path:
    """To be copied before anything is written."""
    folder = tmp_path_factory.mktemp("made") / "work"
    assert main(["train", str(changed.folder / "before"), str(folder), *FIT_OPTIONS]) == 0
    return folder


@pytest.fixture
def small(monkeypatch, known):
    """Small settings wherever the defaults are taken."""
    fit_field, estimate_change = fit.fit_field, recipe.estimate_change

    def fitted(capture, config=FIT, on_progress=None):
        key = contents_of(capture.frames)
        if key not in known:
            known[key] = fit_field(capture, FIT, on_progress)
        return known[key]

    def estimated(capture, field, frames, config=COARSE, on_stage=None):
        # the field is kept, so that no other gets its id
        key = contents_of(capture.frames), id(field), contents_of(frames)
        if key not in known:
            known[key] = estimate_change(capture, field, frames, COARSE, on_stage), field
        return known[key][0]

    monkeypatch.setattr(fit, "fit_field", fitted)
    monkeypatch.setattr(recipe, "estimate_change", estimated)
    monkeypatch.setattr(update_field, "__defaults__", (FEW, None, None))
    monkeypatch.setattr(opened.Scene.update, "__defaults__", (VisitConfig(estimate=COARSE, update=FEW),))


def contents_of(frames) -> tuple:
    return tuple((frame.path.read_bytes() if frame.made is None else frame.path) for frame in frames)


@pytest.fixture
def run(small, tmp_path, monkeypatch, capsys):
    """Run an example as a script; what it printed."""
    monkeypatch.chdir(tmp_path)

    def started(name: str, *arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
        return capsys.readouterr().out

    return started


def difference(a: Path, b: Path) -> float:
    """Mean over the pixels, of 255."""
    return float((read_image(a).float() - read_image(b).float()).abs().mean())


def psnr(label: str, text: str) -> float:
    found = re.search(rf"{label}\s*Scores\(psnr=([\d.]+)", text)
    assert found, text
    return float(found[1])


def test_every_example_is_run_here() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    examples = sorted(p.name for p in (ROOT / "examples").glob("*.py"))
    assert len(examples) >= 6 and all(f'run("{name}"' in here for name in examples)


def test_move_a_cube(run, changed, tmp_path) -> None:
    said = run("00_move_a_cube.py", tmp_path / "out", changed.folder)
    found = re.search(r"moved, confidence [\d.]+\s+off by ([\d.]+) cm and ([\d.]+) degrees", said)
    assert found, said
    assert float(found[1]) < 5 and float(found[2]) < 10
    assert psnr("after:", said) > psnr("before:", said) + 2
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["000.png", "001.png"]


def test_your_own_photos(run, changed, tmp_path) -> None:
    said = run("01_your_own_photos.py", changed.folder / "before", changed.folder / "after", tmp_path / "out")
    assert "1 object changed: 1 moved" in said
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "moved" in page and page.count("data:image/") >= 12
    with pytest.raises(SystemExit, match="BEFORE AFTER OUT"):
        run("01_your_own_photos.py", changed.folder)


def test_your_own_field(run, changed, tmp_path) -> None:
    said = run("02_your_own_field.py", tmp_path / "out", changed.folder, 300)
    assert "SceneChange(ObjectChange(moved from" in said
    photo = changed.folder / "after/images/000.png"
    before, after = (difference(tmp_path / "out" / f"{name}.png", photo) for name in ("before", "after"))
    assert after < 0.8 * before


def test_true_change(run, changed, tmp_path) -> None:
    said = run("03_true_change.py", tmp_path / "out", changed.folder)
    assert psnr("with the true change:", said) > 18 and psnr("with the object 2 cm off:", said) > 15
    assert difference(tmp_path / "out/true_change.png", changed.folder / "eval/images/000.png") < 25


def test_update_twice(run, changed, tmp_path) -> None:
    said = run("04_update_twice.py", tmp_path / "out", changed.folder)
    assert float(re.search(r"there and back: ([\d.]+) degrees", said)[1]) < 20
    before, moved, returned = (tmp_path / "out" / f"{n}.png" for n in ("0_before", "1_moved", "2_returned"))
    assert difference(before, returned) < 0.5 * difference(before, moved)


def test_a_workspace(run, changed, work, tmp_path) -> None:
    shutil.copytree(work, tmp_path / "work")
    few = ["--update.fit.steps", "40"]
    assert main(["update", "work", str(changed.folder / "after"), *few]) == 0
    said = run("05_a_workspace.py", "work", "out", changed.folder / "after")
    assert "<visit 1: 1 object changed: 1 moved; seen in 4 new photos.>" in said
    assert "<visit 2: Nothing changed; seen in 4 new photos.>" in said
    assert said.rstrip().endswith("visit 2 is taken back: <refield scene in work: 1 visit>")
    assert difference(tmp_path / "out/before.png", tmp_path / "out/now.png") > 1
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"before.png", "now.png", "nearness.png", "aside.png"}
    with pytest.raises(SystemExit, match="there is no such workspace"):
        run("05_a_workspace.py", "nowhere", "out")


def test_what_the_readme_shows_in_python(small, changed, work, tmp_path, monkeypatch) -> None:
    for name in ("before", "after"):
        shutil.copytree(changed.folder / name, tmp_path / name)
    shutil.copytree(work, tmp_path / "work")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 2
    names: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    photo = changed.folder / "after/images/000.png"
    refield.write_image("old.png", refield.render_frame(names["field"], names["photos"][0]).rgb)
    assert difference(Path("now.png"), photo) < 0.8 * difference(Path("old.png"), photo)
    assert difference(Path("was.png"), Path("is.png")) > 1
    assert [o.kind for o in names["visit"].change.objects] == ["moved"]
    assert torch.allclose(names["visit"].change.objects[0].shift, changed.truth.shift, atol=0.05)
    assert refield.open("work").visits == ()


def test_what_the_readme_shows_to_be_typed(changed, tmp_path, monkeypatch, capsys) -> None:
    """Every command of README.md in its order, with small steps; the demo's line is the tour's, too."""
    for name in ("before", "after"):
        shutil.copytree(changed.folder / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    small, pages = {"train": FIT_OPTIONS, "update": ["--update.fit.steps", "40"], "view": ["--port", "0"]}, []

    def look(viewer) -> None:
        pages.append(urlopen(viewer.url).read())
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "look_again", look)
    monkeypatch.setattr("webbrowser.open", lambda url: pages.append(url))
    lines = [shlex.split(line, comments=True)[1:] for line in typed(ROOT / "README.md")]
    assert [line[0] for line in lines] == ["demo", "check", "train", "update", "render", "view"]
    for command, *arguments in lines[1:]:
        assert main([command, *arguments, *small.get(command, [])]) == 0, command
    assert "1 object changed: 1 moved" in capsys.readouterr().out
    assert Path("work/visits/001/report.html").is_file() and Path("film.webp").stat().st_size > 10_000
    assert len(pages) == 2 and b"<html" in pages[1]


def test_the_tour_is_walked(tmp_path, monkeypatch, capsys) -> None:
    """Every command of docs/tour.md in its order, of a clone, and then the manual's pictures of the demo's stages are
    drawn; the demo's fit alone is shorter."""
    (tmp_path / "src").symlink_to(ROOT / "src")
    monkeypatch.chdir(tmp_path)
    tour, said = ROOT / "docs" / "tour.md", {}
    for line in typed(tour):
        _, command, *arguments = shlex.split(line, comments=True)
        assert main([command, *arguments, *(["--fit.steps", "500"] if command == "demo" else [])]) == 0, line
        said[command] = capsys.readouterr().out
    assert list(said) == ["demo", "visits", "render", "update", "undo", "export"]
    assert "1 object changed: 1 moved" in said["demo"] and "moved from" in said["visits"]
    assert "nothing changed" in said["update"] and "visit 2 is taken back" in said["undo"]
    assert Path("refield-demo/visits/001/report.html").is_file() and Path("files/changes.glb").is_file()
    assert Path("film.webp").stat().st_size > 10_000 and Path("around.webp").stat().st_size > 10_000
    (block,) = re.findall(r"```python\n(.*?)```", tour.read_text(encoding="utf-8"), re.DOTALL)
    exec(compile(block, "tour.md", "exec"), {})
    assert "moved" in capsys.readouterr().out and difference(Path("was.png"), Path("is.png")) > 1
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))  # as of a script that is run
    monkeypatch.setattr(sys, "argv", ["stages.py", "refield-demo", "--out", "pictures"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(ROOT / "benchmarks" / "stages.py"), run_name="__main__")
    shown = re.findall(r"images/stages/(\w+\.webp)", (ROOT / "docs" / "stages.md").read_text(encoding="utf-8"))
    made = {path.name: path.stat().st_size for path in Path("pictures").iterdir()}
    assert {*shown} - {"report.webp"} <= made.keys() <= {*shown} and max(made.values()) < 150_000
