"""The hard worlds stand as things do, differ as they say, and are hard in the way their name says."""

import numpy as np
import pytest
import torch

from refield.scene.pose import angle_between, transform
from refield.synthetic import textures
from refield.synthetic.cameras import ring, square_camera
from refield.synthetic.pathtrace import PathTracer
from refield.synthetic.placing import FLOOR_HALF
from refield.synthetic.visibility import silhouette
from refield.synthetic.worlds import WORLDS
from refield.synthetic.write import masks, true_change
from tests.synthetic.test_worlds import KINDS

HARD = {name: ["moved"] for name in ("thin", "pole", "nudged", "turned", "spun", "edge")} | {
    "touching": ["moved"],
    "docked": ["moved"],
    "stacked": ["moved"],
    "swapped": ["moved", "moved"],
    "five": ["moved"] * 5,
    "mixed": ["moved", "moved", "removed", "removed", "added"],
    "mirror": ["moved"],
    "shiny": ["moved"],
    "deformed": ["removed", "added"],
    "lights_off": [],
    "elsewhere": ["removed"] * 4 + ["added"] * 4,
}
IN_CONTACT = {("touching", "before"): 2, ("docked", "after"): 1, ("stacked", "before"): 1}  # pairs of objects


def speckle(height, width):
    return lambda rng, *_, **__: rng.random((height, width, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def worlds():
    """The real layouts; paint and light are specks, because the real ones take a second a world."""
    with pytest.MonkeyPatch.context() as patch:
        for paint in ("bricks", "tiles", "wood"):
            patch.setattr(textures, paint, speckle(8, 8))
        patch.setattr(textures, "painted_box", speckle(8, 12))
        patch.setattr(textures, "patchwork", lambda points, rng, *_: speckle(8, 8)(rng))
        patch.setattr(textures, "surroundings", speckle(16, 32))
        return {name: WORLDS[name](0) for name in HARD}


def gap(a, b):
    """Metres between two items by their signed distances, negative where they share space."""
    (lo_a, hi_a), (lo_b, hi_b) = a.box(), b.box()
    apart = float(torch.maximum(lo_a - hi_b, lo_b - hi_a).max())
    if apart > 0.05:
        return apart
    box = torch.stack([torch.minimum(lo_a, lo_b), torch.maximum(hi_a, hi_b)])
    for _ in range(10):  # convex solids: ever closer around the point that is nearest to both
        axes = [torch.linspace(float(lo), float(hi), 15, dtype=torch.float64) for lo, hi in box.T]
        x = torch.cartesian_prod(*axes)
        both = torch.maximum(a.distance(x), b.distance(x))
        best, reach = x[both.argmin()], (box[1] - box[0]) / 5
        box = torch.stack([best - reach, best + reach])
    return 2 * float(both.min())


def pairs(state):
    objects = state.items[1:]
    return [(a, b) for i, a in enumerate(objects) for b in objects[i + 1 :]]


def test_every_world_changes_as_its_name_says(worlds):
    assert set(WORLDS) == HARD.keys() | KINDS.keys()
    assert {name: [c.kind for c in world.changes] for name, world in worlds.items()} == HARD
    assert [name for name, world in worlds.items() if not world.rigid] == ["deformed"]


@pytest.mark.parametrize("name", HARD)
def test_objects_rest_on_the_floor_or_on_each_other_and_never_share_space(worlds, name):
    for when in ("before", "after"):
        state = getattr(worlds[name], when)
        for item in state.items[1:]:
            foot = item.box()[0, 2]
            if abs(foot) > 1e-9:
                assert (name, item.name) == ("stacked", "small") and foot == pytest.approx(0.34)
            assert item.box()[:, :2].abs().max() < FLOOR_HALF
        gaps = [gap(a, b) for a, b in pairs(state)]
        assert all(-1e-6 < g < 0.002 or g > 0.05 for g in gaps)
        assert sum(g < 0.002 for g in gaps) == IN_CONTACT.get((name, when), 0)


def test_the_small_box_stands_on_the_large_one(worlds):
    """Its whole foot is carried."""
    large, small = (worlds["stacked"].before.named(n) for n in ("large", "small"))
    a, b, c = small.solid.half
    foot = transform(
        small.world_from_item, torch.tensor([[x * a, y * b, -c] for x in (-1, 1) for y in (-1, 1)]).double()
    )
    assert (large.distance(foot).abs() < 1e-6).all()


def test_the_same_seed_is_the_same_world_and_another_is_another():
    a, b, c = (WORLDS["docked"](seed).after.items[1] for seed in (3, 3, 4))
    assert np.array_equal(a.texture, b.texture) and not np.array_equal(a.texture, c.texture)


def test_objects_that_keep_their_name_keep_their_paint(worlds):
    for world in worlds.values():
        for old in world.before.items:
            new = world.after.named(old.name)
            assert new is None or np.array_equal(old.texture, new.texture)


def test_real_paint_lets_swapped_boxes_be_told_apart():
    one, two = (item.texture for item in WORLDS["swapped"](0).before.items[1:])
    assert min(one.std((0, 1)).max(), two.std((0, 1)).max()) > 0.15 and np.abs(one - two).mean() > 0.15


def moved(world, index=0):
    """Shift in metres and turn in degrees of a moved object."""
    change = world.changes[index]
    shift = (change.new.world_from_item - change.old.world_from_item)[:3, 3].norm()
    return float(shift), float(angle_between(change.old.world_from_item, change.new.world_from_item))


def test_small_moves_are_as_small_as_said(worlds):
    assert moved(worlds["nudged"]) == pytest.approx((0.08, 8.0))
    assert moved(worlds["turned"]) == pytest.approx((0.0583, 180.0), rel=1e-3)
    assert moved(worlds["spun"]) == pytest.approx((0.0, 90.0))
    half = worlds["spun"].changes[0].old.solid.half
    assert half[0] > 1.5 * half[1]


def test_thin_things_are_thin(worlds):
    (board,), (pole,) = worlds["thin"].changes, worlds["pole"].changes
    assert min(board.old.solid.half) <= 0.02 and min(pole.old.solid.half) <= 0.025
    for change in (board, pole):
        assert change.old.grid().occupied().shape[0] > 1000  # the true grid still holds it


def test_swapped_boxes_stand_exactly_where_the_other_stood(worlds):
    one, two = worlds["swapped"].changes
    for a, b in ((one, two), (two, one)):
        assert torch.equal(a.new.world_from_item[:2, 3], b.old.world_from_item[:2, 3])


def test_five_objects_have_five_shapes_and_five_ways(worlds):
    changes = worlds["five"].changes
    assert len({(type(c.old.solid), c.old.solid.half) for c in changes}) == 5
    steps = [moved(worlds["five"], i) for i in range(5)]
    assert all(shift > 0.15 for shift, _ in steps) and len({round(angle) for _, angle in steps}) == 5


def test_at_the_edge_some_new_views_show_all_of_it_and_some_nothing(worlds):
    world, camera = worlds["edge"], square_camera(64)
    seen = [int(silhouette(world.after, "box", camera, pose).sum()) for pose in ring(world.target)]
    assert min(seen) == 0 and max(seen) > 100


def test_a_deformed_box_is_told_as_removed_and_added(worlds):
    world = worlds["deformed"]
    old, new = world.changes
    assert old.old.name == new.new.name == "box" and old.new is None and new.old is None
    volumes = [np.prod(item.solid.half) for item in (old.old, new.new)]
    assert volumes[0] == pytest.approx(volumes[1], rel=0.02)
    assert np.array_equal(old.old.texture, new.new.texture)


def test_without_light_nothing_has_changed_but_the_light(worlds):
    world = worlds["lights_off"]
    ratio = world.after.surroundings.mean((0, 1)) / world.before.surroundings.mean((0, 1))
    assert ratio @ [0.2126, 0.7152, 0.0722] == pytest.approx(1 / 8, rel=0.1) and ratio.max() > 1.5 * ratio.min()
    assert world.before.items == world.after.items
    assert not any(m.any() for pose in ring(world.target) for m in masks(world, square_camera(16), pose))


def test_elsewhere_shares_nothing(worlds):
    world = worlds["elsewhere"]
    assert not {i.name for i in world.before.items} & {i.name for i in world.after.items}
    now, then = masks(world, square_camera(32), ring(world.target)[0])
    assert now.float().mean() > 0.6 and then.float().mean() > 0.6


@pytest.mark.parametrize("name", ["mixed", "deformed", "elsewhere"])
def test_the_true_change_can_be_written_for_any_of_them(worlds, name):
    from refield.scene.capture import Capture, Frame

    world, camera = worlds[name], square_camera(16)
    frames = tuple(Frame(None, camera, f"{i}", pose) for i, pose in enumerate(ring(world.target)[:2]))
    change = true_change(world, Capture(frames), frames)
    assert [o.kind for o in change.objects] == HARD[name]


def test_a_mirror_shows_the_box_that_moved():
    """The renderer's steel has no paint of its own: pixels of the cabinet change though it stays."""
    pytest.importorskip("mitsuba", reason="the renderer is an extra: pip install 'refield[synth]'")
    world, camera = WORLDS["mirror"](0), square_camera(32)
    pose = ring(world.target)[5]
    steel = [silhouette(s, "cabinet", camera, pose) for s in (world.before, world.after)]
    old, new = (PathTracer(s).photo(camera, pose, 32, 0) for s in (world.before, world.after))
    changed = (old - new).abs().amax(-1) > 0.12
    assert (changed & steel[0] & steel[1]).sum() > 6
