"""What old photos saw: counted, and where they never looked nothing is a change."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from refield.estimate import detect, recipe
from refield.estimate.detect import DetectConfig
from refield.estimate.look import spread_out, view_of
from refield.estimate.memory import Memory
from refield.estimate.recipe import EstimateConfig, estimate_change
from refield.scene.capture import Capture
from tests.estimate.boxes import BoxWorld, camera_at, photograph, standing

CRATE = standing((0.2, 0.17, 0.18), -0.1, -0.1, 20)
BEHIND = standing((0.1, 0.1, 0.12), -0.75, 0.0, 0)
OLD, NEW = BoxWorld((CRATE,)), BoxWorld((CRATE, BEHIND))
ONE_SIDE = [camera_at(angle, 34) for angle in range(-30, 31, 10)]
AROUND = [camera_at(angle, 34) for angle in range(0, 360, 30)]


def views_of(world, folder, poses):
    return [view_of(OLD, f, 10_000) for f in photograph(world, folder, poses)]


def test_photos_that_saw_a_surface_are_counted(tmp_path):
    frames = photograph(OLD, tmp_path, AROUND)
    memory = Memory.of(OLD, frames)
    (view,) = views_of(OLD, tmp_path / "new", [camera_at(10, 34)])
    times = memory.times_seen(view)
    on_crate = CRATE.inside(torch.nan_to_num(torch.from_numpy(view.surface + 0.02 * view.directions))).numpy()
    floor = np.isfinite(view.depth) & ~on_crate
    # of a convex thing half of the cameras around it see a side; its floor all see but those that it hides it from
    assert 2 <= np.median(times[on_crate]) <= 8 < np.median(times[floor]) <= len(frames)


def test_a_side_that_no_photo_saw_is_not_seen_and_the_same_with_one_more_is(tmp_path):
    behind = camera_at(180, 34)
    (view,) = views_of(OLD, tmp_path / "new", [behind])
    on_crate = CRATE.inside(torch.nan_to_num(torch.from_numpy(view.surface + 0.02 * view.directions))).numpy()
    top = np.abs(view.surface[..., 2] - view.surface[on_crate][:, 2].max()) < 0.02
    side = on_crate & ~top & (view.surface[..., 2] > 0.05)
    assert side.sum() > 50
    for poses, seen in ((ONE_SIDE, False), ([*ONE_SIDE, behind], True)):
        times = Memory.of(OLD, photograph(OLD, tmp_path / f"{seen}", poses)).times_seen(view)
        assert (np.median(times[side]) > 0) == seen
        assert np.median(times[on_crate & top]) >= len(ONE_SIDE) - 1


def test_where_all_photos_show_nothing_nothing_was_seen(tmp_path):
    """A sky is known to be empty; that it is still empty is no news, and what stands in it is."""
    frames = photograph(OLD, tmp_path, AROUND)
    (view,) = views_of(OLD, tmp_path / "new", [camera_at(10, 34)])
    empty = replace(view, depth=np.full(view.shape, np.inf, np.float32))
    usual = Memory.of(OLD, frames)
    sky = replace(usual, depths=np.full_like(usual.depths, np.inf))
    assert np.median(sky.times_seen(empty)) > 0
    thing = replace(view, depth=np.full(view.shape, 1.0, np.float32))
    assert not sky.times_seen(thing).any()


@pytest.mark.parametrize("poses", [ONE_SIDE, AROUND])
def test_what_no_photo_saw_is_new_and_no_change(tmp_path, poses):
    """A crate's back is painted otherwise than the field takes for granted."""
    capture = Capture(tuple(photograph(OLD, tmp_path / "old", poses)), held_out_every=3)
    behind = [camera_at(angle, 30) for angle in (170, 180, 190)]
    views = views_of(OLD, tmp_path / "new", behind)
    memory, config = Memory.of(OLD, capture.train), DetectConfig()
    errors = detect.errors([view_of(OLD, f, 10_000) for f in capture.frames], memory, config)
    for view in views:
        on_crate = CRATE.inside(torch.nan_to_num(torch.from_numpy(view.surface + 0.02 * view.directions))).numpy()
        side = on_crate & (view.surface[..., 2] < 0.14)
        painted = replace(view, photo=np.where(side[..., None], 1 - view.photo, view.photo).astype(np.float32))
        (found,) = detect.changes([painted], errors, config)
        core = side & (memory.times_seen(view) == 0) if poses is ONE_SIDE else side
        assert core.sum() > 50
        assert found.mask[core].mean() < 0.01 if poses is ONE_SIDE else found.mask[core].mean() > 0.7
        assert (found.new[core].mean() > 0.7) == (poses is ONE_SIDE)
        assert (found.witness().depth[found.new] == 0).all()


