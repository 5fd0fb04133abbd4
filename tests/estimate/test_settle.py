"""What became of everything that changed, by which hypothesis explains the photos best."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from refield.estimate import arrive, fit, recipe, rotations, settle
from refield.estimate.faces import Part
from refield.estimate.lattice import Body, Lattice, grown, some_of
from refield.estimate.layers import Sight
from refield.estimate.likelihood import Settled, judged, pixels_at, pixels_of, shown_or_was
from refield.estimate.models import Models
from refield.estimate.outline import as_one, restricted
from refield.estimate.tally import Tally
from refield.scene.pose import angle_between, transform
from refield.scene.srgb import to_linear, to_srgb
from refield.vision import pixels
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


@pytest.fixture(scope="module")
def estimated(capture, tmp_path_factory):
    """What an estimate settles on and from what, made once for all that ask of it."""
    with pytest.MonkeyPatch.context() as patched:
        return settled(capture, tmp_path_factory.mktemp("after"), patched)[1]


def came_to(ground, olds, changed):
    """The photos without the old objects, and the largest of what arrived in them."""
    views = tuple(settle.without(ground, changed, list(olds)))
    return views, max(settle.newcomers(ground, views, list(olds)), key=lambda body: body.voxels.sum())


def test_the_truth_leaves_less_unexplained_than_any_other_hypothesis(estimated):
    ground, _olds, changed, found = estimated
    ((k, change),) = found.moved.items()
    old = found.olds[k]

    def put(new_from_old) -> Settled:
        placed = [(old, replace(change, new_from_old=new_from_old))]
        views = settle.without(ground, changed, [old], placed)
        return replace(found, moved={k: placed[0][1]}, views=tuple(views))

    def came() -> Settled:
        there = transform(AWAY, torch.from_numpy(old.lattice.centres[old.voxels]).double()).numpy()
        lattice = Lattice.over(there.min(0), there.max(0), 60)
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


def test_the_lead_of_an_object_that_no_other_answer_was_tried_for_is_endless(estimated, monkeypatch):
    ground, olds, changed, found = estimated
    search = settle.Search(ground, changed)
    (k,) = found.moved
    monkeypatch.setattr(settle.Search, "_exchanges", lambda self, best: [])
    assert search.settle(olds).led == {k: math.inf} and 0.13 < found.led[k] < math.inf


def test_a_newcomer_that_explains_nothing_is_taken_back(estimated):
    """What the photos show as it was is dear to call new; what they show of a newcomer is cheap."""
    ground, _olds, _changed, found = estimated
    lattice = max((h.lattice for h in ground.hulls), key=lambda one: one.centres.size)
    low, high = lattice.centres.reshape(-1, 3).min(0), lattice.centres.reshape(-1, 3).max(0)
    corner = (lattice.centres < low + 0.15 * (high - low)).all(-1)
    bare = replace(found, moved={}, removed={})
    kept, left = judged(ground, replace(bare, arrived=(Body(lattice, corner),)))
    assert kept.arrived == () and left == judged(ground, bare)[1]


def test_a_newcomer_that_gains_less_than_the_smallest_thing_would_is_none(estimated):
    """What is told of is large enough to be seen in each photo; specks of a poor field gain a little as well."""
    ground, olds, changed, found = estimated
    views, whole = came_to(ground, olds, changed)
    middle = np.linalg.norm(whole.places - whole.places.mean(0), axis=-1) < 1.5 * whole.lattice.cell
    speck = replace(whole, voxels=some_of(whole.voxels, middle))
    bare = replace(found, moved={}, removed={k: 1.0 for k in found.moved}, views=views)
    nothing, less = judged(ground, bare)[1], judged(ground, replace(bare, arrived=(whole,)))
    assert less[1] < nothing and less[0].arrived == (whole,)
    assert judged(ground, replace(bare, arrived=(speck,))) == judged(ground, bare)


def test_two_that_went_the_same_way_are_one(estimated):
    """An outline may be cut where nothing is: what moved along is of the thing."""
    ground, _, changed, found = estimated
    ground = replace(ground, believe=replace(ground.believe, smallest=0.01))  # to be outlined anew costs less
    (k,) = found.moved
    old, change = found.olds[k], found.moved[k]
    left = old.lattice.centres[..., 0] < old.centre[0]
    halves = [restricted(old, old.voxels & side, ground.shape) for side in (left, ~left)]
    apart = settle._completed(ground, dict(enumerate(halves)), [0, 1], changed, {0: change, 1: change})
    assert len(apart.moved) == 2
    search = settle.Search(ground, changed)
    (joined,) = search._joined(apart, 0)
    ((_, whole),) = [(j, joined.olds[j]) for j in joined.moved]
    assert all(half.within(whole) for half in halves)
    assert judged(ground, joined)[1] < judged(ground, apart)[1]
    away = replace(halves[1], lattice=replace(old.lattice, low=old.lattice.low + 2))  # they do not touch
    assert as_one(BEFORE, ground.photographed, (halves[0], away), ground.planes, ground.shape) is None
    elsewhere = replace(change, new_from_old=AWAY @ change.new_from_old)
    assert list(search._joined(replace(apart, moved={0: change, 1: elsewhere}), 0)) == []


def test_what_was_asked_of_an_object_that_moved_is_not_asked_once_it_has_not(estimated):
    """Exchanges are listed for one hypothesis, and go on with a better one as soon as there is any."""
    ground, _, changed, found = estimated
    search = settle.Search(ground, changed)
    ((k, change),) = found.moved.items()
    for one in (found.olds[k], replace(found.olds[k])):
        search.fits[k].append(fit.Fit(0.0, one, change))
    exchanges = search._exchanges(replace(found, moved={k: change, k + 1: change}, olds=(*found.olds, found.olds[k])))
    assert {kind for (kind, j, _), _ in exchanges if j == k} >= {"turned", "joined", "stayed", "outlined", "elsewhere"}
    left = replace(found, moved={}, removed={}, touched=())
    for (kind, j, _), tries in exchanges:
        if j == k and kind != "elsewhere":
            assert list(tries(left)) == []


def test_a_hypothesis_is_made_once_and_told_from_those_that_differ_in_anything(estimated, monkeypatch):
    ground, (old,), changed, found = estimated
    ((_, change),) = found.moved.items()
    made = []
    monkeypatch.setattr(settle, "_completed", lambda *asked: made.append(asked) or Settled())
    search, other = settle.Search(ground, changed), replace(old)
    both, moved = {0: old, 1: other}, {0: change}
    asked = [({0: old}, [0], {}), (both, [0], {}), (both, [1], {}), (both, [0, 1], {}), (both, [1, 0], {})]
    asked += [(both, [0, 1], moved), (both, [0, 1], {0: replace(change)}), (both, [0, 1], {1: change})]
    answers = [search._hypothesis(*one) for one in asked]
    assert len(made) == len(asked)
    assert all(search._hypothesis(*one) is answer for one, answer in zip(asked, answers)) and len(made) == len(asked)


def test_what_only_darkens_all_that_is_behind_it_is_no_newcomer(estimated):
    """However high the space reaches in which no photo contradicts it."""
    ground, olds, changed, _ = estimated
    views, body = came_to(ground, olds, changed)
    shaded = []
    for p in views:
        here = pixels.dilate(arrive.shadow_of(p.view, body), 6)
        dark = np.where(here[..., None], to_srgb(0.5 * to_linear(p.rgb)), p.view.photo).astype(np.float32)
        shaded.append(replace(p, changed=replace(p.changed, view=replace(p.view, photo=dark))))
    assert settle.newcomers(ground, shaded, list(olds)) == []


@pytest.mark.parametrize("everywhere", [True, False])
def test_dappled_light_is_what_every_photo_shows_on_the_same_surface(everywhere, estimated):
    """However uneven it is; what each photo shows elsewhere stands before the surface."""
    ground, olds, changed, _ = estimated
    views, body = came_to(ground, olds, changed)
    photos = []
    for k, p in enumerate(views):
        here = pixels.dilate(arrive.shadow_of(p.view, body), 6)
        at = np.where(here[..., None], replace(p.view, depth=p.depth).surface, 0)
        at = np.where(np.isfinite(at), at, 0) + (np.zeros(3) if everywhere else np.array([0.1 * k, 0, 0]))
        dapples = 0.55 + 0.4 * np.sin(25 * at[..., 0]) * np.sin(25 * at[..., 1])
        dark = to_srgb(to_linear(p.rgb) * dapples[..., None])
        photo = np.where(here[..., None], dark, p.view.photo).astype(np.float32)
        photos.append(replace(p, changed=replace(p.changed, view=replace(p.view, photo=photo))))
    assert bool(settle.newcomers(ground, photos, list(olds))) != everywhere


def test_what_moved_by_less_than_can_be_seen_hides_no_newcomer(estimated, monkeypatch):
    """It stayed, so what is behind it is asked for; else all that is there would be excused by not knowing it."""
    ground, olds, changed, found = estimated
    ((k, change),) = found.moved.items()
    barely = replace(change, new_from_old=turn(CENTRE, 0, (0.1 * change.pixel, 0, 0)))
    monkeypatch.setattr(settle, "place_all", lambda _g, olds, *_: ({k: barely}, dict(olds[1])))
    once = settle.Search(ground, changed)._placed(olds, Settled())
    assert once.moved == {} and once.touched == () and not any(p.was.any() for p in once.views)


@pytest.mark.parametrize("without", ["places_among", "rotated_at"])
def test_what_was_missed_at_first_is_found_among_what_arrived(estimated, monkeypatch, without):
    """Told as one that left and one that arrived, an object is looked for again where that is: as its surface's colours
    fit, or rotated in every way."""
    ground, olds, changed, _ = estimated
    monkeypatch.setattr(settle, "place_all", lambda _g, olds, *_: ({}, dict(olds[1])))
    with monkeypatch.context() as neither:
        for name in ("places_among", "rotated_at"):
            neither.setattr(settle, name, lambda *_: [])
        missed = settle.Search(ground, changed).settle(olds)
    assert missed.removed and missed.arrived and not missed.moved
    monkeypatch.setattr(settle, without, lambda *_: [])
    found = settle.Search(ground, changed).settle(olds)
    ((_, change),) = found.moved.items()
    assert float(angle_between(change.new_from_old, AWAY)) < 1.5 and not found.removed and not found.arrived


def test_a_small_thing_among_much_that_changed_is_carved_finely(capture, tmp_path):
    """On a lattice that holds all that is beside it as well it has too few voxels to be told from a speck."""
    tin = standing((0.09, 0.08, 0.1), 0.5, 0.45, 10, paint=8)
    frames = new_photos(BoxWorld((CRATE.moved(AWAY), tin)), tmp_path)
    coarse = replace(CONFIG, hull=replace(CONFIG.hull, longest=32))
    change = recipe.estimate_change(capture, BEFORE, frames, coarse)
    assert sorted(o.kind for o in change.objects) == ["added", "moved"]
    (added,) = (o for o in change.objects if o.kind == "added")
    places = added.grid.nodes().reshape(-1, 3)
    held, true = added.grid.contains(places), tin.inside(places)
    assert float((held & true).sum() / (held | true).sum()) > 0.5


def test_a_newcomer_is_asked_for_only_where_nothing_hides_it(estimated):
    """Of one that stands behind something else in every photo, only the rest is shown."""
    ground, olds, changed, _ = estimated
    views, whole = came_to(ground, olds, changed)
    hidden = []
    for p in views:
        columns = np.flatnonzero(arrive.shadow_of(p.view, whole).any(0))
        before = np.zeros(p.view.shape, bool)
        before[:, columns[: round(0.7 * len(columns))]] = True
        less = replace(p.changed, mask=p.changed.mask & ~before)
        hidden.append(replace(p, changed=less, depth=np.where(before, 0.1, p.depth).astype(np.float32)))
    rest = max(settle.newcomers(ground, hidden, list(olds)), key=lambda body: body.voxels.sum())
    assert settle.fresh(hidden, rest) > 0.8 and whole.lattice.holds(grown(whole.voxels, 1), rest.places).mean() > 0.9


def test_a_newcomer_is_judged_by_what_the_photos_show_of_it(estimated, monkeypatch):
    """It is carved with a margin: of a small one, that is more than its own pixels."""
    ground, olds, changed, _ = estimated
    monkeypatch.setattr(settle, "place_all", lambda _g, olds, *_: ({}, dict(olds[1])))
    (body,) = settle.Search(ground, changed)._placed(olds, Settled()).arrived
    views = settle.without(ground, changed, list(olds))
    shown = [(arrive.shadow_of(p.view, body), p.changed.mask) for p in views]
    assert all((here & ~mask).sum() <= 0.1 * here.sum() for here, mask in shown if here.any())


def test_places_that_are_likely_at_first_are_each_refined_to_the_end(estimated, monkeypatch):
    """What looks much alike when it is turned is told apart by what is fine; one place counts once."""
    ground, (old,), changed, _ = estimated
    views, middle = settle.without(ground, changed, [old]), transform(AWAY, CENTRE)
    near = [turn(middle, degrees, (0.004, 0, 0)) @ AWAY for degrees in (2, -2, 1)]
    sight = Sight(ground.field, old, views, [old])
    poses = [turn(middle, 180, (0, 0, 0)) @ AWAY, *near]
    assert len(fit.finest(ground, sight, poses)) == 1  # the other is too far behind to become the better one
    monkeypatch.setattr(fit, "SHIFTS", 0.5)
    places = fit.finest(ground, sight, poses)
    turned = [float(angle_between(change.new_from_old, AWAY)) for _, change in places]
    assert len(turned) == 2 and turned[0] < 1.5 and turned[1] > 90


def test_poses_that_the_photos_cannot_tell_apart_are_all_told(tmp_path):
    """A crate of one colour looks the same when it is turned halfway round: that is no doubt about where it is."""
    plain = replace(CRATE, paint=-1)
    capture = capture_of(BoxWorld((plain,)), tmp_path / "before")
    photos = new_photos(BoxWorld((plain.moved(AWAY),)), tmp_path / "after")
    change = recipe.estimate_change(capture, BoxWorld((plain,)), photos, CONFIG)
    (moved,) = change.objects
    assert moved.new_from_old is not None and moved.confidence > 0.8
    poses = sorted([moved.new_from_old, *moved.alternatives], key=lambda pose: float(angle_between(pose, AWAY)))
    assert [float(angle_between(pose, AWAY)) for pose in poses] == pytest.approx([0, 180], abs=1.5)
    assert all(float((transform(pose, CENTRE) - transform(AWAY, CENTRE)).norm()) < 0.02 for pose in poses)
    assert "would look the same" in change.why


@pytest.mark.parametrize("shown", [True, False])
def test_what_is_explained_less_than_it_is_shown_is_turned_right(shown, estimated, monkeypatch):
    """Found at its place and turned wrongly: unless old photos show no more of it, all rotations are asked."""
    ground, (old,), changed, found = estimated
    (k,) = found.moved
    wrongly = turn(transform(AWAY, CENTRE), 100, (0.01, 0, 0)) @ AWAY
    search = settle.Search(ground, changed)
    search.first[k] = old
    at = settle.refine(Sight(ground.field, old, settle.without(ground, changed, [old]), [old]), wrongly, ground.fine)
    begun = replace(judged(ground, search._with(found, k, old, at))[0], led={k: 0.5})
    if not shown:
        monkeypatch.setattr(rotations, "shown_right", lambda *_: at.explained)
    told = search.turned(begun)
    assert at.explained < 0.8 and float(angle_between(begun.moved[k].new_from_old, AWAY)) > 45
    assert (float(angle_between(told.moved[k].new_from_old, AWAY)) < 2) is shown
    assert (told is begun) is not shown and told.led == {k: 0.5}


def test_a_rotation_is_taken_only_for_more_than_it_leaves_unexplained(estimated, monkeypatch):
    ground, (old,), changed, found = estimated
    ((k, change),) = found.moved.items()
    asked = pixels_at(ground, found, k)
    best = replace(change, explained=1.0)
    for explained, more, taken in [(0.5, 0.4, True), (0.5, 0.6, False), (0.99, -1.0, False)]:
        least = {True: 100.0, False: 100.0 + more * asked}
        begun = replace(found, moved={k: replace(change, explained=0.2)})  # otherwise refined, not compared
        monkeypatch.setattr(settle, "judged", lambda _, one, b=begun, left=least: (one, left[one is b]))
        now = (old, replace(change, explained=explained))
        told = settle.Search(ground, changed)._turned_to(begun, k, [now, (old, best)])
        assert (told is not begun) is taken
    assert settle.Search(ground, changed)._turned_to(begun, k, []) is begun


def test_rotations_that_explain_as_much_as_the_best_are_told_with_it(estimated, monkeypatch):
    ground, (old,), changed, found = estimated
    ((k, change),) = found.moved.items()
    middle = transform(AWAY, CENTRE)
    poses = [turn(middle, degrees, (0, 0, 0)) @ AWAY for degrees in (0, 0.01, 120, 60, 90)]
    told = [(old, replace(change, new_from_old=p, explained=e)) for p, e in zip(poses, (0.9, 0.895, 0.89, 0.8, 0.5))]
    monkeypatch.setattr(settle, "judged", lambda _, one: (one, 100.0))
    turned = settle.Search(ground, changed)._turned_to(found, k, [told[-1], *told])
    (twin,) = turned.twins[k]
    assert torch.equal(twin.new_from_old, poses[2]) and torch.equal(turned.moved[k].new_from_old, poses[0])


def test_a_rotation_that_makes_something_else_of_the_others_is_not_taken(estimated, monkeypatch):
    ground, (old,), changed, found = estimated
    ((k, change),) = found.moved.items()
    monkeypatch.setattr(settle, "judged", lambda _, one: (replace(one, removed={k + 1: 1.0}), 0.0))
    poses = [(old, replace(change, explained=e)) for e in (0.5, 1.0)]
    assert settle.Search(ground, changed)._turned_to(found, k, poses) is found


def test_an_estimate_tells_an_object_as_it_was_turned(capture, tmp_path, monkeypatch):
    def turned(self, told):
        ((k, change),) = told.moved.items()
        return replace(told, moved={k: replace(change, note="turned")})

    monkeypatch.setattr(recipe.Search, "turned", turned)
    change, _ = settled(capture, tmp_path, monkeypatch)
    assert change.objects[0].note.endswith("turned")


def test_an_object_is_put_where_its_thickest_part_fits_among_much_that_arrived(estimated):
    ground, (old,), changed, _ = estimated
    views, body = came_to(ground, [old], changed)
    small = replace(old, voxels=old.voxels & (old.lattice.centres[..., 2] < 0.08))
    (target,) = fit.targets_of(views, body, small)
    assert len(target.places) > 1 and np.allclose(target.anchor, small.thickest[0])
    assert small.lattice.holds(small.voxels, small.thickest[0][None]).all()
    assert any((wanted > 0).any() for wanted in target.wanted)


def test_what_turned_where_it_stands_is_asked_for_though_it_does_not_look_gone(
    estimated, capture, tmp_path, monkeypatch
):
    """It looks like what a newcomer hides; the likelihood says what became of it."""
    ground, (old,), _, _ = estimated
    frames = new_photos(BoxWorld((CRATE.moved(turn(CENTRE, 45, (0, 0, 0))),)), tmp_path)
    scene = recipe._detected(capture, BEFORE, frames, CONFIG, Models())
    assert fit.left_by(ground, settle.without(ground, scene.changed, [old]), old) is None
    monkeypatch.setattr(recipe, "_were_there", lambda *_: [old])
    body = Body(old.lattice, old.voxels)
    others = [Part(SimpleNamespace(lattice=body.lattice), body.voxels, body.voxels)]
    nothing = Settled(views=tuple(ground.past(scene.changed, [])))
    assert recipe._overlooked(scene, ground, nothing, others, []) == [old]
    explained = replace(nothing, views=tuple(replace(p, rgb=p.view.photo) for p in nothing.views))
    assert recipe._overlooked(scene, ground, explained, others, []) == []
    monkeypatch.setattr(recipe, "_known_at", lambda *_: "an earlier visit's")
    assert recipe._overlooked(scene, ground, explained, others, []) == []
    known = replace(old, remembered=True)
    monkeypatch.setattr(recipe, "_were_there", lambda *_: [known])
    assert recipe._overlooked(scene, ground, explained, others, []) == [known]


def test_what_much_is_left_of_may_have_slid_though_nothing_arrived(estimated):
    ground, (old,), changed, _ = estimated
    search, beside = settle.Search(ground, changed), replace(old)
    told = Settled({}, {1: 1.0}, (), tuple(ground.past(changed, [])), (old, beside))
    assert {k for k, _ in search._asked(told)} == {0}
    explained = tuple(replace(p, rgb=p.view.photo) for p in told.views)
    assert search._asked(replace(told, views=explained)) == []


def test_all_that_went_along_with_a_half_is_told_though_the_other_seems_to_have_left(estimated):
    ground, (old,), changed, found = estimated
    left = (old.lattice.centres - old.centre)[..., 0] < 0
    half, other = (restricted(old, old.voxels & side, ground.shape) for side in (left, ~left))
    apart = Settled(found.moved, {1: 0.9}, (), found.views, (half, other), (0, 1))
    (whole,) = settle.Search(ground, changed)._with_along(apart, 0, half, found.moved[0])
    assert set(whole.moved) == {0} and not whole.removed and not whole.arrived
    remembered = replace(apart, olds=(half, replace(other, remembered=True)))
    for one in settle.Search(ground, changed)._with_along(remembered, 0, half, found.moved[0]):
        assert not other.within(one.olds[0])  # known to be a thing of its own
    assert other.within(whole.olds[0]) and whole.olds[0].volume == pytest.approx(old.volume, rel=0.2)
    assert judged(ground, whole)[1] == pytest.approx(judged(ground, found)[1], rel=0.1)


def test_what_slid_or_was_outlined_anew_is_asked_what_went_along(estimated, monkeypatch):
    ground, (old,), changed, found = estimated
    half = restricted(old, old.voxels & ((old.lattice.centres - old.centre)[..., 0] < 0), ground.shape)
    search = settle.Search(ground, changed, anew={id(half): half})
    told = replace(found, olds=(half,))
    assert any(old.within(one.olds[0]) for one in search._outlines(told, 0))
    monkeypatch.setattr(settle, "slid", lambda *_: fit.Fit(0.0, half, found.moved[0]))
    alone, whole = search._slides(replace(told, moved={}, touched=()), 0, half)
    assert alone.olds[0] is half and old.within(whole.olds[0]) and set(whole.moved) == {0}


def test_settling_more_keeps_what_was_settled(estimated):
    ground, olds, changed, found = estimated
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


def test_things_that_touch_and_turned_each_where_it_stands_are_cut_apart(tmp_path):
    """They are outlined as one, and by one of them alone less is explained than a newcomer would explain."""
    things = standing((0.2, 0.17, 0.18), -0.2, -0.15, 0, paint=3), standing((0.12, 0.14, 0.3), 0.12, -0.15, 0, paint=7)
    turns = [turn(b.world_from_box[:3, 3], angle, (0, 0, 0)) for b, angle in zip(things, (28, -35))]
    before, after = BoxWorld(things), BoxWorld(tuple(b.moved(t) for b, t in zip(things, turns)))
    capture, frames = capture_of(before, tmp_path / "before"), new_photos(after, tmp_path / "after")
    change = recipe.estimate_change(capture, before, frames, CONFIG)
    assert [o.kind for o in change.objects] == ["moved", "moved"]
    for true in turns:
        assert min(float(angle_between(o.new_from_old, true)) for o in change.objects) < 1.5


def test_pieces_are_those_of_the_hypothesis_that_they_are_asked_beside(estimated, monkeypatch):
    """Exchanges are listed once, and a better hypothesis may be taken before it is their turn."""
    ground, _, changed, found = estimated
    search, asked = settle.Search(ground, changed), []
    monkeypatch.setattr(settle.Search, "_pieces", lambda self, best: asked.append(best) or [found.olds[0]])
    exchanges = dict(search._exchanges(found))
    better = replace(found)
    assert list(exchanges["parted", 0, 0](better)) == [] and asked == [found, better] and asked[1] is better
    assert ("cut", 0, id(found.olds[0])) in exchanges


def test_a_thing_more_is_told_only_for_as_much_as_a_pose_must_gain(estimated):
    ground, _, changed, found = estimated
    search, (k,), gains = settle.Search(ground, changed), found.moved, ground.believe.gains
    change = replace(found.moved[k], before=0.3)
    more = replace(found, olds=(*found.olds, found.olds[k]), moved={**found.moved, 1: change})
    least = gains * pixels_of(ground, more, 1)
    assert search._worth(found, more) == pytest.approx(least) and least > 100
    alike = replace(more, moved={**found.moved, 1: replace(change, before=0.6)})
    assert search._worth(found, alike) == pytest.approx(2 * least)
    left = replace(more, moved=found.moved, removed={1: 0.9})
    assert search._worth(found, left) == pytest.approx(gains * pixels_of(ground, left, 1))
    assert search._worth(found, left) < search._worth(found, more)
    assert search._worth(more, found) == search._worth(more, left) == search._worth(found, found) == 0
    instead = replace(more, moved={1: change})
    assert search._worth(found, instead) == 0 < search._worth(found, instead, piece=True)
    nothing = settle.Settled(views=found.views, olds=more.olds)
    assert search._worth(nothing, more) == 0 < search._worth(nothing, left, piece=True) < 2 * least
    assert search._worth(nothing, replace(alike, moved={1: alike.moved[1]}), piece=True) == pytest.approx(least)


def with_left(settled: Settled, much: float) -> Settled:
    """The hypothesis as if it left so much of each pixel unexplained."""
    return replace(settled, left=tuple(np.full_like(left, much) for left in settled.left))


def test_what_a_thing_gains_must_be_gained_where_it_is_or_was(estimated):
    """That what arrived is outlined better beside it says nothing of it."""
    ground, _, changed, told = estimated
    search, (k,) = settle.Search(ground, changed), told.moved
    wrong, cost = with_left(told, 1), 10_000.0
    change = replace(told.moved[k], before=0.3)
    more = replace(wrong, olds=(*told.olds, told.olds[k]), moved={**told.moved, 1: change})
    here = shown_or_was(ground, more, 1)
    least, pixels = search._gain(more, 1, beside=True), sum(int(h.sum()) for h in here)

    def compared(there: float, elsewhere: float) -> float:
        left = tuple(np.where(h, 1 - there / pixels, 1.0) for h in here)
        return search._compared(wrong, cost, replace(more, left=left), cost - there - elsewhere)

    assert compared(1.5 * least, 0) == pytest.approx(cost - 0.5 * least)
    assert compared(0.5 * least, 2 * least) == pytest.approx(cost + 0.5 * least)
    assert compared(0, 2 * least) == pytest.approx(cost + least)
    assert compared(1.5 * least, -least) == pytest.approx(cost + 0.5 * least)  # and it costs more elsewhere
    assert search._compared(wrong, cost, replace(more, left=wrong.left), cost + 1) == cost + 1


def test_what_a_part_gains_by_its_pose_speaks_for_what_is_left_of_its_outline(estimated):
    """The whole was told as left; a part of it moved, and the rest of it left: nothing is gained where that was."""
    ground, _, changed, told = estimated
    search, (k,) = settle.Search(ground, changed), told.moved
    gone = replace(with_left(told, 1), moved={}, removed={k: 1.0})
    there = [now & ~was for now, was in zip(shown_or_was(ground, told, k), shown_or_was(ground, gone, k))]
    apart = replace(told, olds=(*told.olds, told.olds[k]), removed={1: 0.9})
    apart = replace(apart, left=tuple(np.where(h, 0.0, 1.0) for h in there))
    gained = sum(int(h.sum()) for h in there)
    assert gained > search._worth(gone, apart) > 0
    assert search._compared(gone, 1e4, apart, 1e4 - gained) == pytest.approx(1e4 - gained + search._worth(gone, apart))


def test_what_left_or_arrived_beside_others_is_told_only_if_it_is_likelier_than_not(estimated):
    ground, olds, changed, found = estimated
    (k,) = found.moved
    _, body = came_to(ground, olds, changed)
    search = settle.Search(ground, changed)
    other = len(found.olds)
    two = replace(found, olds=(*found.olds, found.olds[k]), touched=(*found.touched, other), removed={other: 0.9})
    for led, told in ((0.4, []), (0.6, [other])):
        likely = search.likely(replace(two, led={k: 0.5, other: led}))
        assert list(likely.removed) == told and list(likely.moved) == [k] and likely.led[k] == 0.5
        # beside one that left as likely as not, or alone, with nothing else told
        likely = search.likely(replace(two, moved={}, removed={k: 0.9, other: 0.9}, led={k: 0.6, other: led}))
        assert list(likely.removed) == [k, *told]
        alone = replace(two, moved={}, led={other: led})
        assert search.likely(alone).removed == alone.removed
    for came, told in ((0.8, 0), (0.9, 1)):
        assert len(search.likely(replace(found, arrived=(body,), came=(came,))).arrived) == told
        assert len(search.likely(replace(found, moved={}, arrived=(body,), came=(came,))).arrived) == 1
        # one of two halves of a move may be as unlikely as it is
        both = replace(two, led={k: 0.5, other: 0.1}, arrived=(body,), came=(came,))
        assert search.likely(both) is both


def test_what_was_settled_stays_unless_things_more_explain_enough(estimated, monkeypatch):
    ground, _, changed, told = estimated
    k, found = len(told.olds), with_left(told, 1)
    more = replace(with_left(told, 0), olds=(*found.olds, *found.olds), removed={k: 0.9})
    least = settle.Search(ground, changed)._worth(found, more)
    for gained, told in ((least - 1, found), (least + 1, more)):
        search = settle.Search(ground, changed)
        monkeypatch.setattr(search.__class__, "_placed", lambda *_: more)
        monkeypatch.setattr(search.__class__, "_exchanges", lambda *_: [])
        costs = {id(found): 1000.0, id(more): 1000.0 - gained}
        monkeypatch.setattr(search.__class__, "_judged", lambda _, one, costs=costs: (one, costs[id(one)]))
        assert search.settle([], found).removed == told.removed


def test_of_an_exchange_the_answer_that_tells_no_more_may_win(estimated, monkeypatch):
    """One that tells a thing more is a little cheaper, and not by as much as the thing must gain."""
    ground, _, changed, told = estimated
    k, found = len(told.olds), with_left(told, 1)
    better = with_left(told, 0)
    more = replace(better, olds=(*found.olds, *found.olds), removed={k: 0.9})
    costs = {id(found): 1000.0, id(better): 980.0, id(more): 970.0}
    for tries, best in (([more, better], better), ([more], found)):
        search = settle.Search(ground, changed)
        monkeypatch.setattr(search.__class__, "_placed", lambda *_: found)
        monkeypatch.setattr(search.__class__, "_judged", lambda _, one: (one, costs[id(one)]))
        exchanges = [(("slid", 0, 0), lambda _, tries=tries: iter(tries))]
        monkeypatch.setattr(
            search.__class__, "_exchanges", lambda _, best, some=exchanges: some if best is found else []
        )
        kept = []
        monkeypatch.setattr(search.__class__, "_led", lambda _, best, *rest, kept=kept: kept.append(best))
        search.settle([])
        assert kept[0] is best


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
    monkeypatch.setattr(settle, "places_among", lambda *_: [])
    monkeypatch.setattr(settle, "rotated_at", lambda *_: [])
    change, _ = settled(capture, tmp_path, monkeypatch)
    assert sorted(o.kind for o in change.objects) == (["moved"] if known else ["added", "removed"])
    assert not known or float(angle_between(change.objects[0].new_from_old, AWAY)) < 1.5


@pytest.mark.parametrize(("left", "taken"), [(8.0, True), (12.0, False)])
def test_more_objects_are_taken_only_where_they_leave_less_unexplained(monkeypatch, left, taken):
    begun, more = Settled(), Settled(touched=(1,))
    monkeypatch.setattr(settle, "judged", lambda ground, one: (one, 10.0 if one is begun else left))
    monkeypatch.setattr(settle.Search, "_placed", lambda self, olds, before: more)
    monkeypatch.setattr(settle.Search, "_exchanges", lambda self, best: [])
    assert (settle.Search(SimpleNamespace(tally=Tally()), []).settle([], begun).touched == (1,)) is taken
