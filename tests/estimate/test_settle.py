"""What became of everything that changed, by which hypothesis explains the photos best."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from refield.estimate import recipe, settle
from refield.estimate.lattice import Body, grown
from refield.estimate.likelihood import Settled, judged, pixels_of
from refield.scene.pose import angle_between, transform
from tests.estimate.boxes import BoxWorld, capture_of, new_photos, standing, turn

CRATE = standing((0.2, 0.17, 0.18), -0.2, -0.15, 20, paint=3)
CENTRE = CRATE.world_from_box[:3, 3]
BEFORE = BoxWorld((CRATE,))
AWAY = turn(CENTRE, 70, (0.4, 0.25, 0))
CONFIG = recipe.EstimateConfig(survey=6)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return capture_of(BEFORE, tmp_path_factory.mktemp("before"))


def settled(capture, folder, monkeypatch):
    """What an estimate settles on, with everything that it was settled from."""
    kept = []

    class Seen(settle.Search):
        def settle(self, olds, begun=None) -> Settled:
            kept.append((self.ground, olds, self.changed, super().settle(olds, begun)))
            return kept[-1][-1]

    monkeypatch.setattr(recipe, "Search", Seen)
    change = recipe.estimate_change(capture, BEFORE, new_photos(BoxWorld((CRATE.moved(AWAY),)), folder), CONFIG)
    return change, kept[-1]


def test_the_truth_leaves_less_unexplained_than_any_other_hypothesis(capture, tmp_path, monkeypatch):
    _, (ground, _olds, changed, found) = settled(capture, tmp_path, monkeypatch)
    ((k, change),) = found.moved.items()
    old = found.olds[k]

    def put(new_from_old) -> Settled:
        placed = [(old, replace(change, new_from_old=new_from_old))]
        views = settle.without(ground, changed, [old], placed)
        return replace(found, moved={k: placed[0][1]}, views=tuple(views))

    def came() -> Settled:
        lattice = ground.hull.lattice
        back = transform(torch.linalg.inv(AWAY), torch.from_numpy(lattice.centres).double()).numpy()
        there = old.lattice.holds(grown(old.voxels, 1), back.astype(np.float32))
        views = tuple(settle.without(ground, changed, [old]))
        return replace(found, moved={}, removed={k: 1.0}, arrived=(Body(lattice, there),), views=views)

    def left_by(hypothesis: Settled) -> float:
        return judged(ground, hypothesis)[1]

    least = left_by(found)
    pixels = int(sum(p.changed.mask.sum() for p in found.views) + sum(p.covered.sum() for p in found.views))
    turned = turn(transform(AWAY, CENTRE), 25, (0, 0, 0)) @ AWAY
    nothing = replace(found, moved={}, views=tuple(settle.without(ground, changed, [])))
    gone = replace(found, moved={}, removed={k: 1.0}, views=came().views)
    for other in (put(turned), put(turn(CENTRE, 0, (0.05, 0, 0)) @ AWAY), came(), gone, nothing):
        assert left_by(other) > least + 0.05 * pixels
    assert left_by(came()) < left_by(gone) < left_by(nothing)
    # what it leads by is told of it: the best other answer is close to that it left and another came
    led = found.led[k] * pixels_of(ground, found, k)
    assert 0.5 * led < left_by(came()) - least < 1.5 * led


def test_the_lead_of_an_object_that_no_other_answer_was_tried_for_is_endless(capture, tmp_path, monkeypatch):
    _, (ground, olds, changed, found) = settled(capture, tmp_path, monkeypatch)
    search = settle.Search(ground, changed)
    (k,) = found.moved
    monkeypatch.setattr(settle.Search, "_exchanges", lambda self, best: [])
    assert search.settle(olds).led == {k: math.inf} and 0.13 < found.led[k] < math.inf


def test_a_newcomer_that_explains_nothing_is_taken_back(capture, tmp_path, monkeypatch):
    """What the photos show as it was is dear to call new; what they show of a newcomer is cheap."""
    _, (ground, _olds, _changed, found) = settled(capture, tmp_path, monkeypatch)
    lattice = ground.hull.lattice
    low, high = lattice.centres.reshape(-1, 3).min(0), lattice.centres.reshape(-1, 3).max(0)
    corner = (lattice.centres < low + 0.15 * (high - low)).all(-1)
    bare = replace(found, moved={}, removed={})
    kept, left = judged(ground, replace(bare, arrived=(Body(lattice, corner),)))
    assert kept.arrived == () and left == judged(ground, bare)[1]


def test_settling_more_keeps_what_was_settled(capture, tmp_path, monkeypatch):
    _, (ground, olds, changed, found) = settled(capture, tmp_path, monkeypatch)
    search = settle.Search(ground, changed)
    begun = search.settle(olds)
    again = search.settle([], begun)
    assert set(again.moved) == set(begun.moved) == set(found.moved)
    assert len(again.olds) == len(begun.olds) and len(set(again.touched)) == len(again.touched)


def test_what_slid_by_less_than_its_width_is_found_where_it_hid(tmp_path, monkeypatch):
    """Of a crate of one colour only the rim seems to change; it is found as a whole, or not at all."""
    plain, motion = replace(CRATE, paint=-1), turn(CENTRE, 3, (0.1, 0, 0))
    world, after = BoxWorld((plain,)), BoxWorld((plain.moved(motion),))
    capture, frames = capture_of(world, tmp_path / "before"), new_photos(after, tmp_path / "after")
    change = recipe.estimate_change(capture, world, frames, CONFIG)
    assert [o.kind for o in change.objects] == ["moved"] and not change.unexplained
    found = change.objects[0].new_from_old
    assert float(angle_between(found, motion)) < 1.5
    assert float((transform(found, CENTRE) - transform(motion, CENTRE)).norm()) < 0.01
    monkeypatch.setattr(settle, "slid", lambda *_: None)
    without = recipe.estimate_change(capture, world, frames, CONFIG)
    assert [o.kind for o in without.objects] != ["moved"]


@pytest.mark.parametrize("known", [False, True])
def test_an_object_that_explains_nothing_is_taken_back(capture, tmp_path, monkeypatch, known):
    """A pose that was believed at first, of a thing that is elsewhere: where it was found before, if anywhere."""
    place_all = settle.place_all

    def astray(ground, olds, changed, before, kept):
        moved, placed = place_all(ground, olds, changed, before, kept)
        ((k, change),) = moved.items()
        if not known:
            kept[1].clear()
        wrong = turn(transform(AWAY, CENTRE), 180, (-0.3, 0.1, 0)) @ AWAY
        return {k: replace(change, new_from_old=wrong)}, placed

    monkeypatch.setattr(settle, "place_all", astray)
    monkeypatch.setattr(settle, "slid", lambda *_: None)
    change, _ = settled(capture, tmp_path, monkeypatch)
    assert sorted(o.kind for o in change.objects) == (["moved"] if known else ["added", "removed"])
    assert not known or float(angle_between(change.objects[0].new_from_old, AWAY)) < 1.5
