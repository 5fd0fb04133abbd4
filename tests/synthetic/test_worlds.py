"""Worlds: what they say changed is what changed, and the cameras stand where §11.1 puts them."""

import math

import numpy as np
import pytest
import torch

from refield.scene.pose import angle_between, invert, transform
from refield.scene.srgb import to_linear, to_srgb
from refield.synthetic.cameras import HEIGHTS, RADIUS, hemisphere, ring, square_camera
from refield.synthetic.paper_worlds import PAPER_MOVE
from refield.synthetic.placing import FLOOR_HALF
from refield.synthetic.shapes import Box, Cone, Cylinder, Sphere
from refield.synthetic.visibility import view_hits
from refield.synthetic.worlds import WORLDS

ONE_MOVED = ("cube", "cylinder", "sphere", "cone", "tipped", "shadow", "plain", "cluttered", "table")
KINDS = {name: ["moved"] for name in ONE_MOVED} | {
    "two_moved": ["moved", "moved"],
    "removed": ["removed"],
    "added": ["added"],
    "nothing": [],
}
UP = torch.tensor([0, 0, 1.0], dtype=torch.float64)


def uniform(n, seed=0):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture(scope="module")
def worlds():
    return {name: WORLDS[name](0) for name in KINDS}  # the hard ones have their own tests


def test_every_world_changes_as_its_name_says(worlds):
    assert {name: [c.kind for c in world.changes] for name, world in worlds.items()} == KINDS


def test_the_change_carries_the_old_shape_onto_the_new_one(worlds):
    for world in worlds.values():
        for change in (c for c in world.changes if c.kind == "moved"):
            x = uniform(500) * 1.2 - 0.6
            x = x + change.old.world_from_item[:3, 3]
            assert torch.allclose(
                change.old.distance(x), change.new.distance(transform(change.new_from_old, x)), atol=1e-9
            )


@pytest.mark.parametrize("name, solid", [("cube", Box), ("cylinder", Cylinder), ("sphere", Sphere), ("cone", Cone)])
def test_the_papers_objects_move_as_in_the_paper(worlds, name, solid):
    (change,) = worlds[name].changes
    assert isinstance(change.old.solid, solid)
    shift = change.new.world_from_item[:3, 3] - change.old.world_from_item[:3, 3]
    assert torch.allclose(shift, torch.tensor(PAPER_MOVE, dtype=torch.float64))
    assert angle_between(change.old.world_from_item, change.new.world_from_item) > 20
    assert torch.allclose(change.new_from_old[2], torch.tensor([0, 0, 1.0, 0], dtype=torch.float64), atol=1e-12)


def test_objects_stand_on_the_floor_apart_from_each_other(worlds):
    for world in worlds.values():
        for state in (world.before, world.after):
            objects = state.items[1:]
            for item in objects:
                box = item.box()
                assert box[0, 2] == pytest.approx(0, abs=1e-9)
                assert box[:, :2].abs().max() < FLOOR_HALF
            for i, a in enumerate(objects):
                lo, hi = a.box()
                x = lo + (hi - lo) * torch.rand(20000, 3, generator=torch.Generator().manual_seed(i)).double()
                inside = x[a.distance(x) < 0]
                assert all((b.distance(inside) > 0.02).all() for b in objects if b is not a)


def test_the_tipped_box_lies_on_another_face(worlds):
    (change,) = worlds["tipped"].changes
    up = change.new_from_old[:3, :3] @ UP
    assert abs(float(up[2])) < 1e-9


def test_the_true_grid_is_the_solid(worlds):
    for name in ("cube", "sphere", "cone", "tipped"):
        item = worlds[name].changes[0].old
        grid = item.grid()
        lo, hi = grid.aabb.double()
        x = lo + (hi - lo) * torch.rand(30000, 3, generator=torch.Generator().manual_seed(0)).double()
        d = item.distance(x)
        clear = d.abs() > 0.015
        assert torch.equal(grid.contains(x[clear].float()), (d < 0)[clear])


