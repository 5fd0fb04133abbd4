"""The commands join the stages: what they write, print and return."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from refield.cli import COMMANDS, main
from refield.commands import clock
from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, SceneChange
from refield.scene.exposure import Exposure
from refield.scene.images import read_image, write_image
from refield.scene.refined import write_refined
from refield.visits import make
from refield.workspace import Workspace
from tests.conftest import HERE, TINY_FIT
from tests.folders import contents
from tests.photos.room import write_photos
from tests.vision.test_perceptual import channels_of, filled, network_of


@pytest.fixture
def place(tiny, tmp_path, monkeypatch):
    for name in ("data", "new", "work"):
        shutil.copytree(tiny / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_help_is_light_and_names_every_command():
    code = "import sys; from refield.cli import main; main(['--help']); assert 'torch' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=HERE)
    assert done.returncode == 0 and all(name in done.stdout for name in COMMANDS)


@pytest.mark.parametrize(
    "given, spin, blas",
    [
        ({}, "1000", "1"),
        ({"GOMP_SPINCOUNT": "7", "OPENBLAS_NUM_THREADS": "3"}, "7", "3"),
        ({"OMP_WAIT_POLICY": "active"}, None, "1"),
    ],
)
def test_threads_are_told_how_to_wait_before_they_are_made_unless_the_user_did(given, spin, blas):
    names = ("GOMP_SPINCOUNT", "OPENBLAS_NUM_THREADS")
    code = f"""
