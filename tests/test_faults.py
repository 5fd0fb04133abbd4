"""Bad input, one row each: one clear line (where, what, what to do), exit code 2, nothing touched."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from PIL import Image

from refield.cli import main
from refield.scene.images import write_image
from tests.captures import CAMERA, write_capture
from tests.conftest import HERE, TINY_FIT
from tests.folders import contents


@pytest.fixture
def place(tiny, tmp_path):
    """A copy of the tiny capture, photos and workspace that a row may spoil."""
    for name in ("data", "new", "work"):
        shutil.copytree(tiny / name, tmp_path / name)
    return tmp_path


def edit(file: str, change: Callable[[dict], object]):
    """Change the JSON object in ``file``."""

    def spoil(place: Path) -> None:
        record = json.loads((place / file).read_text())
        change(record)
        (place / file).write_text(json.dumps(record))

    return spoil


def gone(file: str):
    return lambda place: (place / file).unlink()


def text(file: str, content: str):
    return lambda place: (place / file).write_text(content)


def half(file: str):
    """Cut a file, or each one in a folder, in half."""

    def spoil(place: Path) -> None:
        found = place / file
        for path in found.iterdir() if found.is_dir() else [found]:
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])

    return spoil


def top(file: str = "data", **keys):
    """Set keys of a transforms.json; None removes one."""

    def change(record: dict) -> None:
        record.update(keys)
        for key in [k for k, v in keys.items() if v is None]:
            del record[key]

    return edit(f"{file}/transforms.json", change)


def frame(number: int, file: str = "data", **keys):
    """Set keys of one frame; None removes one."""

    def change(record: dict) -> None:
        entry = record["frames"][number]
        entry.update(keys)
        for key in [k for k, v in keys.items() if v is None]:
            del entry[key]

    return edit(f"{file}/transforms.json", change)


def same_names(record: dict) -> None:
    for i, entry in enumerate(record["frames"]):
        entry["file_path"] = f"{i}/a.png"


def turned(place: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(place / "new/images/001.png") as image:
        image.save(place / "new/images/001.png", exif=exif)


def foreign(place: Path) -> None:
    """Pictures that do not carry our mark."""
    shutil.copytree(place / "new/images", place / "foreign")
    with Image.open(place / "foreign/000.png") as image:
        image.save(place / "foreign/000.png")


def bare(place: Path) -> None:
    """A folder with nothing in it."""
    (place / "bare").mkdir()


def nothing(place: Path) -> None:
    """The command line itself is wrong."""


DATA, NEW = "data/transforms.json", "new/transforms.json"
TRAIN = ["train", "data", "out"]
UPDATE = ["update", "work", "new"]
RENDER = ["render", "work", "--cameras", NEW, "--out", "pictures"]
SCALED = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
NAN, INFINITE = float("nan"), [[float("inf")] * 4] * 4
FIELD = "work/field/field.safetensors"

ROWS: dict[str, tuple[list[str], Callable[[Path], object], str]] = {
    # the command, how its input is spoilt, what the message must say
    "no data": (["train", "nowhere", "out"], nothing, r"nowhere: .*no such file"),
    "empty data": (
        ["train", "bare", "out"],
        lambda place: (place / "bare").mkdir(),
        r"no photos, no transforms\.json and no COLMAP",
    ),
    "folders of photos": (["check", "."], nothing, r"folders of photos \(data, new\); give one of them"),
    "photos that do not match": (TRAIN, gone(DATA), r"12 photos .*images/000.png.*: no two photos of which.*overlap"),
    "not json": (TRAIN, text(DATA, "{"), r"transforms\.json: is not valid JSON"),
    "nested json": (TRAIN, text(DATA, "[" * 200_000), r"transforms\.json: is nested too deeply"),
    "key missing": (TRAIN, top(fl_x=None), r"frame 'images/000\.png': fl_x"),
    "pose missing": (TRAIN, frame(2, transform_matrix=None), r"002\.png': transform_matrix: is missing; add"),
    "not finite": (TRAIN, top(fl_x=NAN), r"NaN is not a number"),
    "pose not finite": (TRAIN, frame(1, transform_matrix=INFINITE), r"json.*Infinity is not a number"),
    "no rotation": (TRAIN, frame(1, transform_matrix=SCALED), r"001\.png': transform_matrix: .*no rotation"),
    "photo size": (TRAIN, top(w=24, h=32), r"000\.png'.*32x24.*24x32"),
    "fisheye": (
        TRAIN,
        top(camera_model="OPENCV_FISHEYE"),
        r"camera_model: 'OPENCV_FISHEYE' is not supported",
    ),
    "all photos missing": (TRAIN, lambda p: shutil.rmtree(p / "data/images"), r"none of its 12 images"),
    "all photos broken": (TRAIN, half("data/images"), r"12 of 12 images cannot be read"),
    "absolute path": (TRAIN, frame(3, file_path="/etc/passwd"), r"frame '/etc/passwd'.*leads out"),
    "path upwards": (TRAIN, frame(3, file_path="../new/images/000.png"), r"frame '\.\./new.*leads out"),
    "output is a file": (["train", "data", DATA], nothing, r"is a file, not a folder"),
    "output is not ours": (
        ["train", "data", "new"],
        nothing,
        r"new: is not empty and not a refield workspace",
    ),
    "output is taken": (
        ["train", "data", "work"],
        nothing,
        r"work: already holds a .*workspace.*--overwrite",
    ),
    "no workspace": (["update", "data", "new"], nothing, r"data: is not a refield workspace; make one with"),
    "workspace is gone": (["update", "nowhere", "new"], nothing, r"nowhere: there is no such workspace"),
    "newer workspace": (UPDATE, text("work/refield.json", '{"format": 2}'), r"format 2"),
    "field is gone": (RENDER, gone(FIELD), r"field\.safetensors: cannot be read"),
    "field is damaged": (RENDER, half(FIELD), r"field\.safetensors: is damaged"),
    "capture is damaged": (UPDATE, gone("work/capture/transforms.json"), r"capture/transforms\.json"),
    "no new photos": (["update", "work", "nowhere"], nothing, r"nowhere: there is no such"),
    "new photos in nothing": (UPDATE, gone(NEW), r"only 0 points of its photos agree with their poses; check"),
    "new photo missing": (UPDATE, gone("new/images/001.png"), r"001\.png'.*no such image"),
    "new photo broken": (UPDATE, half("new/images/002.png"), r"002\.png: cannot be decoded"),
    "new photo is text": (UPDATE, text("new/images/002.png", "x"), r"002\.png: is not an image"),
    "new photo turned": (UPDATE, turned, r"001\.png'.*24x32 pixels but w, h say 32x24"),
    "new pose missing": (
        UPDATE,
        frame(1, "new", transform_matrix=None),
        r"001\.png': transform_matrix: is missing",
    ),
    "no such visit": ([*RENDER, "--visit", "3"], nothing, r"work: there is no visit 3"),
    "negative visit": ([*RENDER, "--visit", "-1"], nothing, r"there is no visit -1"),
    "no cameras": (
        ["render", "work", "--cameras", "x.json", "--out", "y"],
        nothing,
        r"x\.json: cannot be read",
    ),
    "pictures of others": ([*RENDER[:-1], "foreign"], foreign, r"foreign: .*000\.png.*--overwrite"),
    "two of one name": (RENDER, edit(NEW, same_names), r"several frames would be written as a\.png"),
    "a frame without a name": (RENDER, frame(0, "new", file_path="images/.."), r"no file name"),
    "pictures into a file": ([*RENDER[:-1], NEW], nothing, r"is a file, not a folder"),
    "nothing to evaluate": (["evaluate", "work", "nowhere"], nothing, r"nowhere"),
    "no weights for LPIPS": (["evaluate", "work", "new", "--lpips", "nowhere"], nothing, r"nowhere: is not a folder"),
    "unknown command": (
        ["trian", "data", "out"],
        nothing,
        r"'trian' is no command; did you mean 'train'\? choose one of demo, check, train",
    ),
    "unknown world": (["synth", "moon", "out"], nothing, r"no such world; choose one of"),
}


@pytest.mark.parametrize("row", ROWS)
def test_bad_input(place, monkeypatch, capsys, row):
    argv, spoil, says = ROWS[row]
    monkeypatch.chdir(place)
    spoil(place)
    before = contents(place)
    assert main([*argv, *(TINY_FIT if argv[0] == "train" else [])]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    message = lines[-1]
    assert message.startswith("refield: ") and re.search(says, message), message
    assert ";" in message, "no remedy"
    assert contents(place) == before


def test_exit_code_of_the_process(place):
    """The same through the real entry point, without a traceback."""
    done = subprocess.run(
        [sys.executable, "-m", "refield", "update", "data", "new"],
        cwd=place,
        capture_output=True,
        text=True,
        env=HERE,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "is not a refield workspace" in done.stderr


def test_a_missing_photo_is_left_out_and_named(place, monkeypatch, capsys):
    monkeypatch.chdir(place)
    (place / "data/images/003.png").unlink()
    assert main([*TRAIN, *TINY_FIT]) == 0
    assert "1 of 12 images are missing and left out: images/003.png" in capsys.readouterr().err
    assert len(list((place / "out/capture/images").iterdir())) == 11


def test_too_many_photos_for_the_memory(place, monkeypatch, capsys):
    monkeypatch.chdir(place)
    monkeypatch.setattr("os.sysconf", lambda name: 100)
    assert main([*TRAIN, *TINY_FIT]) == 2
    assert "scale the photos down" in capsys.readouterr().err and not (place / "out").exists()


_SHOW_FOCAL = """
from pathlib import Path
from refield.scene.load import load_capture
print(load_capture(Path("data")).frames[0].camera.fx)
"""


@pytest.mark.parametrize("locale", ["de_DE.UTF-8", "C"])
def test_numbers_do_not_depend_on_the_locale(place, locale):
    done = subprocess.run(
        [sys.executable, "-c", _SHOW_FOCAL],
        cwd=place,
        capture_output=True,
        text=True,
        env={**HERE, "LC_ALL": locale},
    )
    assert float(done.stdout) == CAMERA.fx


def test_photos_of_another_scene(place, monkeypatch, capsys):
    """Coloured blocks instead of the scene: refused, nothing published."""
    monkeypatch.chdir(place)
    enough = ["--fit.steps", "400", "--fit.samples", "4096", "--fit.field.log2-table", "12", "--fit.field.width", "16"]
    assert main(["train", "data", "trained", *TINY_FIT, *enough, "--fit.field.levels", "6"]) == 0
    write_capture(place / "other", 4, turn=0.2)
    for i, path in enumerate(sorted((place / "other/images").iterdir())):
        blocks = torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(i))
        write_image(path, blocks.repeat_interleave(8, 0).repeat_interleave(8, 1))
    before = contents(place)
    assert main(["update", "trained", "other"]) == 2
    assert "is this the same scene?" in capsys.readouterr().err
    assert contents(place) == before
