"""Poses: searched, matched and refined, against a truth that is known."""

from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import ndimage

from refield.estimate import recipe, rotations
from refield.estimate.alone import object_alone
from refield.estimate.associate import take_off
from refield.estimate.conclude import Told, _shown_in, concluded
from refield.estimate.detail import detail_of, looking_alike
from refield.estimate.explain import explained_before
from refield.estimate.faces import changed_parts
from refield.estimate.fit import is_sunk, left_by, trimmed
from refield.estimate.ground import AssociateConfig
from refield.estimate.hull import HullConfig
from refield.estimate.kept import Kept
from refield.estimate.layers import Sight, layers_at
from refield.estimate.likelihood import Settled
from refield.estimate.look import Hidden, see, shaded
from refield.estimate.matched import camera_from_object, matched_poses
from refield.estimate.models import Models
from refield.estimate.outline import ObjectConfig, remembered
from refield.estimate.past import _around, background_seen, changed_share, gone_score, look_past, silhouette
from refield.estimate.pose_change import COARSEST, FINER, SIDE, RefineConfig, refine, residuals
from refield.estimate.register import RegisterConfig, Target, register, super_fibonacci, turns_about
from refield.estimate.rotations import best_rotations, may_be_turned
from refield.field.render import render_camera
from refield.field.source import Known
from refield.scene.camera import Camera
from refield.scene.capture import Rays, camera_rays
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.planes import Plane
from refield.scene.pose import angle_between, invert, transform
from refield.update.composite import UpdatedField, source_of
from refield.vision.matcher import SiftMatcher
from tests.estimate.boxes import BoxWorld, camera_at, capture_of, new_photos, standing, turn

CRATE = standing((0.2, 0.17, 0.18), -0.2, -0.15, 20, paint=3)
TRUE = turn(CRATE.world_from_box[:3, 3], 70, (0.4, 0.25, 0))
BEFORE = BoxWorld((CRATE,))


@dataclass
class Stage:
    scene: object
    old: object
    past: list
    capture: object
    frames: list


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """A crate that moved, up to where its pose is asked for."""
    folder = tmp_path_factory.mktemp("stage")
    capture = capture_of(BEFORE, folder / "before")
    frames = new_photos(BoxWorld((CRATE.moved(TRUE),)), folder / "after")
    config = recipe.EstimateConfig(survey=6)
    scene = recipe._detected(capture, BEFORE, frames, config, Models())
    parts = changed_parts(scene.changed, recipe._carved(scene), HullConfig(smallest=40), scene.models.segmenter)
    (old,) = recipe._were_there(scene, parts.things)
    past = look_past(BEFORE, scene.changed, scene.errors.memory, [old], (config.detect, config.hull))
    return Stage(scene, old, past, capture, frames)


def error(new_from_old):
    c = CRATE.world_from_box[:3, 3]
    return float(angle_between(new_from_old, TRUE)), float((transform(new_from_old, c) - transform(TRUE, c)).norm())