import os, sys
from refield.cli import main
main(["--version"])
assert not {{"numpy", "scipy", "numba", "torch"}} & {{*sys.modules}}
print([os.environ.get(name) for name in {names}])
"""
    bare = {name: value for name, value in HERE.items() if name not in (*names, "OMP_WAIT_POLICY")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=bare | given, check=True)
    assert done.stdout.splitlines()[-1] == str([spin, blas])


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    assert f"refield {command}" in capsys.readouterr().out


@pytest.mark.parametrize(
    "argv", [[], ["train"], ["train", "a", "b", "--no-such-option"], ["render", "w", "--visit", "x"]]
)
def test_wrong_usage_is_exit_code_2(argv, capsys):
    try:
        code = main(argv)
    except SystemExit as stop:
        code = stop.code
    assert code == 2


def test_version(capsys):
    import refield

    assert main(["--version"]) == 0
    assert refield.__version__ in capsys.readouterr().out


def test_render_writes_one_picture_per_frame(place, capsys):
    argv = ["render", "work", "--cameras", "new/transforms.json", "--out", "pictures"]
    for _ in range(2):  # our own pictures may be replaced
        assert main(argv) == 0
    assert sorted(p.name for p in (place / "pictures").iterdir()) == [f"00{i}.png" for i in range(4)]
    assert read_image(place / "pictures/000.png").shape == (24, 32, 3)
    assert "4 pictures in pictures" in capsys.readouterr().out


def test_render_gives_pictures_the_look_of_a_photo(place, capsys):
    workspace = Workspace.open(place / "work")
    given = workspace.given_capture()
    dark = replace(given.frames[0], exposure=Exposure((0.5, 0.5, 0.25)))
    write_refined(place / "work/capture/refined.json", given, replace(given, frames=(dark, *given.frames[1:])))
    argv = ["render", "work", "--cameras", "new/transforms.json", "--out"]
    looks = {"neutral": [], "dark": ["--look", dark.name], "other": ["--look", Path(given.frames[1].name).stem]}
    for out, look in looks.items():
        assert main([*argv, out, *look]) == 0
    neutral, darkened, other = (read_image(place / out / "001.png").double().numpy() for out in looks)
    assert np.abs(darkened - neutral * [0.5, 0.5, 0.25]).max() <= 1 and neutral.max() > 20
    assert np.array_equal(other, neutral)
    assert main([*argv, "none", "--look", "nowhere.jpg"]) == 2
    assert "nowhere.jpg" in capsys.readouterr().err


def test_evaluate_writes_numbers(place, capsys):
    assert main(["evaluate", "work", "new", "--out", "numbers.json"]) == 0
    assert json.loads((place / "numbers.json").read_text())["pooled"]["psnr"] > 0
    assert "psnr" in capsys.readouterr().out


def test_evaluate_with_lpips(place, capsys):
    """A mask of some pixels, and weights by chance: a number where there is a mask, none where there is none."""
    model = filled("alex")
    (place / "weights").mkdir()
    save_file(network_of(model) | channels_of(model), str(place / "weights" / "both.safetensors"))
    mask = torch.zeros(24, 32, dtype=torch.bool)
    mask[4:14, 6:20] = True
    for i in range(4):
        write_image(place / "new" / "masks_in" / f"{i:03d}.png", mask)
    assert main(["evaluate", "work", "new", "--lpips", "weights", "--out", "numbers.json"]) == 0
    pooled = json.loads((place / "numbers.json").read_text())["pooled"]
    assert pooled["lpips_in"] > 0 and pooled["lpips_out"] is None
    assert "lpips-in" in capsys.readouterr().out


def believing(monkeypatch, *kinds):
    """Let the estimate say that an object of each kind changed in the middle of the scene."""

    def estimate(capture, field, frames, config, on_stage=None, models=None, known=(), on_count=None):
        for name in ("look", "decide"):
            on_stage(name)
        on_count(0, 3)
        on_count(1, 3)
        grid = OccupancyGrid(torch.tensor([[-0.3, -0.3, -0.3], [0.3, 0.3, 0.3]]), torch.ones(5, 5, 5))
        shift = torch.eye(4, dtype=torch.float64)
        shift[0, 3] = 0.5
        seen = torch.zeros(24, 32, dtype=torch.bool)
        seen[8:16, 10:20] = True
        masks = (seen,) * len(capture.train)
        objects = tuple(
            ObjectChange(k, grid, shift if k == "moved" else None, masks=masks, masks_in=masks) for k in kinds
        )
        photos = tuple(PlacedPhoto(f.name, "used", "", f) for f in frames[:3])
        photos += (PlacedPhoto(frames[3].name, "rejected", "blurred"),)
        return SceneChange(objects, photos, "because", (seen,) * 3, (seen,) * 3)

    monkeypatch.setattr(make, "estimate_change", estimate)


FEW = [
    "--update.fit.steps",
    "2",
    "--update.fit.samples",
    "512",
    "--update.relight.no-still",
    "--update.relight.no-moved",
]


def test_nothing_changed_writes_only_the_report(place, monkeypatch, capsys):
    believing(monkeypatch)
    before = contents(place / "work")
    assert main(["update", "work", "new"]) == 0
    out = capsys.readouterr()
    assert out.out.startswith("nothing changed")
    written = contents(place / "work")
    assert {k: v for k, v in written.items() if not k.startswith("visits/")} == before
    names = {k.removeprefix("visits/001/") for k in written.keys() - before.keys()}
    assert names == {"change.json", "report.json", "report.html"}
    record = json.loads((place / "work/visits/001/change.json").read_text())
    assert record["objects"] == [] and [p["status"] for p in record["photos"]] == ["used"] * 3 + ["rejected"]
    assert set(json.loads((place / "work/visits/001/report.json").read_text())["seconds"]) >= {
        "look",
        "decide",
    }


def test_how_many_explanations_were_tried_is_told_unless_it_is_to_be_quiet(place, monkeypatch, capsys):
    believing(monkeypatch)
    monkeypatch.setattr(clock, "_QUIET_SECONDS", -1.0)
    assert main(["update", "work", "new"]) == 0
    assert "explanations tried: 1 of 3" in capsys.readouterr().err
    assert main(["update", "work", "new", "--quiet"]) == 0
    assert "explanations" not in capsys.readouterr().err


def test_updates_stack(place, monkeypatch, capsys):
    believing(monkeypatch, "removed")
    assert main(["update", "work", "new", *FEW]) == 0
    assert "1 object changed: 1 removed" in capsys.readouterr().out
    believing(monkeypatch, "moved", "added")
    assert main(["update", "work", "new", "--evaluation", "new", *FEW]) == 0
    for n in ("001", "002"):
        visit = place / "work/visits" / n
        for name in (
            "change.json",
            "grid_0.npz",
            "field.safetensors",
            "report.json",
            "report.html",
            "photos/transforms.json",
        ):
            assert (visit / name).is_file(), name
    shown = []
    for n in (0, 1, 2):
        assert main(["render", "work", "--cameras", "new/transforms.json", "--out", f"v{n}", "--visit", f"{n}"]) == 0
        shown.append(torch.stack([read_image(place / f"v{n}/00{i}.png").float() for i in range(4)]))
    assert main(["render", "work", "--cameras", "new/transforms.json", "--out", "latest"]) == 0
    assert torch.equal(read_image(place / "latest/000.png"), read_image(place / "v2/000.png"))
    assert (shown[0] - shown[1]).abs().max() > 2 and (shown[1] - shown[2]).abs().max() > 2
    assert main(["evaluate", "work", "new", "--visit", "1"]) == 0


def test_reports_link_to_each_other_and_the_history_to_all(place, monkeypatch, capsys):
    assert main(["report", "work"]) == 2
    assert "has had no visit yet" in capsys.readouterr().err
    believing(monkeypatch, "moved", "removed")
    assert main(["update", "work", "new", *FEW]) == 0
    first = contents(place / "work")
    believing(monkeypatch)
    assert main(["update", "work", "new"]) == 0
    one, two = (place / f"work/visits/00{n}/report.html" for n in (1, 2))
    assert 'href="../002/report.html"' in one.read_text() and 'href="../001/report.html"' in two.read_text()
    assert "Two objects" not in two.read_text() and "One object moved, one is gone" in one.read_text()
    capsys.readouterr()

    assert main(["report", "work"]) == 0
    assert capsys.readouterr().out == "report: work/report.html\n"
    history = (place / "work/report.html").read_text()
    for told in ("Visit 1: One object moved, one is gone", "Visit 2: Nothing changed", "Object 2, a thing of"):
        assert told in history
    assert 'href="visits/001/report.html"' in history and history.count('<article class="card">') == 3
    assert main(["report", "work", "--out", "my pages/history.html"]) == 0
    assert 'href="../work/visits/002/report.html"' in (place / "my pages/history.html").read_text()

    for out, why in (
        ("data/transforms.json", "not made by refield"),
        ("data", "a folder"),
        ("work/field/x", "belongs"),
    ):
        kept = contents(place)
        assert main(["report", "work", "--out", out]) == 2
        assert why in capsys.readouterr().err and contents(place) == kept
    assert main(["report", "work"]) == 0  # our own page may be replaced
    (place / "work/report.html").unlink()
    assert main(["undo", "work"]) == 0
    assert contents(place / "work") == first


def test_the_other_architecture_all_the_way(place, monkeypatch, capsys):
    """NeRFacto's: trained, kept, updated and rendered by the same commands."""
    shape = ["samples", "4", "levels", "2", "finest", "32", "log2-table", "8", "width", "8", "occupancy", "16"]
    few = [f"--nerfacto.field.{a}" if i % 2 == 0 else a for i, a in enumerate(shape)]
    few += ["--nerfacto.steps", "5", "--nerfacto.rays", "64"]
    assert main(["train", "data", "other", "--architecture", "nerfacto", *few]) == 0
    assert json.loads((place / "other/field/field.json").read_text())["architecture"] == "NerfactoField"
    assert main(["train", "data", "posed", "--architecture", "nerfacto", *few, "--nerfacto.photos.poses"]) == 0
    assert (place / "posed/capture/refined.json").is_file() and not (place / "other/capture/refined.json").exists()
    believing(monkeypatch, "moved")
    assert main(["update", "other", "new", *FEW]) == 0
    assert main(["render", "other", "--cameras", "new/transforms.json", "--out", "pictures"]) == 0
    assert read_image(place / "pictures/000.png").shape == (24, 32, 3)


