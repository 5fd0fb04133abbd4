"""Random worlds: drawn from the seed alone, nothing in anything else, every change seen, truth beside the photos."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from refield.commands.synth import Synth, run
from refield.scene.change_files import load_change
from refield.scene.errors import InputError
from refield.scene.images import read_image, read_mask
from refield.scene.pose import angle_between
from refield.scene.transforms_json import load_transforms
from refield.synthetic import random_changes as change
from refield.synthetic.disturb import Disturbance, disturbed_photo, falloff
from refield.synthetic.random_objects import FAMILIES, drawn_item, random_item
from refield.synthetic.random_paths import draw_camera, draw_path
from refield.synthetic.random_places import Patch, draw_place
from refield.synthetic.random_rounds import ROUNDS
from refield.synthetic.random_scenes import draw_kinds
from refield.synthetic.random_views import Views, differs
from refield.synthetic.random_worlds import _every_kind, random_world
from refield.synthetic.shapes import Box
from refield.synthetic.state import Lamp
from refield.synthetic.terrain import Terrain
from refield.synthetic.write import SynthConfig

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
SEEDS = (0, 1)
FLAT = Patch((-2.0, -2.0), (2.0, 2.0))


@pytest.fixture(scope="module")
def worlds():
    return {seed: random_world(seed, 12) for seed in SEEDS}


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_rests_on_the_ground_and_has_its_size(family):
    item, name, _ = drawn_item(np.random.default_rng(3), "thing", 0.4, family=family)
    low, high = change.extent(item)
    assert name == family and low[2] == pytest.approx(0, abs=1e-9)
    assert np.abs((low + high)[:2]).max() < 1e-6
    assert 0.6 * 0.4 < np.sqrt(np.mean((high - low) ** 2)) < 1.4 * 0.4
    assert item.texture.ndim == 3 and item.texture.min() >= 0 and item.texture.max() <= 1
    vertices = torch.from_numpy(change.vertices_of(item.solid))
    assert item.solid.distance(vertices).max() < 1e-6


def test_an_object_is_its_streams_own():
    a, b, c = (random_item(np.random.default_rng(k), "x", 0.3) for k in (5, 5, 6))
    assert a.solid == b.solid and np.array_equal(a.texture, b.texture)
    assert a.solid != c.solid


def test_a_world_is_its_seeds_own_whatever_the_number_of_photos(worlds):
    again = random_world(1, 20)
    first = worlds[1]
    assert again.facts | {"photos": 12} == first.facts
    assert all(torch.equal(a, b) for a, b in zip(again.new + again.evaluation, first.new + first.evaluation))
    for a, b in zip(again.world.after.items, first.world.after.items):
        assert a.solid == b.solid and torch.equal(a.world_from_item, b.world_from_item)
    assert worlds[0].facts != first.facts


def test_what_is_told_is_what_changed(worlds):
    for drawn in worlds.values():
        told = {o["name"]: o["change"] for o in drawn.facts["objects"]}
        kinds = {(c.old or c.new).name: c.kind for c in drawn.world.changes}
        assert {name for name, kind in told.items() if kind != "none"} == set(kinds)
        for name, kind in kinds.items():
            assert told[name] == kind or (kind == "moved" and told[name] not in ("none", "added", "removed"))
        for c in drawn.world.changes:
            if c.kind == "moved":
                assert change.moved_enough(c.old, c.new)


def test_objects_keep_clear_of_each_other_and_rest_on_something(worlds):
    for drawn in worlds.values():
        names = {o["name"] for o in drawn.facts["objects"]}
        for state in (drawn.world.before, drawn.world.after):
            objects = [item for item in state.items if item.name in names]
            fixed = [item for item in state.items[1:] if item.name not in names]
            assert change.all_apart(objects, fixed)
            for item in objects:
                x = change.vertices_of(item.solid) @ change.rotation(item).T + item.world_from_item[:3, 3].numpy()
                under = torch.from_numpy(x)
                gap = min(float(other.distance(under).min()) for other in state.items if other is not item)
                assert -1e-6 < gap < 0.002


def test_new_and_old_cameras_differ_and_look_at_the_place(worlds):
    for drawn in worlds.values():
        poses = [*drawn.old, *drawn.new, *drawn.evaluation]
        assert len(drawn.new) == len(drawn.evaluation) == 4 and len(drawn.old) == 12
        for i, a in enumerate(poses):
            assert torch.allclose(a[:3, :3] @ a[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-9)
            to = torch.nn.functional.normalize(torch.tensor(drawn.world.target).double() - a[:3, 3], dim=0)
            assert float(a[:3, 2] @ to) > 0.85
            assert all(not torch.allclose(a, b) for b in poses[:i])


def test_kinds_are_drawn_as_often_as_meant():
    rng = np.random.default_rng(0)
    drawn = [draw_kinds(rng) for _ in range(600)]
    assert 0.06 < sum(not kinds for kinds in drawn) / 600 < 0.15
    assert {kind for kinds in drawn for kind in kinds} > {"moved", "tipped", "stacked", "swapped", "removed", "added"}


def test_a_box_stands_on_six_faces_and_a_tipped_one_on_another():
    item = random_item(np.random.default_rng(1), "box", 0.3, family="box")
    assert len(change.stable_turns(item.solid)) == 6
    turn = change.other_face(np.random.default_rng(0), item)
    tipped = change.placed_on(item, FLAT, (0.3, 0.1), turn)
    assert float(angle_between(tipped.world_from_item, item.world_from_item)) > 40
    assert change.extent(tipped)[0, 2] == pytest.approx(0.0005, abs=1e-6)


def test_what_is_stacked_stands_on_the_others_top():
    rng = np.random.default_rng(2)
    table = replace(random_item(rng, "table", 0.4, family="box"), solid=Box((0.2, 0.2, 0.1)))
    table = change.placed_on(table, FLAT, (0.5, 0.0), np.eye(3))
    small = random_item(rng, "small", 0.12, family="can")
    on = change.stacked(rng, small, table)
    assert change.extent(on)[0, 2] == pytest.approx(change.extent(table)[1, 2], abs=0.001)
    assert change.apart(on, [table])
    assert change.stacked(rng, small, random_item(rng, "ball", 0.4, family="ball")) is None


def test_things_in_each_other_are_not_apart():
    item = random_item(np.random.default_rng(0), "a", 0.3, family="box")
    assert not change.apart(item, [change.placed_on(item, FLAT, (0.05, 0.0), np.eye(3))])
    assert change.apart(item, [change.placed_on(item, FLAT, (1.0, 0.0), np.eye(3))])


def test_on_a_slope_an_object_leans_with_the_ground():
    terrain = Terrain(3.0, (0.2, 0.0))
    patch = replace(FLAT, terrain=terrain)
    item = change.placed_on(
        random_item(np.random.default_rng(1), "b", 0.3, family="box"), patch, (0.4, 0.2), change.about_z(0.3)
    )
    assert np.allclose(change.rotation(item)[:, 2], terrain.normal(0.4, 0.2))
    x = change.vertices_of(item.solid) @ change.rotation(item).T + item.world_from_item[:3, 3].numpy()
    heights = x[:, 2] - patch.heights(x[:, 0], x[:, 1])
    assert heights.min() == pytest.approx(0.0005, abs=1e-6)
    assert np.allclose(change.upright(item) @ [0, 0, 1], [0, 0, 1], atol=1e-6)


def test_a_turn_that_nothing_shows_is_no_change():
    rng = np.random.default_rng(4)
    place, camera = draw_place(rng, outdoors=True), draw_camera(rng)
    path = draw_path(rng, replace(place, target=(0.0, 0.0, 0.1), views=("orbit",)), camera)
    views = Views(camera, [], path.new_poses(rng, 4), [], path.distance)
    can = random_item(rng, "can", 0.5 * place.reach, family="can", patterns=("plain",))
    can = replace(can, texture=np.full((8, 8, 3), 0.5, np.float32))
    assert not differs(views, can, can.turned(60, (0, 0, 0)))
    assert differs(views, can, can.turned(0, (0.5 * place.reach, 0, 0)))
    box = random_item(rng, "box", 0.5 * place.reach, family="box", patterns=("painted",))
    assert differs(views, box, box.turned(50, (0, 0, 0)))


def test_vignetting_darkens_the_corners_alike_in_all_photos():
    image = torch.full((40, 60, 3), 128, dtype=torch.uint8)
    worse = Disturbance(vignetting=0.4)
    seen = disturbed_photo(image, worse, "a")
    assert torch.equal(seen, disturbed_photo(image, worse, "b"))
    assert seen[20, 30, 0] == 128 and seen[0, 0, 0] < 110
    light = falloff(worse, 40, 60)[..., 0]
    assert light.min() == pytest.approx(0.6, abs=0.02) and np.allclose(light, light[::-1, ::-1])
    with pytest.raises(InputError, match="vignetting"):
        Disturbance(vignetting=1.5)


def test_each_worlds_own_number_of_photos_is_asked_for(tmp_path):
    with pytest.raises(InputError, match="give --photos"):
        run(Synth("random", tmp_path / "x", config=SynthConfig(cameras=20)))
    with pytest.raises(InputError, match="give --cameras"):
        run(Synth("cube", tmp_path / "x", config=SynthConfig(photos=20)))
    with pytest.raises(InputError, match="--path"):
        run(Synth("cube", tmp_path / "x", config=SynthConfig(path="walk")))
    with pytest.raises(InputError, match="photos"):
        SynthConfig(photos=3)
    assert not (tmp_path / "x").exists()


def test_a_written_random_world_is_complete_and_well_exposed(tmp_path):
    pytest.importorskip("mitsuba", reason="the renderer is an extra: pip install 'refield[synth]'")
    from refield.synthetic.random_write import write_random

    seed = SEEDS[0]
    drawn = write_random(tmp_path, SynthConfig(size=24, spp=4, photos=10, seed=seed))
    before, after, evaluation = (load_transforms(tmp_path / part) for part in ("before", "after", "eval"))
    assert (len(before.frames), len(after.frames), len(evaluation.frames)) == (10, 4, 4)
    for frame, pose in zip(evaluation.frames, drawn.evaluation):
        assert torch.allclose(frame.world_from_cam, pose)  # clean; the old ones are off as the seed says
        assert np.load(tmp_path / "eval" / "depth" / f"{frame.path.stem}.npz")["depth"].shape == (
            frame.camera.height,
            frame.camera.width,
        )
        read_mask(tmp_path / "eval" / "masks_in" / frame.path.name)
    off = [float((f.world_from_cam - p).abs().max()) for f, p in zip(before.frames, drawn.old)]
    assert (max(off) > 1e-6) == (drawn.disturbance is not None and drawn.disturbance.pose_px > 0)
    change_found = load_change(tmp_path / "truth", before, photos=after.frames)
    assert len(change_found.objects) == len(drawn.world.changes)
    facts = json.loads((tmp_path / "truth" / "world.json").read_text())
    assert facts["seed"] == seed and facts["light_factor"] > 0 and facts["objects"]
    shown = np.mean([read_image(f.path).numpy().mean() / 255 for f in evaluation.frames])
    assert abs(shown - drawn.brightness) < 0.15


def test_more_light_is_more_of_every_light(worlds):
    state = replace(worlds[0].world.before, sun=(1.0, 2.0, 3.0), lamps=(Lamp((0, 0, 2), (1.0, 1.0, 2.0)),))
    more = state.brightened(2.0)
    assert more.sun == (2.0, 4.0, 6.0) and more.lamps[0].light == (2.0, 2.0, 4.0)
    assert np.allclose(more.surroundings, 2 * state.surroundings)


@pytest.mark.parametrize("path", ROUNDS)
def test_a_world_can_be_photographed_from_within(path):
    """Old photos look in all directions, the new ones at the objects."""
    drawn = random_world(2, 40, path)
    assert drawn.facts["path"] == path and drawn.facts["place"] == "around"
    ways = torch.stack([pose[:2, 2] for pose in drawn.old])
    sides = {(bool(x > 0), bool(y > 0)) for x, y in ways}
    assert len(sides) == 4
    for pose in (*drawn.new, *drawn.evaluation):
        to = torch.nn.functional.normalize(torch.tensor(drawn.world.target).double() - pose[:3, 3], dim=0)
        assert float(pose[:3, 2] @ to) > 0.9
    out = torch.stack([pose[:2, 3] @ pose[:2, 2] / pose[:2, 3].norm() for pose in drawn.old])
    assert (out > 0.8).all() if path == "inside-out" else (out < 0.8).all()


def test_a_path_and_formats_can_be_asked_for_and_earlier_seeds_stay():
    drawn = random_world(0, 30, "forward", mixed=True)
    assert drawn.facts["path"] == "forward" and drawn.facts["portrait and landscape"]
    cameras = drawn.cameras("before", 30)
    sizes = {(c.width, c.height) for c in cameras}
    assert sizes == {(drawn.camera.width, drawn.camera.height), (drawn.camera.height, drawn.camera.width)}
    assert cameras == drawn.cameras("before", 30)
    with pytest.raises(InputError, match="no such path"):
        random_world(0, 30, "sideways")


def test_later_seeds_draw_every_kind_of_capture():
    kinds = [_every_kind(seed) for seed in range(2000, 2200)]
    assert {path for path, _, _ in kinds} == {None, *ROUNDS}
    assert 30 < sum(mixed for _, mixed, _ in kinds) < 100
    counts = [count for _, _, count in kinds]
    assert min(counts) >= 20 and max(counts) <= 300 and min(counts) < 30 and max(counts) > 200
