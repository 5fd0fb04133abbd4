"""Objects put into photos of a scene whose field is known: they stand on its floor, are hidden by it, and are told."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from refield.cli import main
from refield.commands import rehearse
from refield.commands.answer import told
from refield.field.fit import FitConfig
from refield.field.render import render_camera
from refield.rehearse.compose import compose, compose_several, divided, scenery_of
from refield.rehearse.plan import HAPPENINGS
from refield.rehearse.surfaces import View, _planes
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.change_files import load_change
from refield.scene.errors import InputError
from refield.scene.files import read_json
from refield.scene.images import frame_image, read_image, read_mask, write_image
from refield.scene.transforms_json import load_transforms
from refield.synthetic.cameras import hemisphere
from refield.synthetic.oracles import AnalyticField
from refield.synthetic.placing import box_item, floor
from refield.synthetic.random_textures import PATTERNS
from refield.synthetic.state import State
from refield.workspace import Workspace

CAMERA = Camera(72, 64, 70.0, 70.0, 36.0, 32.0, k1=0.05)
COUNT = 20


@pytest.fixture(scope="module")
def scenery(tmp_path_factory):
    """A floor with one box on it, photographed by its own field."""
    rng, folder = np.random.default_rng(0), tmp_path_factory.mktemp("photos")
    state = State((floor(rng), box_item(rng, "box", (0.12, 0.12, 0.2), 0.6, (0.0, 0.0, 20.0))), np.zeros((1, 2, 3)))
    field = AnalyticField(state, resolution=64)
    poses = hemisphere(COUNT * 2, (0.0, 0.0, 0.1))[COUNT // 2 : COUNT // 2 + COUNT]
    frames = []
    for i, pose in enumerate(poses):
        path = folder / f"{i:03d}.png"
        write_image(path, render_camera(field, CAMERA, pose).rgb)
        frames.append(Frame(path, CAMERA, path.name, pose))
    return scenery_of(field, Capture(tuple(frames)))


@pytest.fixture(scope="module")
def rehearsed(scenery, tmp_path_factory):
    """A rehearsal's folder and plan by its seed, each composed once."""

    @cache
    def of(seed):
        folder = tmp_path_factory.mktemp(f"seed_{seed}")
        return folder, compose(scenery, folder, seed)

    return of


def test_the_photos_are_divided(scenery):
    photos = divided(scenery.capture)
    names = [f.name for group in (photos.before, photos.after, photos.evaluation) for f in group]
    assert sorted(names) == sorted(f.name for f in scenery.capture.frames)
    assert len(photos.after) == len(photos.evaluation) == 4
    with pytest.raises(InputError, match="needs 20"):
        divided(Capture(scenery.capture.frames[:10]))


def test_the_floor_is_found(scenery):
    plane = scenery.surfaces.planes[0]
    assert plane.normal[2] > 0.995 and abs(plane.offset) < 0.02