def test_rotations_are_spread_evenly_over_all_turns():
    r = torch.from_numpy(super_fibonacci(500))
    torch.testing.assert_close(r @ r.mT, torch.eye(3).double().expand(500, 3, 3))
    assert (torch.linalg.det(r) > 0.99).all()
    to_identity = angle_between(r, torch.eye(3).double().expand(500, 3, 3))
    assert float(to_identity.min()) < 30  # somewhere near every rotation, the identity among them
    axis = turns_about(np.array([0, 0, 2.0]), 4)
    np.testing.assert_allclose(axis[1] @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_the_object_is_known_to_be_gone(stage):
    assert changed_share(stage.past, stage.old) > 0.8
    share, asked = gone_score(stage.past, stage.old)
    assert share > 0.5 and asked > 50


def test_photos_that_would_look_the_same_without_it_are_not_asked(stage):
    """Where the field shows a thing as it shows what is behind it, an unchanged photo does not say that it stayed."""
    changed, config = list(stage.scene.changed), stage.scene.config
    for i in range(len(changed)):
        alike = replace(changed[i].view, rgb=stage.past[i].rgb)
        some = list(changed)
        some[i] = replace(changed[i], view=alike, mask=np.zeros_like(changed[i].mask))
        past = look_past(BEFORE, some, stage.scene.errors.memory, [stage.old], (config.detect, config.hull))
        here = silhouette(alike, stage.old) & past[i].known
        assert here.sum() > 50 and (here & past[i].telling).sum() < 0.1 * here.sum()
        assert changed_share(past, stage.old) > 0.7
        share, asked = gone_score(past, stage.old)
        assert share > 0.5 and asked > 50


def test_what_nobody_saw_the_place_of_is_gone_where_that_looks_like_what_is_around(stage):
    """As of what lies flat: all that is behind it is what it lies on."""
    nobody = SimpleNamespace(times_seen=lambda view, depth, where: np.zeros(view.shape, int))
    config = stage.scene.config

    def past(changed):
        return look_past(BEFORE, changed, nobody, [stage.old], (config.detect, config.hull))

    known = past(stage.scene.changed)
    assert not any((p.was & p.known).any() for p in known)
    assert left_by(SimpleNamespace(believe=AssociateConfig()), known, stage.old) is not None
    assert gone_score(known, stage.old)[1] > 50
    assert background_seen(stage.past, stage.old) and not background_seen(known, stage.old)
    for views, words in ((stage.past, "show what is behind it"), (known, "look like what is around it")):
        settled = Settled(removed={0: 0.9}, views=tuple(views), olds=(stage.old,), led={0: 1.0})
        told = concluded(Told(SimpleNamespace(field=BEFORE), (), stage.scene.changed, (), stage.scene.errors), settled)
        assert f"90 % of its pixels {words}" in told.why
    other = []
    for c in stage.scene.changed:  # another thing stands there
        photo = c.view.photo.copy()
        photo[silhouette(c.view, stage.old)] = (0.1, 0.9, 0.9)
        other.append(replace(c, view=replace(c.view, photo=photo)))
    assert gone_score(past(other), stage.old)[0] < 0.1
    stayed = [replace(c, mask=np.zeros_like(c.mask)) for c in stage.scene.changed]
    assert gone_score(past(stayed), stage.old)[0] == 0


def test_what_is_around_is_asked_of_the_nearest_unchanged_pixels():
    unknown, unchanged = np.zeros((2, 50, 50), bool)
    unknown[10:14, 10:14], unchanged[10:14, 16:30], unchanged[40:] = True, True, True
    lab = np.full((50, 50, 3), 50.0, np.float32)
    lab[:, 24:30] = lab[40:] = 80  # farther than as many pixels as are asked
    apart = _around(lab, unknown, unchanged)
    assert np.isinf(apart[~unknown]).all() and (apart[unknown] == 0).all()
    lab[10:14, 10:14] = 80
    assert (_around(lab, unknown, unchanged)[unknown] > 50).all()
    assert np.isinf(_around(lab, unknown, np.zeros_like(unknown))).all()


def test_looking_past_it_heeds_how_near_to_a_surface_is_on_it(stage):
    """To one who takes everything for the same surface, nothing was taken off it."""
    told = {}
    for surface in (HullConfig().surface, 1e4):
        carving, memory = HullConfig(surface=surface), stage.scene.errors.memory
        past = look_past(BEFORE, stage.scene.changed, memory, [stage.old], (stage.scene.config.detect, carving))
        ground = SimpleNamespace(believe=AssociateConfig())
        told[surface] = left_by(ground, past, stage.old) is not None
    assert list(told.values()) == [True, False]


def test_registration_finds_the_turn(stage):
    centre = transform(TRUE, CRATE.world_from_box[:3, 3]).numpy() + np.array([0.04, -0.03, 0.03])
    wanted = tuple((p.open * 1.0 - ~p.changed.mask).astype(np.float32) for p in stage.past)
    best = register(stage.old.cloud, stage.past, Target(centre[None].astype(np.float32), wanted), np.array([0, 0, 1.0]))
    degrees, distance = error(best[0].new_from_old)
    assert degrees < 1.0 and distance < 0.008
    assert best[0].score < 0.4 and all(a.score <= b.score for a, b in pairwise(best))


def test_rotations_are_tried_also_where_no_turn_fits(stage):
    """Turns about an axis that is none of it fit better at a wrong place, as a guess does; the place itself counts."""
    centre = CRATE.world_from_box[:3, 3]
    target = Target(
        np.stack([transform(TRUE, centre).numpy() + 0.02, centre.numpy()]).astype(np.float32),
        tuple(np.where(p.changed.mask, 0, -1).astype(np.float32) for p in stage.past),
    )
    up, guess = np.array([1.0, 0, 0]), [turn(centre, 20, (0.02, 0, 0))]
    one, more = (
        register(stage.old.cloud, stage.past, target, up, RegisterConfig(places=k), guess)[0].new_from_old
        for k in (1, 2)
    )
    assert error(one)[0] > 45 and error(more)[0] < 1.0


def turning(stage):
    """What turns are asked on."""
    return SimpleNamespace(
        field=BEFORE,
        photographed=stage.scene.capture.train,
        details=Kept(),
        survey=stage.scene.survey,
        planes=[],
        believe=AssociateConfig(),
        carving=HullConfig(),
        shape=ObjectConfig(),
        search=RegisterConfig(rotations=350),
        fine=RefineConfig(),
    )


def test_an_object_is_drawn_by_its_points_about_as_its_field_shows_it(stage):
    """With its colours, at its distance, nothing of its back; with gaps where its points are sparser than pixels."""
    sight = Sight(stage.scene.field, stage.old, stage.past, [stage.old])
    field = layers_at(sight, TRUE, 8_000)
    points = replace(field, by_points=True)
    for looked_up, drawn in zip(field.show(TRUE), points.show(TRUE)):
        solid, found = (layer.opacity > 0.5 for layer in (looked_up, drawn))
        both = solid & found
        assert float(both.sum() / found.sum()) > 0.9 and float(both.sum() / solid.sum()) > 0.6
        assert float((looked_up.own - drawn.own)[both].abs().mean()) < 0.08
        away = (looked_up.depth - drawn.depth)[both].abs()
        assert float(away.median()) < stage.old.lattice.cell and float((away < 0.1).float().mean()) > 0.97
    poses = [turn(transform(TRUE, CRATE.world_from_box[:3, 3]), degrees, (0, 0, 0)) @ TRUE for degrees in (0, 40, 180)]
    parts = [[rotations._part(ready, pose) for pose in poses] for ready in (field, points)]
    assert all(right > 0.5 and max(others) < 0.1 for right, *others in parts)


def test_all_rotations_about_a_place_are_asked_what_they_explain(stage):
    """Begun at the right place a hundred degrees off, whence no descent leads back."""
    ground = turning(stage)
    sight = Sight(BEFORE, stage.old, stage.past, [stage.old])
    wrongly = refine(sight, turn(transform(TRUE, CRATE.world_from_box[:3, 3]), 100, (0.01, 0, 0)) @ TRUE)
    (_, as_it_is), *found = best_rotations(ground, sight, wrongly)
    best = max((change for _, change in found), key=lambda change: change.explained)
    assert error(as_it_is.new_from_old)[0] > 45 and may_be_turned(ground, stage.old, stage.past, wrongly)
    assert error(best.new_from_old)[0] < 1.5 and best.explained > as_it_is.explained + 0.1
    later = SimpleNamespace(**(vars(ground) | {"photographed": []}))
    assert not may_be_turned(later, stage.old, stage.past, wrongly)


def test_an_object_is_rotated_in_every_way_at_a_place(stage):
    ground, place = turning(stage), transform(TRUE, torch.from_numpy(stage.old.centre).double()).numpy()
    found = rotations.rotated_at(ground, Sight(BEFORE, stage.old, stage.past, [stage.old]), place + 0.01)
    best = max((change for _, change in found), key=lambda change: change.explained)
    assert error(best.new_from_old)[0] < 1.5 and error(best.new_from_old)[1] < 0.01


@pytest.mark.parametrize(("degrees", "most"), [(-17, 1), (-14, 1), (14, 1), (18, 3)])
def test_the_best_rotation_is_climbed_from(stage, degrees, most):
    """About half as far from the truth as the rotations lie apart, whence descent alone ends elsewhere."""
    ground = turning(stage)
    sight = Sight(BEFORE, stage.old, stage.past, [stage.old])
    near = turn(transform(TRUE, CRATE.world_from_box[:3, 3]), degrees, (0, 0, 0)) @ TRUE
    descended = error(refine(sight, near, levels=FINER).new_from_old)[0]
    climbed = error(rotations._climbed(ground, sight, stage.old, near).new_from_old)[0]
    assert climbed < most < 0.5 * descended


def test_crops_have_room_for_an_object_however_it_is_rotated(stage):
    """The box of what lies across a photo is none of it standing on end."""
    long = stage.old.lattice.centres[..., 0]
    voxels = np.zeros_like(stage.old.voxels)
    voxels[:, voxels.shape[1] // 2, voxels.shape[2] // 2] = True
    old = replace(stage.old, voxels=voxels)
    sight = Sight(BEFORE, old, stage.past, [old])
    at = torch.from_numpy(old.centre).double()
    upright = turn(at, 0, (0, 0, 0)).clone()
    upright[:3, :3] = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    upright[:3, 3] = at - upright[:3, :3] @ at
    ends = transform(upright, torch.from_numpy(old.lattice.centres[voxels]).double())
    assert long[voxels].max() > long[voxels].min()
    for turning_too in (False, True):
        ready = layers_at(sight, torch.eye(4).double(), 10**9, turning=turning_too)
        inside = []
        for crop in ready.crops:
            frame = stage.past[crop.photo_index].view.frame.world_from_cam
            uv, _ = crop.camera.project((ends - frame[:3, 3]).float() @ frame[:3, :3].float())
            x0, y0, x1, y1 = crop.box
            seen = (uv >= 0).all(-1) & (uv[:, 0] < crop.camera.width) & (uv[:, 1] < crop.camera.height)
            held = (uv[:, 0] >= x0) & (uv[:, 0] <= x1) & (uv[:, 1] >= y0) & (uv[:, 1] <= y1)
            inside.append(bool(held[seen].all()))
        assert all(inside) is turning_too


def test_a_place_may_be_known_of_another_point_than_the_middle(stage):
    """Where the thickest part of an object fits, its middle need not be."""
    corner = transform(CRATE.world_from_box, torch.tensor([0.5, -0.4, 0.3], dtype=torch.float64))
    wanted = tuple(np.where(p.changed.mask, 0, -1).astype(np.float32) for p in stage.past)
    place = transform(TRUE, corner).numpy()[None].astype(np.float32)
    few, up = RegisterConfig(steps=2), np.array([0, 0, 1.0])
    known, taken = (
        register(stage.old.cloud, stage.past, Target(place, wanted, anchor), up, few)[0]
        for anchor in (corner.numpy(), None)
    )
    assert error(known.new_from_old)[0] < 1.0 and known.score < 0.7 * taken.score


def test_a_pose_of_which_little_can_be_seen_is_worse_than_one_that_is_seen(stage):
    """Something stands before most of the crate: what is left of it fits as well as the whole does."""
    middle = transform(TRUE, CRATE.world_from_box[:3, 3]).numpy().astype(np.float32)
    anywhere = Target(middle[None], tuple(np.zeros(p.view.shape, np.float32) for p in stage.past))
    hidden = []
    for p in stage.past:
        column = int(p.view.project(middle[None])[0][0, 0])
        depth = np.zeros_like(p.depth)
        depth[:, column - 3 : column + 3] = p.depth[:, column - 3 : column + 3]
        hidden.append(replace(p, depth=depth))
    up = np.array([0, 0, 1.0])
    seen, little = (
        register(stage.old.cloud, past, anywhere, up, extra=[TRUE])[0].score for past in (stage.past, hidden)
    )
    assert seen < 0.2 and 0.3 < little < 0.6


def test_matched_points_give_the_pose_although_some_are_wrong():
    """Eq. 12 with an oracle's matches."""
    camera, world_from_cam = Camera(200, 160, 180.0, 182.0, 101, 79, k1=0.05), camera_at(30, 40)
    g = torch.Generator().manual_seed(0)
    old = CRATE.world_from_box[:3, 3] + (torch.rand(40, 3, generator=g, dtype=torch.float64) - 0.5) * 0.4
    uv, _ = camera.project(transform(invert(world_from_cam), transform(TRUE, old)))
    uv[:10] += 30
    pose = camera_from_object(uv.numpy(), old.numpy(), camera, 8)
    degrees, distance = error(world_from_cam @ pose)
    assert degrees < 0.01 and distance < 1e-4
    assert camera_from_object(uv[:6].numpy(), old[:6].numpy(), camera, 8) is None


def test_nothing_matches_without_texture(stage):
    grey = [replace(p, changed=replace(p.changed, view=replace(p.view, photo=p.view.photo * 0))) for p in stage.past]
    assert matched_poses(stage.old, grey, stage.scene.survey, SiftMatcher()) == []


def test_refinement_through_the_field_improves_a_rough_pose(stage):
    rough = turn(transform(TRUE, CRATE.world_from_box[:3, 3]), 3.0, (0.01, -0.008, 0.006), axis=(0.6, 0, 0.8)) @ TRUE
    found = refine(Sight(BEFORE, stage.old, stage.past, [stage.old]), rough)
    degrees, distance = error(found.new_from_old)
    assert degrees < 0.6 and distance < 0.005
    assert found.explained > 0.8 > found.before + 0.2
    assert torch.linalg.eigvalsh(found.covariance).min() > 0 and found.note == ""


def test_colour_slopes_with_respect_to_the_pose_are_those_of_finite_differences(stage):
    """The sliding-layer derivative: same direction and size for every one of six motions."""
    r, config = layers_at(Sight(BEFORE, stage.old, stage.past, [stage.old]), TRUE, 12_000), RefineConfig(shaded=0.0)
    now = residuals(r, TRUE, 1.5, config)
    inner = now.weight > 0.5
    for k in range(6):
        h = 0.6 * r.pixel if k < 3 else 0.6 * r.pixel / r.old.radius
        twist = torch.zeros(6, dtype=torch.float64)
        twist[k] = h
        plus, minus = (residuals(r, r.moved(TRUE, s * twist), 1.5, config).error for s in (1, -1))
        measured = ((plus - minus) / (2 * h))[inner].reshape(-1)
        said = now.jacobian[..., k][inner].reshape(-1)
        cosine = float((measured * said).sum() / (measured.norm() * said.norm()))
        assert cosine > 0.8, k
        assert 0.6 < float(said.norm() / measured.norm()) < 1.6, k


def test_an_object_moved_by_the_identity_is_rendered_where_it_was(stage):
    view = stage.past[0].view
    still = torch.eye(4, dtype=torch.float64)
    alone = object_alone(BEFORE, stage.old, camera_rays(view.camera, view.frame.world_from_cam), still)
    rgb = alone.rgb
    here = (alone.opacity > 0.9).numpy().reshape(view.shape)
    inward = torch.from_numpy(np.nan_to_num(view.surface + 0.02 * view.directions, posinf=9))
    true = CRATE.inside(inward).numpy()
    assert (here & true).sum() > 0.9 * true.sum()
    np.testing.assert_allclose(rgb.numpy().reshape(*view.shape, 3)[here & true], view.rgb[here & true], atol=0.05)


def test_a_moved_object_is_rendered_as_the_moved_world_shows_it(stage):
    """The move-in half of the commuting square."""
    after = BoxWorld((CRATE.moved(TRUE),))
    view = stage.past[1].view
    truth = render_camera(after, view.camera, view.frame.world_from_cam)
    alone = object_alone(BEFORE, stage.old, camera_rays(view.camera, view.frame.world_from_cam), TRUE)
    rgb = alone.rgb
    sure = (alone.opacity > 0.95).reshape(view.shape)
    apart = (rgb.reshape(*view.shape, 3) - truth.rgb).abs().amax(-1)[sure]
    assert len(apart) > 100 and float(apart.median()) < 0.05


def test_an_object_behind_everything_is_not_shown_and_breaks_nothing(stage):
    hidden = [replace(p, beyond=np.full_like(p.depth, 0.01)) for p in stage.past]
    found = refine(Sight(BEFORE, stage.old, hidden, [stage.old]), TRUE)
    assert found is None or found.explained == 0


def test_what_a_placed_object_hides_speaks_neither_for_nor_against_another(stage):
    """Half of each photo around the object shows a wall that was placed before it."""
    alone = refine(Sight(BEFORE, stage.old, stage.past, [stage.old]), TRUE)
    place = transform(TRUE, torch.from_numpy(stage.old.centre).double()).float().numpy()
    hidden = []
    for p in stage.past:
        u = int(p.view.project(place)[0][0])
        covered, depth = np.zeros(p.view.shape, bool), p.depth.copy()
        covered[:, u:], depth[:, u:] = True, 0.3
        hidden.append(replace(p, covered=covered, depth=depth))
    ready = layers_at(Sight(BEFORE, stage.old, hidden, [stage.old]), TRUE, 12_000)
    half = refine(Sight(BEFORE, stage.old, hidden, [stage.old]), TRUE)
    assert 0.3 * alone.pixels < half.pixels < 0.7 * alone.pixels
    assert half.explained > 0.9
    for crop, shown in zip(ready.crops, ready.show(TRUE)):
        assert shown.hidden.any() and not shown.hidden.all()
        assert not (ready.sides(crop, shown, TRUE)[shown.hidden.numpy()] >= 0).any()


def test_the_outline_of_a_moved_object_is_whole_in_photos_larger_than_the_working_size(stage):
    config = recipe.EstimateConfig(survey=6, max_pixels=1200)
    small = recipe._detected(stage.capture, BEFORE, stage.frames, config, Models())
    past = look_past(BEFORE, small.changed, small.errors.memory, [stage.old], (config.detect, config.hull))
    found = refine(Sight(BEFORE, stage.old, past, [stage.old]), TRUE)
    ground = SimpleNamespace(object_alone=lambda old, view, c: object_alone(BEFORE, old, view.rays, c.new_from_old))
    sight = Sight(BEFORE, stage.old, take_off(ground, past, stage.old, found), [stage.old])
    masks = _shown_in(sight, found.new_from_old)
    assert len(masks) == 4
    for k, mask in masks.items():
        assert mask.shape == (80, 80) and mask.sum() > 100
        assert (ndimage.binary_fill_holes(mask.numpy()) == mask.numpy()).all(), k


def test_each_side_of_an_outline_is_asked_by_itself(stage):
    """Photos in which half of the object is of another colour do not show that half, and show the other."""
    centres, old = stage.old.lattice.centres, stage.old
    left = centres[..., 0] < old.centre[0]
    one, other = (replace(old, voxels=old.voxels & half) for half in (left, ~left))
    ready = layers_at(Sight(BEFORE, old, stage.past, [old]), TRUE, RefineConfig().rays[0])
    painted = []
    for crop, shown in zip(ready.crops, ready.show(TRUE)):
        solid, x = ready.places(crop, shown, TRUE)
        wrong = torch.zeros(len(crop.rays), dtype=torch.bool)
        wrong[torch.from_numpy(solid)] = torch.from_numpy(x[:, 0] < old.centre[0])
        painted.append(replace(crop, photo=torch.where(wrong[:, None], 1 - crop.photo, crop.photo)))
    sigma = SIDE * ready.apparent
    assert min(half.part for half in ready.explained_of((one, other), TRUE, sigma)) > 0.7
    told, rest = replace(ready, crops=painted).explained_of((one, other), TRUE, sigma)
    assert told.part < 0.5 and rest.part > 0.7 and min(told.pixels, rest.pixels) > 100


def test_what_would_reach_into_the_ground_is_cut_off(stage):
    z = stage.old.lattice.centres[..., 2]
    near = np.abs(stage.old.lattice.centres - stage.old.centre)[..., :2].max(-1) < 0.1
    deeper = replace(stage.old, voxels=stage.old.voxels | (near & (z < 0)), free=np.ones_like(stage.old.free))
    assert (deeper.voxels & (z < 0)).sum() > 0.03 * deeper.voxels.sum()
    ground = SimpleNamespace(
        planes=[Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)],
        carving=HullConfig(),
        believe=AssociateConfig(),
        shape=recipe.ObjectConfig(),
        fine=RefineConfig(),
    )
    sight = Sight(BEFORE, deeper, stage.past, [stage.old])
    old, change = trimmed(ground, sight, refine(sight, TRUE, levels=COARSEST))
    assert not (old.voxels & (z < 0)).any()
    assert (old.voxels & stage.old.voxels).sum() > 0.9 * stage.old.voxels.sum()
    assert error(change.new_from_old)[0] < 0.6
    same, _ = trimmed(replace_planes(ground), sight, refine(sight, TRUE, levels=COARSEST))
    assert (same.voxels & (z < 0)).any()  # without the ground nothing denies it


def test_looking_past_what_is_hidden_is_as_if_whole_rays_were_asked(stage):
    hidden = Hidden((stage.old.haze,))
    rays = stage.past[0].view.rays[torch.arange(0, len(stage.past[0].view.rays), 7)]
    up = Rays(rays.origins[:5], torch.tensor([0.0, 0.0, 1.0]).expand(5, 3).contiguous())
    longest = 0
    for some in (rays, up):
        samples = BEFORE.sampler(some)
        at = samples.positions(some)
        truth = shaded(BEFORE, at, torch.where(stage.old.haze.contains(at[0]), 0.0, BEFORE.density(at[0])), samples)
        seen = see(BEFORE, some, hidden)
        torch.testing.assert_close(seen.rgb, truth.rgb, rtol=0, atol=2e-3)
        torch.testing.assert_close(seen.depth, truth.depth, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(seen.opacity, truth.opacity, rtol=0, atol=2e-3)
        longest = max(longest, int(samples.ray_offsets.diff().max()))
    assert longest > 12 and not torch.equal(see(BEFORE, rays).rgb, see(BEFORE, rays, hidden).rgb)


def test_a_place_mostly_beneath_the_ground_is_told(stage):
    ground = SimpleNamespace(planes=[Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)])
    found = refine(Sight(BEFORE, stage.old, stage.past, [stage.old]), TRUE)
    assert not is_sunk(ground, stage.old, found)
    lower = found.new_from_old.clone()
    lower[2, 3] -= 0.6 * float(stage.old.grid.tight_aabb().diff(dim=0)[0, 2])
    assert is_sunk(ground, stage.old, replace(found, new_from_old=lower))
    assert not is_sunk(replace_planes(ground), stage.old, replace(found, new_from_old=lower))


def replace_planes(ground):
    return SimpleNamespace(**{**vars(ground), "planes": []})


def test_what_a_field_shows_badly_is_told_from_what_it_shows_well():
    rng = np.random.default_rng(0)
    photo = rng.uniform(0.2, 0.8, (20, 20, 3)).astype(np.float32)
    here = np.zeros((20, 20), bool)
    here[4:16, 4:16] = True
    assert explained_before([(photo, photo, here)], 5.0) == 1.0
    flat = np.full_like(photo, 0.5)
    assert explained_before([(photo, flat, here)], 2.0) < 0.5
    few = np.zeros_like(here)
    few[:2, :3] = True
    assert explained_before([(photo, flat, few)], 2.0) == 1.0  # too few to say


def test_detail_of_old_photos_is_what_the_field_lacks(stage):
    """The field paints the crate without a pattern: what it lacks is the pattern."""
    plain = BoxWorld((replace(CRATE, paint=-1),))
    views = [p.view for p in stage.past]
    frames = looking_alike(stage.old, stage.capture.frames, views, TRUE, 3)
    assert 4 <= len(frames) <= 12
    detail = detail_of(plain, stage.old, frames, 80_000)
    assert len(detail.patches) == len(frames)
    top = torch.from_numpy(stage.old.cloud.points[stage.old.cloud.normals[:, 2] > 0.9])
    eye = torch.from_numpy(stage.old.centre) + torch.tensor([0.6, 0.2, 1.5])
    lacks, true = detail.at(top, eye), CRATE.colour(top)
    lacks, true = lacks - lacks.mean(0), true - true.mean(0)
    assert float((lacks * true).sum() / (lacks.norm() * true.norm())) > 0.8
    assert looking_alike(stage.old, [], views, TRUE, 3) == []
    assert detail_of(plain, stage.old, [], 80_000).patches == ()


def test_an_object_that_moved_before_is_looked_up_where_it_first_was(stage):
    grid = stage.old.shape
    eyes = torch.stack([f.centre for f in stage.capture.frames]).float()
    once = UpdatedField(BEFORE, SceneChange((ObjectChange("moved", grid, TRUE),)), eyes=eyes)
    there = grid.moved(TRUE)
    source = source_of(once, there)
    assert source is not None and source.field is BEFORE
    layered, sourced = (
        remembered(once, stage.capture.frames, Known(there, s), (), ObjectConfig()) for s in (None, source)
    )
    assert layered.source is None and sourced.source is source
    on = turn(transform(TRUE, CRATE.world_from_box[:3, 3]), -110, (-0.5, 0.1, 0))
    view = stage.past[0].view
    rays = camera_rays(view.camera, view.frame.world_from_cam)
    truth = see(BoxWorld((CRATE.moved(on @ TRUE),)), rays)
    shown = [object_alone(once, old, rays, on) for old in (layered, sourced)]
    solid = (shown[0].opacity > 0.9) & (shown[1].opacity > 0.9)
    either = (shown[0].opacity > 0.5) | (shown[1].opacity > 0.5)
    assert int(solid.sum()) > 300 and float(solid.sum()) > 0.8 * float(either.sum())
    off = [(s.rgb - truth.rgb)[solid].abs().amax(-1) for s in shown]
    assert float(off[1].median()) < 0.02 and float(off[1].mean()) < float(off[0].mean()) + 0.01
    assert float((shown[1].depth - truth.depth)[solid].abs().median()) < 0.02