def test_textures_let_a_turn_be_seen(worlds):
    """Turned about the upright by any of many angles, an object looks different."""
    for name in ("cube", "cylinder", "sphere", "cone", "table"):
        item = worlds[name].changes[0].old
        if isinstance(item.solid, Box):
            h, w = item.texture.shape[0] // 2, item.texture.shape[1] // 3
            faces = [item.texture[r * h : (r + 1) * h, c * w : (c + 1) * w] for r in range(2) for c in range(3)]
            apart = [
                np.abs(a - np.rot90(b, k)).mean() for i, a in enumerate(faces) for b in faces[:i] for k in range(4)
            ]
            assert min(apart) > 0.1
        else:
            height, width = item.texture.shape[:2]
            side = item.texture[: height // 2]
            apart = [np.abs(side - np.roll(side, s, 1)).mean() for s in range(width // 12, width, width // 12)]
            assert min(apart) > 0.08


def test_textures_hold_no_detail_too_fine_for_small_photos(worlds):
    """Shrunk to what 128 pixels show and enlarged again, a texture stays what it was."""
    import cv2

    for world in worlds.values():
        for item in world.before.items[1:]:
            t = item.texture
            small = cv2.resize(t, (t.shape[1] // 4, t.shape[0] // 4), interpolation=cv2.INTER_AREA)
            back = cv2.resize(small, t.shape[1::-1], interpolation=cv2.INTER_CUBIC)
            assert np.sqrt(np.mean((back - t) ** 2)) < 0.06


def test_the_same_seed_is_the_same_world_and_another_is_another():
    a, b, c = (WORLDS["cube"](seed) for seed in (3, 3, 4))
    assert np.array_equal(a.before.items[1].texture, b.before.items[1].texture)
    assert np.array_equal(a.before.surroundings, b.before.surroundings)
    assert not np.array_equal(a.before.items[1].texture, c.before.items[1].texture)


@pytest.mark.parametrize("count", [180, 70, 73, 10])
def test_old_cameras_stand_on_ten_heights_and_look_inward(count):
    target = torch.tensor([0.1, 0.0, 0.2], dtype=torch.float64)
    poses = torch.stack(hemisphere(count, tuple(target.tolist())))
    assert len(poses) == count
    heights = (poses[:, 2, 3] * 1e6).round().unique()
    assert len(heights) == HEIGHTS and (poses[:, 2, 3] > target[2]).all()
    forward = target - poses[:, :3, 3]
    assert torch.allclose(forward.norm(dim=-1), torch.full((count,), RADIUS, dtype=torch.float64))
    assert torch.allclose(poses[:, :3, 2], forward / RADIUS, atol=1e-9)
    assert (poses[:, 2, 1] < 0).all()  # the picture's down is the world's down
    assert torch.allclose(torch.linalg.det(poses[:, :3, :3]), torch.ones(count, dtype=torch.float64))


def test_new_cameras_stand_on_a_ring_45_degrees_apart():
    poses = torch.stack(ring((0.0, 0.0, 0.15)))
    assert len(poses) == 8
    assert torch.allclose(poses[:, 2, 3], poses[0, 2, 3])
    turn = torch.atan2(poses[:, 1, 3], poses[:, 0, 3])
    step = (turn.diff() + 2 * math.pi) % (2 * math.pi)
    assert torch.allclose(step, torch.full((7,), math.radians(45), dtype=torch.float64))


def test_masks_agree_with_the_projected_grid(worlds):
    camera = square_camera(96)
    world = worlds["cone"]
    item = world.before.items[1]
    for pose in ring(world.target)[::3]:
        shown = view_hits(world.before, camera, pose).item == 1
        px, z = camera.project(transform(invert(pose), item.grid().occupied().double()))
        splat = torch.zeros(96, 96, dtype=torch.bool)
        column, row = px.long().unbind(-1)
        splat[row, column] = True
        assert (z > 0).all()
        assert (splat & shown).sum() / (splat | shown).sum() > 0.9


def test_srgb_curve_is_its_own_inverse():
    x = np.linspace(0, 1, 257, dtype=np.float32)
    assert np.abs(to_srgb(to_linear(x)) - x).max() < 1e-5