def test_one_new_photo_is_not_believed_where_few_old_ones_looked(tmp_path):
    few = [camera_at(angle, 34) for angle in (175, 185)]
    old = photograph(OLD, tmp_path / "old", [*ONE_SIDE, *few])
    (view,) = views_of(OLD, tmp_path / "new", [camera_at(180, 30)])
    memory, config = Memory.of(OLD, old), DetectConfig()
    errors = detect.errors([view_of(OLD, f, 10_000) for f in old], memory, config)
    on_crate = CRATE.inside(torch.nan_to_num(torch.from_numpy(view.surface + 0.02 * view.directions))).numpy()
    side = on_crate & (view.surface[..., 2] < 0.14)
    painted = replace(view, photo=np.where(side[..., None], 1 - view.photo, view.photo).astype(np.float32))
    seen = memory.times_seen(view)[side]
    assert np.median(seen) == len(few)
    (alone,) = detect.changes([painted], errors, config)
    both = detect.changes([painted, painted], errors, config)
    assert alone.mask[side].mean() > 0.7 and alone.certain[side][seen < detect.CERTAIN].mean() < 0.05
    assert all(c.guessed is None and (c.certain == c.mask).all() and c.mask[side].mean() > 0.7 for c in both)


def test_an_arrival_in_front_of_what_was_seen_is_found(tmp_path):
    capture = Capture(tuple(photograph(OLD, tmp_path / "old", AROUND)), held_out_every=4)
    photos = photograph(NEW, tmp_path / "new", [camera_at(angle, 34) for angle in (90, 135, 180, 225)])
    change = estimate_change(capture, OLD, photos, EstimateConfig(survey=6))
    assert [o.kind for o in change.objects] == ["added"]


def test_errors_grow_where_fewer_photos_looked_and_never_shrink():
    rng = np.random.default_rng(0)
    of = rng.integers(0, 5, 50_000)
    wrong = rng.exponential(1.0, len(of)) * np.array([8, 4, 6, 1, 1])[of]
    levels = detect._by_coverage(wrong, of, 0.9)
    assert (np.diff(levels) <= 0).all() and levels[0] > 1.2 * levels[1] > 0
    assert levels[-1] == np.quantile(wrong, 0.9)
    few = detect._by_coverage(wrong[:9], np.zeros(9, int), 0.9)
    assert (few == few[-1]).all()


def test_what_left_out_photos_show_is_chance_and_no_threshold(tmp_path):
    """A field that is wrong in photos it did not learn from: as much of a new one is not unusual, and is masked."""
    taught = photograph(OLD, tmp_path / "old", AROUND)
    (beside,) = views_of(OLD, tmp_path / "beside", [camera_at(100, 30)])
    on_crate = CRATE.inside(torch.nan_to_num(torch.from_numpy(beside.surface + 0.02 * beside.directions))).numpy()
    wrong = replace(beside, photo=np.where(on_crate[..., None], 1 - beside.photo, beside.photo).astype(np.float32))
    survey, memory, config = [view_of(OLD, f, 10_000) for f in taught], Memory.of(OLD, taught), DetectConfig()
    alone = detect.errors(survey, memory, config)
    known = detect.errors(survey, memory, config, [wrong] * 3)
    (new,) = detect.changes([wrong], known, config)
    assert new.mask[on_crate].mean() > 0.7
    assert len(known.by_chance) == len(survey) + 3 and known.by_chance[-1] == pytest.approx(float(new.mask.mean()))
    assert len(known.shown) == len(alone.shown)
    assert (known.levels == alone.levels).all() and (known.seeds == alone.seeds).all()
    share = [float(new.mask.mean())]
    assert alone.unusual(share) and not known.unusual(share)


@pytest.mark.parametrize("every", [0, 3])
def test_photos_held_out_of_the_capture_are_asked_what_chance_makes(tmp_path, every):
    """The old photos that are held out, and only they, show a crate of another colour than the field does."""
    other = BoxWorld(tuple(replace(box, paint=box.paint + 1) for box in OLD.boxes))
    frames = photograph(OLD, tmp_path / "old", AROUND)
    wrong = {f.name: f for f in photograph(other, tmp_path / "wrong", AROUND)}
    held = {f.name for f in Capture(tuple(frames), held_out_every=every).held_out}
    capture = Capture(tuple(wrong[f.name] if f.name in held else f for f in frames), held_out_every=every)
    photos = photograph(other, tmp_path / "new", [camera_at(100, 30)])
    config = EstimateConfig(survey=2)
    errors = recipe._detected(capture, OLD, photos, config, config.models.open()).errors
    chosen = {f.name for f in spread_out(capture.frames, 2)}
    more = [f for f in spread_out(capture.held_out, 2) if f.name not in chosen]
    assert len(errors.shown) == 2 and len(errors.by_chance) == 2 + len(more)
    assert (len(more) > 0) == (every > 0) and all(share > 0.01 for share in errors.by_chance[2:])


def test_as_much_as_chance_makes_is_not_unusual():
    """Of 400 times that nothing changed hardly any is said to be unusual; ten times as much nearly always is."""
    rng = np.random.default_rng(0)
    nobody = np.zeros(0)
    counts = []
    for factor in (1, 10):
        told = 0
        for _ in range(400):
            known = detect.Errors((), None, nobody, nobody, tuple(rng.exponential(0.01, 6)))
            told += known.unusual(factor * rng.exponential(0.01, 4))
        counts.append(told)
    assert counts[0] <= 12 and counts[1] >= 300
    assert detect.Errors((), None, nobody, nobody).unusual([0.001])
