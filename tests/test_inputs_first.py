"""Inputs are looked at before heavy work begins: whoever is refused has waited for nothing, and nothing is left."""

import os
import shutil

import pytest
import torch

from refield.cli import main
from refield.scene.images import write_image
from tests.folders import contents


@pytest.fixture
def place(tiny, tmp_path, monkeypatch):
    """A workspace whose field and landmarks are spoilt: a command that comes as far as these says something else."""
    for name in ("data", "new", "work"):
        shutil.copytree(tiny / name, tmp_path / name)
    (tmp_path / "work/field/field.safetensors").write_bytes(b"spoilt")
    (tmp_path / "work/capture/images/000.png").unlink(missing_ok=True)
    (tmp_path / "work/capture/images/0000.png").write_bytes(b"spoilt")  # structure from motion trips over it
    (tmp_path / "bare").mkdir()
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes/readme.txt").write_text("no photo")
    (tmp_path / "none/images").mkdir(parents=True)
    (tmp_path / "none/images/0.png").write_bytes(b"no picture")
    shutil.copytree(tmp_path / "new/images", tmp_path / "photos/images")
    (tmp_path / "photos/masks_in").mkdir()
    shutil.copytree(tmp_path / "new", tmp_path / "small")
    for i in range(4):
        write_image(tmp_path / f"small/masks_in/{i:03d}.png", torch.zeros(12, 24, dtype=torch.bool))
    shutil.copytree(tmp_path / "new", tmp_path / "lacking")
    (tmp_path / "lacking/masks_out").mkdir(exist_ok=True)
    for path in (tmp_path / "lacking/masks_out").iterdir():
        path.unlink()
    monkeypatch.chdir(tmp_path)
    return tmp_path


ROWS = [
    # the command, the folder that the message must name, and what it must say
    (["train", "nowhere", "a/b/out"], "nowhere", "give the photos' folder"),
    (["train", "bare", "a/b/out"], "bare", "photos are files that end in"),
    (["train", "notes", "out"], "notes", "photos are files that end in"),
    (["train", "none", "a/b/out"], "none", "1 of its 1 photos cannot be used"),
    (["update", "work", "nowhere"], "nowhere", "give the photos' folder"),
    (["update", "work", "bare"], "bare", "photos are files that end in"),
    (["update", "work", "notes"], "notes", "photos are files that end in"),
    (["update", "work", "none"], "none", "none of its 1 photos can be used"),
    (["update", "work", "new", "--evaluation", "nowhere"], "nowhere", "check the path"),
    (["update", "work", "new", "--evaluation", "bare"], "bare", "check the path"),
    (["update", "work", "new", "--evaluation", "small"], "small/masks_in/000.png", "give both the same size"),
    (["update", "work", "new", "--evaluation", "lacking"], "lacking/masks_out/000.png", "there is no mask"),
    (["evaluate", "work", "nowhere"], "nowhere", "give the photos' folder"),
    (["evaluate", "work", "bare"], "bare", "photos are files that end in"),
    (["evaluate", "work", "notes"], "notes", "photos are files that end in"),
    (["evaluate", "work", "none"], "none", "none of its 1 photos can be used"),
    (["evaluate", "work", "small"], "small/masks_in/000.png", "give both the same size"),
    (["evaluate", "work", "lacking"], "lacking/masks_out/000.png", "there is no mask"),
    (["evaluate", "work", "photos"], "photos/masks_in/000.png", "there is no mask"),
    (["rehearse", "work", "--out", "work/mine"], "work/mine", "lies in the workspace"),
    (["rehearse", "work", "--out", "notes"], "notes", "is not an empty folder"),
    (["rehearse", "work", "--out", "a/b/out"], "the capture", "a rehearsal needs 20 or more"),
    (["synth", "random", "a/b/out", "--into", "work"], "the capture", "a rehearsal needs 20 or more"),
    (["synth", "random", "out", "--into", "work", "--cameras", "40"], "--cameras", "give --photos"),
    (["train", "data", "notes/readme.txt/out"], "notes/readme.txt/out", "is a file, not a folder"),
    (["demo", "notes/readme.txt/out"], "notes/readme.txt/out", "is a file, not a folder"),
    (["check", "data", "--picture", "notes/readme.txt/a.png"], "notes/readme.txt/a.png", "is a file, not a folder"),
    (["check", "photos", "--work", "notes/readme.txt/a"], "notes/readme.txt/a", "is a file, not a folder"),
    (["evaluate", "work", "new", "--out", "notes/readme.txt/a.json"], "notes/readme.txt/a.json", "is a file"),
    (
        ["render", "work", "--cameras", "new/transforms.json", "--out", "notes/readme.txt/a"],
        "notes/readme.txt/a",
        "file",
    ),
    (["rehearse", "work", "--out", "notes/readme.txt/a/b"], "notes/readme.txt/a/b", "is a file, not a folder"),
    (["synth", "cube", "notes/readme.txt/a"], "notes/readme.txt/a", "is a file, not a folder"),
]


@pytest.mark.parametrize(("argv", "names", "says"), ROWS, ids=[" ".join(row[0]) for row in ROWS])
def test_inputs_are_looked_at_first(place, capsys, argv, names, says):
    before = contents(place)
    assert main(argv) == 2
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert message.startswith(f"refield: {names}") and says in message and ";" in message, message
    assert contents(place) == before
    assert not (place / "out").exists() and not (place / "a").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("argv", [["train", "data", "out"], ["rehearse", "work"]])
def test_a_gpu_that_is_not_there_is_missed_first(place, capsys, argv):
    assert main([*argv, "--fit.device", "cuda"]) == 2
    assert capsys.readouterr().err == (
        "refield: device cuda: torch finds no CUDA GPU on this machine; leave the option out\n"
    )


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_place_that_allows_no_writing_is_refused_first(place, capsys):
    (place / "bare").chmod(0o500)
    assert main(["train", "data", "bare/out"]) == 2
    assert "bare allows no writing" in capsys.readouterr().err


def test_too_few_photos_leave_nothing(place, capsys):
    for i in (2, 3):
        (place / f"photos/images/{i:03d}.png").unlink()
    assert main(["train", "photos", "a/out"]) == 2
    assert "refield: photos: 2 photos are too few" in capsys.readouterr().err
    assert not (place / "a").exists()


def test_what_took_long_is_kept_for_the_next_time(place, capsys):
    """Photos of which nothing can be told still had their features found."""
    assert main(["train", "data/images", "out"]) == 2
    assert "overlap" in capsys.readouterr().err
    assert (place / "out/.photos/photos.json").is_file()