def test_photos_of_nothing_but_a_floor_show_one_plane(scenery):
    level = torch.eye(4, dtype=torch.float64)
    level[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # it looks straight down
    level[2, 3] = 2.0
    camera = replace(CAMERA, k1=0.0)
    depth = (-2.0 / camera_rays(camera, level).directions[:, 2]).reshape(camera.height, camera.width).float()
    view = View(Frame(Path("none.png"), camera, "none.png", level), camera, torch.zeros(*depth.shape, 3), depth)
    (plane,) = _planes([view], scenery.up, 0.01)
    assert plane.normal[2] == pytest.approx(1, abs=1e-4) and plane.offset == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("seed", range(len(HAPPENINGS)))
def test_what_happens_is_what_is_told(rehearsed, seed):
    folder, plan = rehearsed(seed)
    before, after = load_transforms(folder / "before"), load_transforms(folder / "after")
    truth = load_change(folder / "truth", before)
    assert len(before.frames) == COUNT - 8 and len(after.frames) == 4
    assert before.frames[0].camera == CAMERA
    kinds, happening = [o.kind for o in truth.objects], HAPPENINGS[seed]
    expected = {"turned": ["moved"], "tipped": ["moved"], "nothing": []}.get(happening, [happening])
    assert kinds == expected if happening != "several" else len(kinds) >= 2
    assert plan.facts["changes"] == kinds and not plan.facts["floating"]
    told = [o["change"] for o in plan.facts["objects"] if o["change"] != "none"]
    assert sorted(told) == sorted(kinds) and all(o["texture"] in PATTERNS for o in plan.facts["objects"])
    for item in (*plan.world.before.items, *plan.world.after.items):
        vertices = torch.from_numpy(item.solid.mesh()[0]).double() @ item.world_from_item[:3, :3].T
        lowest = float((vertices[:, 2] + item.world_from_item[2, 3]).min())
        assert abs(lowest) < 0.04, "it stands on the floor"


def test_the_old_photos_change_only_by_the_objects(scenery, rehearsed):
    folder, _ = rehearsed(0)
    before = load_transforms(folder / "before")
    truth = load_change(folder / "truth", before)
    shown = [m.float().mean() for m in truth.objects[0].masks]
    assert sum(m > 0.005 for m in shown) >= len(shown) / 3
    for frame, was, mask in zip(before.train, _train(scenery, before), truth.objects[0].masks):
        differs = (frame_image(frame) != was).any(-1)
        assert differs.float().mean() < 0.7 and (mask & differs).sum() >= 0.8 * mask.sum()


def _train(scenery, before):
    photos = {f"images/{i:04d}.png": f for i, f in enumerate(scenery.photos.before)}
    return [frame_image(photos[f.name]) for f in before.train]


def test_the_masks_and_depths_of_the_new_photos(rehearsed):
    folder, plan = rehearsed(0)
    seen = 0
    for frame in load_transforms(folder / "eval").frames:
        now = read_mask(folder / "eval" / "masks_in" / frame.path.name)
        depth = np.load(folder / "eval" / "depth" / f"{frame.path.stem}.npz")["depth"]
        away = float((plan.world.after.items[0].world_from_item[:3, 3] - frame.centre).norm())
        reach = 2 * max(plan.world.after.items[0].solid.half)
        assert (np.abs(depth[now.numpy()] - away) < reach).all()
        seen += int(now.sum())
    assert seen > 100


def test_the_same_seed_makes_the_same_photos(scenery, rehearsed, tmp_path):
    compose(scenery, tmp_path, 2)
    a, b = (read_image(folder / "before" / "images" / "0003.png") for folder in (tmp_path, rehearsed(2)[0]))
    assert torch.equal(a, b)


def test_several_changes_begin_with_the_same_photos(scenery, tmp_path):
    folders = compose_several(scenery, tmp_path, 3, 4)
    before = load_transforms(tmp_path / "before")
    assert [f.name for f in folders] == [f"change-{k:02d}" for k in range(4)] and len(before.frames) == COUNT - 8
    truths = [load_change(folder / "truth", before) for folder in folders]
    facts = [read_json(folder / "truth" / "world.json") for folder in folders]
    for k, (folder, truth, fact) in enumerate(zip(folders, truths, facts)):
        gone = [o for o in truth.objects if o.kind != "added"]
        assert len(gone) == 1 + k % 3 and fact["changes"] == [o.kind for o in truth.objects] and fact["change"] == k
        after = load_transforms(folder / "after")
        assert len(after.frames) == 4
        for frame, now, then in zip(after.frames, truth.masks_in, truth.masks_out):
            assert torch.equal(read_mask(folder / "after" / "masks_in" / frame.path.name), now)
            assert torch.equal(read_mask(folder / "after" / "masks_out" / frame.path.name), then)
        differs = (frame_image(after.frames[0]) != frame_image(scenery.photos.after[0])).any(-1)
        assert (truth.masks_in[0] & differs).sum() >= 0.8 * truth.masks_in[0].sum()
        # the old photos show what left or moved, whichever change is asked
        for o in gone:
            assert sum(int(m.sum()) for m in o.masks if m is not None) > 50
    assert len({str(fact["objects"]) for fact in facts}) > 1
    compose_several(scenery, tmp_path / "again", 3, 2)
    for name in ("before/images/0003.png", "change-01/after/images/0002.png"):
        assert torch.equal(read_image(tmp_path / name), read_image(tmp_path / "again" / name))


def test_without_a_plane_things_float_and_this_is_told(scenery, tmp_path):
    surfaces = replace(scenery.surfaces, planes=())
    plan = compose(replace(scenery, surfaces=surfaces), tmp_path, 1)
    assert plan.facts["floating"] and load_change(tmp_path / "truth").objects[0].kind == "added"


def test_where_no_photo_sees_anything_there_is_no_place(scenery, tmp_path):
    views = tuple(replace(v, depth=torch.full_like(v.depth, 1e-3)) for v in scenery.surfaces.views)
    with pytest.raises(InputError, match="no free place"):
        compose(replace(scenery, surfaces=replace(scenery.surfaces, views=views)), tmp_path, 0)


def test_a_capture_without_a_field_is_refused(tmp_path, capsys):
    (tmp_path / "data").mkdir()
    data, out = str(tmp_path / "data"), str(tmp_path / "o")
    for command in (["rehearse", data], ["synth", "random", out, "--into", data]):
        assert main(command) == 2
        assert "train it first" in capsys.readouterr().err
    assert main(["synth", "cube", out, "--into", data]) == 2
    assert "random" in capsys.readouterr().err


def test_several_changes_are_rehearsed_on_one_training(scenery, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(rehearse, "prepared", lambda *_: (scenery, 1.0))
    out = tmp_path / "out"
    asked = rehearse.Rehearse(tmp_path / "work", "3", out, changes=2, fit=FitConfig(steps=40))
    told(lambda: rehearse.run(asked), as_json=False)
    done = read_json(out / rehearse.REPORT)["rehearsals"]
    assert [(r["seed"], r["number"], r["facts"]["change"]) for r in done] == [(3, 0, 0), (3, 1, 1)]
    assert done[0]["held_out_psnr"] == done[1]["held_out_psnr"] > 10
    assert all(r["evaluation"]["pooled"]["psnr"] > 5 and r["refused"] == "" for r in done)
    said = capsys.readouterr().out
    assert "3.0" in said and "3.1" in said and "of 2 changes" in said
    assert Workspace.open(out / "003/work").visits == 1  # the last; those before are taken back
    assert main(["rehearse", str(tmp_path / "work"), "--changes", "0"]) == 2
    assert "--changes" in capsys.readouterr().err


def test_a_rehearsal_from_photos_to_numbers(scenery, tmp_path, capsys, monkeypatch):
    """All of it, with a training so short that nothing is found."""
    monkeypatch.setattr(rehearse, "prepared", lambda *_: (scenery, 1.0))
    out = tmp_path / "out"
    asked = rehearse.Rehearse(tmp_path / "work", "1", out, fit=FitConfig(steps=40))
    told(lambda: rehearse.run(asked), as_json=False)
    (one,) = read_json(out / rehearse.REPORT)["rehearsals"]
    assert one["facts"]["happening"] == "added" and [o["kind"] for o in one["change"]["objects"]] == ["added"]
    assert one["held_out_psnr"] > 10 and one["evaluation"]["pooled"]["psnr_in"] > 5 and one["refused"] == ""
    assert "1 │ added " in capsys.readouterr().out
    assert (out / "001/work/visits/001/report.html").is_file() and (out / "001/data/truth/change.json").is_file()
