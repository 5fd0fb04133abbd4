"""A workspace appears whole or not at all, has one writer at a time, and gives back what was put in."""

import shutil

import pytest
import torch

from refield.artefacts import TENSORS, locked, read_tensors, write_tensors
from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, SceneChange
from refield.scene.errors import InputError
from refield.workspace import Workspace
from tests.captures import CAMERA, write_capture
from tests.fields import small_field
from tests.folders import contents


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "data", 12)


@pytest.fixture
def work(tmp_path, capture):
    path = tmp_path / "work"
    with Workspace.building(path) as workspace:
        workspace.keep_capture(capture)
        workspace.keep_field(small_field(), 31.5)
    return path


def test_what_is_put_in_comes_out(work, capture, tmp_path):
    shutil.rmtree(tmp_path / "data")  # a workspace needs nothing from outside
    workspace = Workspace.open(work)
    back = workspace.capture()
    assert [f.camera for f in back.frames] == [f.camera for f in capture.frames]
    assert all(f.path.is_file() for f in back.frames)
    assert [len(back.train), len(back.held_out)] == [11, 1]
    field, same = small_field(), workspace.field()
    x, d = torch.randn(50, 3), torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    assert all(torch.equal(a, b) for a, b in zip(field(x, d), same(x, d)))
    assert workspace.visits == 0 and Workspace.made_by(work) == "train"


@pytest.mark.parametrize("existed", [False, True])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_failed_build_leaves_nothing(tmp_path, capture, error, existed):
    path = tmp_path / "w"
    if existed:
        path.mkdir()
    with pytest.raises(error), Workspace.building(path) as workspace:
        workspace.keep_capture(capture)
        raise error
    assert path.exists() == existed
    assert not existed or [p.name for p in path.iterdir()] == [".lock"]
    with pytest.raises(InputError, match="workspace"):
        Workspace.open(path)


def test_overwriting_keeps_what_is_not_ours(work, capture):
    (work / "notes.txt").write_text("mine")
    (work / "visits" / "001").mkdir(parents=True)
    before = contents(work)
    with pytest.raises(InputError, match="--overwrite"), Workspace.building(work):
        pass
    with pytest.raises(RuntimeError), Workspace.building(work, overwrite=True) as workspace:
        workspace.keep_capture(capture)
        raise RuntimeError
    assert contents(work) == before
    with Workspace.building(work, overwrite=True, made_by="demo") as workspace:
        workspace.keep_capture(capture)
        workspace.keep_field(small_field())
    assert (work / "notes.txt").read_text() == "mine"
    assert Workspace.open(work).visits == 0 and Workspace.made_by(work) == "demo"
    assert not [p for p in work.iterdir() if p.name.startswith(".part")]


def test_an_interrupted_swap_is_undone(work, capture, monkeypatch):
    before = contents(work)

    def stop(path):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), Workspace.building(work, overwrite=True) as workspace:
        workspace.keep_capture(capture)
        monkeypatch.setattr("refield.workspace.sync_folder", stop)
    assert contents(work) == before


def test_folders_of_others_are_refused(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match=r"thesis\.tex"), Workspace.building(tmp_path / "home"):
        pass
    Workspace.refuse_unless_free(tmp_path / "home", overwrite=True)
    (tmp_path / "home" / "field").mkdir()
    with pytest.raises(InputError, match="holds field but is not a refield workspace"):
        Workspace.refuse_unless_free(tmp_path / "home", overwrite=True)
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a file"):
        Workspace.refuse_unless_free(tmp_path / "file", overwrite=True)
    with pytest.raises(InputError, match="not a refield workspace; make one with: refield train"):
        Workspace.open(tmp_path / "home")
    with pytest.raises(InputError, match="no such workspace"):
        Workspace.open(tmp_path / "none")


def test_a_newer_format_is_refused(work):
    (work / "refield.json").write_text('{"format": 99}')
    with pytest.raises(InputError, match="99"):
        Workspace.open(work)


def a_change(capture) -> SceneChange:
    grid = OccupancyGrid(torch.tensor([[0.0, 0, 0], [1, 1, 1]]), torch.rand(4, 4, 4))
    masks = tuple(torch.rand(24, 32) > 0.5 for _ in capture.train)
    frame = capture.frames[0]
    photos = (PlacedPhoto("x", "rejected", "blurred"), PlacedPhoto(frame.name, "used", "", frame))
    return SceneChange((ObjectChange("removed", grid, masks=masks),), photos)


def test_visits_are_self_contained_and_numbered(work, capture, tmp_path):
    workspace = Workspace.open(work)
    new = write_capture(tmp_path / "new", 12, CAMERA, turn=0.1)
    with workspace.writing(), workspace.new_visit() as folder:
        workspace.keep_change(folder, a_change(new))
    shutil.rmtree(tmp_path / "new")
    assert workspace.visits == 1 and workspace.chosen_visit(None) == 1 and workspace.chosen_visit(0) == 0
    (frame,) = workspace.change(1, workspace.capture()).frames
    assert frame.path.is_relative_to(work.resolve()) and frame.name == new.frames[0].name
    with pytest.raises(InputError, match=r"no visit 2.*0 .before. to 1"):
        workspace.chosen_visit(2)


def test_a_failed_visit_leaves_nothing(work, capture):
    workspace = Workspace.open(work)
    before = contents(work)
    with pytest.raises(KeyboardInterrupt), workspace.new_visit() as folder:
        workspace.keep_change(folder, a_change(capture))
        raise KeyboardInterrupt
    assert contents(work) == before and workspace.visits == 0


def test_a_killed_visit_is_cleared_away_by_the_next(work, capture):
    workspace = Workspace.open(work)
    (work / "visits" / ".part-killed").mkdir(parents=True)
    assert workspace.visits == 0
    with workspace.new_visit() as folder:
        (folder / "change.json").write_text("{}")
    assert [p.name for p in (work / "visits").iterdir()] == ["001"]


def test_one_writer_at_a_time(work):
    workspace = Workspace.open(work)
    with (
        locked(work),
        pytest.raises(InputError, match="being written by another refield"),
        workspace.writing(),
    ):
        pass
    with workspace.writing():
        pass


def test_full_disk_is_refused_before_copying(work, capture, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(1, 1, 0))
    with pytest.raises(InputError, match="free some space"):
        Workspace.open(work).keep_capture(capture)


def test_damaged_tensors_are_refused(tmp_path):
    tensors = {"a": torch.randn(3, 4), "b": torch.arange(5)}
    write_tensors(tmp_path, tensors, {"n": 1})
    back, facts = read_tensors(tmp_path)
    assert facts == {"n": 1} and all(torch.equal(back[k], tensors[k]) for k in tensors)
    raw = bytearray((tmp_path / TENSORS).read_bytes())
    raw[-1] ^= 1
    (tmp_path / TENSORS).write_bytes(raw)
    with pytest.raises(InputError, match="damaged"):
        read_tensors(tmp_path)
    (tmp_path / TENSORS).unlink()
    with pytest.raises(InputError, match=r"field\.safetensors.*cannot be read"):
        read_tensors(tmp_path)


def test_a_field_of_another_shape_is_refused(work):
    tensors, facts = read_tensors(work / "field")
    facts["config"]["levels"] = 7
    write_tensors(work / "field", tensors, facts)
    with pytest.raises(InputError, match="does not describe a field"):
        Workspace.open(work).field()
