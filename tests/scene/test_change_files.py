"""What is saved of a change comes back; what is damaged is refused."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, Placement, SceneChange
from refield.scene.change_files import load_change, save_change
from refield.scene.errors import InputError
from refield.scene.pose import exp
from tests.captures import DISTORTED, write_capture


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "old", 12, DISTORTED)


@pytest.fixture
def change(tmp_path, capture):
    """One of each kind, two used photos and a rejected one."""
    g = torch.Generator().manual_seed(0)
    grid = OccupancyGrid(torch.tensor([[-1.0, 0, 1], [1, 2, 2]]), torch.rand(9, 8, 7, generator=g))
    masks = tuple(None if i % 3 == 1 else torch.rand(24, 32, generator=g) > 0.7 for i in range(11))
    turn = exp(torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=torch.float64))
    covariance = torch.eye(6, dtype=torch.float64) * 1e-6
    objects = (
        ObjectChange("moved", grid, turn, masks, masks[::-1], 0.7, covariance, "a weak match", (turn @ turn,)),
        ObjectChange("removed", grid, masks=masks),
        ObjectChange("added", grid, masks_in=masks),
    )
    new = write_capture(tmp_path / "visit" / "photos", 2, DISTORTED, turn=0.2)
    photos = tuple(PlacedPhoto(f"their/{f.name}", "used", "", replace(f, name=f"their/{f.name}")) for f in new.frames)
    photos = (replace(photos[0], placement=Placement(120, 150, 0.4, "that of the old photos")), photos[1])
    photos += (PlacedPhoto("blurred.png", "rejected", "7 inliers", placement=Placement(7, 90, 1.5)),)
    seen = (torch.rand(24, 32) > 0.5, torch.rand(24, 32) > 0.5)
    return SceneChange(objects, photos, "because", seen, seen[::-1])


def same(a, b):
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    return len(a) == len(b) and all(x is y is None or torch.equal(x, y) for x, y in zip(a, b))


def test_photos_that_were_not_placed_join_those_that_were_compared(change):
    compared = replace(change, photos=(replace(change.photos[0], placement=None, why="darker"), change.photos[1]))
    placed = [change.photos[2], replace(change.photos[0], why=""), change.photos[1]]
    joined = compared.among(placed)
    assert [p.name for p in joined.photos] == [p.name for p in placed]
    assert joined.photos[1].why == "darker" and joined.photos[1].placement == change.photos[0].placement
    assert joined.frames == change.frames, "in the order of the masks"


def test_round_trip(tmp_path, capture, change):
    folder = tmp_path / "visit"
    save_change(folder, change)
    back = load_change(folder, capture)
    assert back.why == "because"
    assert same(back.masks_in, change.masks_in) and same(back.masks_out, change.masks_out)
    for a, b in zip(change.objects, back.objects, strict=True):
        assert (a.kind, a.confidence, a.note) == (b.kind, b.confidence, b.note)
        assert same(a.grid.aabb, b.grid.aabb) and same(a.grid.values, b.grid.values)
        assert same(a.masks, b.masks) and same(a.masks_in, b.masks_in)
        pairs = ((a.new_from_old, b.new_from_old), (a.covariance, b.covariance))
        for x, y in (*pairs, *zip(a.alternatives, b.alternatives, strict=True)):
            assert x is y is None or torch.equal(x, y)
    for a, b in zip(change.photos, back.photos, strict=True):
        assert (a.name, a.status, a.why, a.placement) == (b.name, b.status, b.why, b.placement)
        if a.frame is not None:
            assert b.frame.path == a.frame.path.resolve() and b.frame.camera == a.frame.camera
            assert torch.equal(a.frame.world_from_cam, b.frame.world_from_cam)


def test_masks_that_nobody_asks_for_are_not_read(tmp_path, capture, change):
    folder = tmp_path / "visit"
    save_change(folder, change)
    shutil.rmtree(folder / "masks")
    bare = load_change(folder, capture, masks=False)
    assert [o.kind for o in bare.objects] == [o.kind for o in change.objects]
    assert not any((*bare.masks_in, *bare.masks_out, *bare.unexplained, *(m for o in bare.objects for m in o.masks)))
    with pytest.raises(InputError):
        load_change(folder, capture)


def test_the_json_is_the_one_that_is_promised(tmp_path, change):
    folder = tmp_path / "visit"
    save_change(folder, change)
    record = json.loads((folder / "change.json").read_text())
    first = record["objects"][0]
    assert first["kind"] == "moved" and first["grid"] == "grid_0.npz"
    assert np.array(first["new_from_old"]).shape == (4, 4) and np.array(first["aabb"]).shape == (2, 3)
    assert record["objects"][1]["new_from_old"] is None
    assert record["photos"][0]["file"] == "their/images/000.png" and record["photos"][2]["status"] == "rejected"
    assert np.array(record["photos"][0]["world_from_cam"]).shape == (4, 4)
    with np.load(folder / "grid_0.npz", allow_pickle=False) as grid:
        assert set(grid) == {"aabb", "values"}
    written = [p for p in folder.rglob("*") if p.is_file() and "photos" not in p.parts]
    assert not any("their" in str(p) for p in written)  # no name comes from the input


def test_nothing_changed_is_a_change_too(tmp_path):
    save_change(tmp_path, SceneChange(why="all pixels agree"))
    assert load_change(tmp_path) == SceneChange(why="all pixels agree")
    assert [p.name for p in tmp_path.iterdir()] == ["change.json"]


def test_photos_elsewhere_are_found_by_name(tmp_path, capture):
    frame = capture.frames[0]
    save_change(tmp_path, SceneChange(photos=(PlacedPhoto(frame.name, "used", "", frame),)))
    (found,) = load_change(tmp_path, photos=capture.frames).frames
    assert found.path == frame.path and torch.equal(found.world_from_cam, frame.world_from_cam)


def first(key, value):
    return lambda record, folder: record["objects"][0].__setitem__(key, value)


def spoil_grid(**arrays):
    def apply(record, folder):
        kept = {"aabb": np.array([[0, 0, 0], [1, 1, 1.0]]), "values": np.zeros((3, 3, 3))} | arrays
        np.savez(folder / "grid_0.npz", **kept)

    return apply


DAMAGED = {
    "kind": (first("kind", "stolen"), "stolen"),
    "no objects": (lambda r, f: r.pop("objects"), "objects"),
    "objects text": (lambda r, f: r.update(objects="none"), "not a change"),
    "pose": (first("new_from_old", [[1, 2], [3, 4]]), "4x4"),
    "pose text": (first("new_from_old", "far"), "not a change"),
    "pose missing": (first("new_from_old", None), "moved"),
    "grid elsewhere": (first("grid", "../../old/transforms.json"), "leads out"),
    "mask elsewhere": (first("masks", ["../../x.png"] * 11), "leads out"),
    "grid is text": (lambda r, f: (f / "grid_0.npz").write_text("x"), r"grid_0\.npz.*not a readable grid"),
    "grid is gone": (lambda r, f: (f / "grid_0.npz").unlink(), r"grid_0\.npz"),
    "grid nan": (spoil_grid(values=np.full((3, 3, 3), np.nan)), r"outside \[0, 1\]"),
    "grid shape": (spoil_grid(values=np.zeros(3)), "box or shape"),
    "grid box": (spoil_grid(aabb=np.zeros((2, 3))), "box or shape"),
    "grid pickle": (spoil_grid(values=np.array([{}], object)), "not a readable grid"),
    "too few masks": (first("masks", [None] * 4), "4 masks for 11 training frames"),
    "mask is gone": (lambda r, f: (f / "masks" / "0_old_0000.png").unlink(), "no such image"),
    "photo status": (lambda r, f: r["photos"][0].update(status="lost"), "lost"),
    "photo camera": (lambda r, f: r["photos"][0]["camera"].pop("fl_x"), "focal"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damage_is_named(tmp_path, capture, change, case):
    folder = tmp_path / "visit"
    save_change(folder, change)
    record = json.loads((folder / "change.json").read_text())
    spoil, says = DAMAGED[case]
    spoil(record, folder)
    (folder / "change.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=says):
        load_change(folder, capture)
