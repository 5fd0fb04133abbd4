"""Nothing inside a workspace is written but by a workspace's own steps, wherever the user points a command."""

import shutil

import pytest

from refield.cli import main
from refield.scene.errors import InputError
from refield.scene.images import write_image
from refield.workspace import Workspace, refuse_inside
from tests.folders import contents


@pytest.fixture
def place(tiny, tmp_path, monkeypatch):
    for name in ("data", "new", "work"):
        shutil.copytree(tiny / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


RENDER = ["render", "work", "--cameras", "data/transforms.json", "--overwrite", "--out"]
EVALUATE = ["evaluate", "work", "new", "--out"]
CHECK = ["check", "data", "--picture"]
TRAIN = ["train", "data"]
ROWS = [
    [*RENDER, "work/capture/images"],  # refield wrote the photos that lie there
    [*RENDER, "work/capture"],
    [*RENDER, "work/visits/001"],
    [*RENDER, "work/pictures/../capture/images"],
    [*RENDER, "linked/images"],
    [*RENDER, "work/.part-x"],
    [*EVALUATE, "work/refield.json"],
    [*EVALUATE, "work/capture/transforms.json"],
    [*EVALUATE, "work/field/field.json"],
    [*EVALUATE, "linked/transforms.json"],
    [*EVALUATE, "work/.lock"],
    [*CHECK, "work/capture/images/0000.png"],
    [*CHECK, "work/Field/x.png"],  # the same folder where a disk knows no case
    ["check", "photos", "--work", "work/field"],
    [*TRAIN, "work/visits/001"],
    [*TRAIN, "work/capture", "--overwrite"],
    ["train", "photos", "work/visits/001"],
    ["synth", "cube", "work/visits/001"],
    ["synth", "random", "linked", "--into", "work", "--overwrite"],
    ["rehearse", "work", "--out", "work/visits/001"],
    ["rehearse", "data", "--out", "linked/images"],
]


@pytest.mark.parametrize("argv", ROWS, ids=" ".join)
def test_what_a_workspace_keeps_is_refused_before_any_work(place, capsys, argv):
    (place / "linked").symlink_to(place / "work" / "capture")
    shutil.copytree(place / "data/images", place / "photos")
    (place / "work/field/field.safetensors").write_bytes(b"")  # who comes as far as this says something else
    before = contents(place)
    assert main(argv) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert "belongs to the workspace" in said[-1] and "choose another place" in said[-1]
    assert len(said) == 1, "something was begun before"
    assert contents(place) == before


def test_names_of_the_users_own_are_free(place, capsys):
    before = contents(place / "work")
    assert main([*RENDER, "work/pictures"]) == 0
    assert main([*EVALUATE, "work/numbers.json"]) == 0
    assert main([*CHECK, "work/cameras.png"]) == 0
    after = contents(place / "work")
    assert {k: after[k] for k in before} == before
    assert {k.partition("/")[0] for k in after.keys() - before.keys()} == {"pictures", "numbers.json", "cameras.png"}


def test_a_workspace_in_the_making_is_one(tmp_path):
    with Workspace.caching(tmp_path / "work") as cache:
        (cache / "kept").write_text("what takes long")
    for inside in (cache / "kept", tmp_path / "work/field", tmp_path / "work/.lock"):
        with pytest.raises(InputError, match="belongs to the workspace"):
            refuse_inside(inside)
    refuse_inside(tmp_path / "work", tmp_path / "work/mine", tmp_path / "field")


def test_numbers_replace_numbers_only(place, capsys):
    assert main([*EVALUATE, "numbers.json"]) == 0
    assert main([*EVALUATE, "numbers.json"]) == 0
    capsys.readouterr()
    for out, says in (("new/transforms.json", "holds no numbers"), ("new", "is a folder")):
        before = contents(place)
        assert main([*EVALUATE, out]) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert says in said[-1] and len(said) == 1
        assert contents(place) == before


def test_the_cameras_own_photos_are_not_replaced_unasked(place, capsys):
    """Photos of a made-up world carry refield's mark."""
    write_image(place / "data/images/000.png", Workspace.open(place / "work").field().sampler.grid.bool()[0])
    before = contents(place)
    assert main(["render", "work", "--cameras", "data/transforms.json", "--out", "data/images"]) == 2
    assert "000.png" in capsys.readouterr().err
    assert contents(place) == before


@pytest.mark.parametrize("there", ["work", "data"])
def test_the_demo_advises_nothing_that_it_refuses(place, capsys, there):
    """A workspace that no demo made, and a folder of something else."""
    before = contents(place)
    assert main(["demo", there]) == 2
    said = capsys.readouterr().err
    assert "output folder" in said or "another folder" in said
    assert "--" not in said
    assert contents(place) == before