def test_visits_are_listed_and_taken_back(place, monkeypatch, capsys):
    assert main(["visits", "work"]) == 0
    assert "no visit" in capsys.readouterr().out
    assert main(["undo", "work"]) == 2
    assert "nothing to take back" in capsys.readouterr().err
    before = contents(place / "work")
    believing(monkeypatch, "moved", "added")
    assert main(["update", "work", "new", *FEW]) == 0
    first = contents(place / "work")
    believing(monkeypatch)
    assert main(["update", "work", "new"]) == 0
    capsys.readouterr()
    assert main(["visits", "work", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["visits"]
    assert [v["visit"] for v in told] == [1, 2] and [v["changed"] for v in told] == [True, False]
    assert [o["kind"] for o in told[0]["objects"]] == ["moved", "added"] and told[1]["objects"] == []
    assert told[0]["objects"][0]["moved_by"] == pytest.approx(0.5) and told[0]["photos_rejected"] == 1
    assert main(["visits", "work"]) == 0
    out = capsys.readouterr().out
    assert "moved from (0, 0, 0) by 0.5" in out and "added at" in out and "because" in out
    assert main(["report", "work"]) == 0 and (place / "work/report.html").is_file()  # it tells of both visits
    assert main(["undo", "work"]) == 0 and contents(place / "work") == first
    assert main(["undo", "work"]) == 0 and contents(place / "work") == before
    assert "after visit 0" in capsys.readouterr().out


def test_no_usable_photo(place, monkeypatch, capsys):
    def estimate(capture, field, frames, config, on_stage=None, models=None, known=(), on_count=None):
        return SceneChange(photos=tuple(PlacedPhoto(f.name, "rejected", "98 % changed") for f in frames))

    monkeypatch.setattr(make, "estimate_change", estimate)
    before = contents(place / "work")
    assert main(["update", "work", "new"]) == 2
    assert "98 % changed" in capsys.readouterr().err and contents(place / "work") == before


def test_ctrl_c_leaves_no_workspace(place, monkeypatch, capsys):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("refield.commands.train.fit_capture", interrupted)
    assert main(["train", "data", "out", *TINY_FIT]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert not (place / "out").exists()


def test_what_a_fit_finds_of_its_photos_is_kept_and_told(place, capsys):
    assert main(["train", "data", "out", *TINY_FIT, "--fit.photos.poses"]) == 0
    assert "of the photos: poses moved by" in " ".join(capsys.readouterr().err.split())
    given, found = Workspace(place / "out").given_capture(), Workspace(place / "out").capture()
    assert any(not a.world_from_cam.equal(b.world_from_cam) for a, b in zip(given.train, found.train))
    assert all(a.world_from_cam.equal(b.world_from_cam) for a, b in zip(given.held_out, found.held_out))


def test_a_fit_that_breaks_down_keeps_its_last_good_state_and_says_so(place, monkeypatch, capsys):
    from refield.field import kernels

    whole, steps = kernels.train_step, []

    def step(*args, **more):
        steps.append(whole(*args, **more))
        return steps[-1] if len(steps) < 20 else steps[-1]._replace(loss=float("nan"))

    monkeypatch.setattr(kernels, "train_step", step)
    assert main(["train", "data", "out", *TINY_FIT]) == 0
    assert "the last good state is kept" in " ".join(capsys.readouterr().err.split())
    assert (place / "out/field/field.safetensors").is_file()


def test_faults_of_ours_keep_their_traceback(place, monkeypatch):
    def broken(*args):
        raise RuntimeError("a fault")

    monkeypatch.setattr("refield.commands.train.fit_capture", broken)
    with pytest.raises(RuntimeError, match="a fault"):
        main(["train", "data", "out", *TINY_FIT])
    assert not (place / "out").exists()


@pytest.fixture
def heeds_ctrl_c():
    """Children stop at Ctrl-C even where the tests run in the background, in which shells have it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def training(place):
    """A training that would take for ever, in its own process, once it has begun."""
    argv = [sys.executable, "-m", "refield", "train", "data", "out", "--fit.steps", "100000"]
    process = subprocess.Popen(argv, cwd=place, stderr=subprocess.DEVNULL, env=HERE)
    while process.poll() is None and not list(place.glob("out/.part-*/capture/transforms.json")):
        time.sleep(0.05)
    return process


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_leave_no_half_workspace(place, heeds_ctrl_c, number, code):
    process = training(place)
    process.send_signal(number)
    assert process.wait(timeout=60) == code
    assert not (place / "out").exists()


def test_an_interrupt_within_generated_code_has_the_same_exit_code(place, heeds_ctrl_c):
    # numba's compiler runs source text; CPython remembers a KeyboardInterrupt that passes through it
    code = """import sys, refield.cli
text = "import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(5)"
refield.cli._command = lambda arguments: exec(text)
sys.exit(refield.cli.main(["train"]))"""
    (place / "interrupted.py").write_text(code)
    done = subprocess.run([sys.executable, "-m", "interrupted"], cwd=place, env=HERE, stderr=subprocess.DEVNULL)
    assert done.returncode == 130


def test_a_killed_training_is_no_workspace_and_can_be_repeated(place):
    process = training(place)
    process.kill()
    process.wait()
    assert list(place.glob("out/.part-*")) and not (place / "out/refield.json").exists()
    assert main(["train", "data", "out", *TINY_FIT]) == 0
    assert not list(place.glob("out/.part-*"))


_KILLED = """
import os, signal, sys
import pytest, torch
from refield import workspace
from refield.cli import main
from refield.visits import make
from tests.test_cli import FEW, believing

name, when = sys.argv[1:]
home = workspace if name.startswith("sync") else make
whole = getattr(home, name)

def killed(*args):
    if when == "after":
        whole(*args)
    os.kill(os.getpid(), signal.SIGKILL)

setattr(home, name, killed)
believing(pytest.MonkeyPatch(), "removed")
main(["update", "work", "new", *FEW])
"""


@pytest.mark.parametrize(
    "name, when, complete",
    [
        ("save_updated", "before", False),
        ("write_report", "after", False),
        ("sync", "after", False),
        ("sync_folder", "before", True),
    ],
)
def test_a_killed_update_leaves_the_workspace_as_it_was_or_complete(place, monkeypatch, name, when, complete):
    before = contents(place / "work")
    (place / "killed.py").write_text(_KILLED)
    done = subprocess.run([sys.executable, "killed.py", name, when], cwd=place, env=HERE, stderr=subprocess.DEVNULL)
    assert done.returncode == -signal.SIGKILL
    visible = {k: v for k, v in contents(place / "work").items() if ".part-" not in k}
    if complete:
        assert (place / "work/visits/001/report.html").is_file() and (place / "work/visits/001/field.json").is_file()
        assert main(["undo", "work"]) == 0
        assert contents(place / "work") == before
    else:
        assert visible == before
    believing(monkeypatch, "removed")
    assert main(["update", "work", "new", *FEW]) == 0  # and clears away what the killed one left
    assert not list(place.glob("work/**/.part-*"))


def test_photos_alone_all_the_way(reconstructed, tmp_path, monkeypatch, capsys):
    """Train from photos, update from photos: placed ones are compared, one that is black is kept as rejected."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(reconstructed.folder / "photos", "before")
    shutil.copytree(reconstructed.folder / "cache", "work/.photos")
    assert main(["train", "before", "work", "--scale", "0.5", "--poses.motion.features", "500", *TINY_FIT]) == 0
    assert "8 of 8 photos placed" in capsys.readouterr().err
    workspace = Workspace.open(Path("work"))
    assert workspace.world().metres_per_unit == 0.5 and workspace.landmarks.is_file()

    write_photos(Path("elsewhere"), 2, seed=7)
    before = contents(Path("work"))
    assert main(["update", "work", "elsewhere", "--localize.features", "500"]) == 2
    said = capsys.readouterr().err
    assert re.search(r"elsewhere: none of its 2 photos can be placed \(0.png cannot be placed", said)
    assert contents(Path("work")) == before

    write_photos(Path("after"), 2, turn=0.5)
    write_image(Path("after/black.png"), torch.zeros(150, 200, 3))
    monkeypatch.setattr(make, "estimate_change", believe_photos)
    assert main(["update", "work", "after", "--localize.features", "500"]) == 0
    assert "left out: black.png is black" in capsys.readouterr().err
    told = json.loads(Path("work/visits/001/change.json").read_text())["photos"]
    assert [(p["file"], p["status"]) for p in told] == [("0.png", "used"), ("1.png", "used"), ("black.png", "rejected")]
    assert told[0]["placement"]["inliers"] > 100 and "is black" in told[2]["why"]
    page = Path("work/visits/001/report.html").read_text()
    assert "black.png" in page and "points that agree" in page

    (tmp_path / "eval").mkdir()
    shutil.copytree("before", "eval/images")  # masks may be missing; photos without poses are placed like new ones
    few = sorted(Path("eval/images").iterdir())
    for path in few[2:]:
        path.unlink()
    shutil.copy("after/black.png", "eval/images")
    twice = torch.zeros(300, 400, dtype=torch.bool)  # of a photo that was scaled down since
    twice[100:200, 100:200] = True
    for path in few[:2]:
        write_image(Path("eval/masks_in") / path.with_suffix(".png").name, twice)
    assert main(["evaluate", "work", "eval", "--out", "scores.json", "--localize.features", "500"]) == 0
    scores = json.loads(Path("scores.json").read_text())
    views = scores["views"]
    assert [v["name"] for v in views] == [path.name for path in few[:2]]
    (left_out,) = scores["left_out"]
    assert left_out["name"] == "black.png" and left_out["why"].startswith("is black")
    assert all(v["scores"]["psnr"] > 10 and v["scores"]["psnr_in"] is not None for v in views)


def believe_photos(capture, field, frames, config, on_stage=None, models=None, known=(), on_count=None):
    """Nothing changed, and all photos were used."""
    return SceneChange(photos=tuple(PlacedPhoto(f.name, "used", frame=f) for f in frames))


def test_a_fit_goes_on_from_where_it_stood(place, capsys):
    assert main(["train", "data", "out", *TINY_FIT]) == 0
    first = json.loads((place / "out/field/field.json").read_text())
    assert main(["train", "out", "--more", *TINY_FIT]) == 0
    second = json.loads((place / "out/field/field.json").read_text())
    assert second["held_out_psnr"] >= first["held_out_psnr"]
    assert main(["train", "data"]) == 2
    assert "name the folder in which to make the workspace" in " ".join(capsys.readouterr().err.split())
    assert main(["train", "data", "--more"]) == 2  # no workspace
