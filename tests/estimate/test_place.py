"""New photos' poses, refined against the field before anything is compared."""

import dataclasses

import pytest
import torch

from refield.estimate.detect import DetectConfig, carried
from refield.estimate.look import view_of
from refield.estimate.place import PlaceConfig, place
from refield.estimate.recipe import EstimateConfig, estimate_change
from refield.scene.errors import InputError
from refield.scene.images import write_image
from refield.scene.pose import exp, invert, log
from tests.estimate.boxes import BoxWorld, capture_of, new_photos, standing, turn

CRATE = standing((0.2, 0.17, 0.18), -0.25, -0.2, 20, paint=3)
DRUM = standing((0.15, 0.15, 0.2), 0.4, 0.35, -10, paint=5)
BEFORE = BoxWorld((CRATE, DRUM))
AFTER = BoxWorld((CRATE.moved(turn(CRATE.world_from_box[:3, 3], 50, (0.35, -0.15, 0))), DRUM))


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return new_photos(AFTER, tmp_path_factory.mktemp("after"))


def off(frame, twist):
    pose = frame.world_from_cam @ exp(torch.tensor(twist, dtype=torch.float64))
    return dataclasses.replace(frame, world_from_cam=pose)


def placed(frame, **settings):
    view = carried(view_of(BEFORE, frame, 24_000), DetectConfig())
    return place(view, PlaceConfig(**settings))


@pytest.mark.parametrize("twist", [(0.02, -0.01, 0.02, 0, 0, 0), (0, 0, 0, 0.012, -0.01, 0.015)])
def test_a_pose_that_is_a_pixel_or_two_off_is_put_right_although_an_object_moved(photos, twist):
    wrong = off(photos[0], twist)
    found = placed(wrong)
    assert found.shift > 0.5
    before, after = (log(invert(photos[0].world_from_cam) @ p) for p in (wrong.world_from_cam, found.world_from_cam))
    assert float(after.norm()) < 0.3 * float(before.norm())


def test_a_right_pose_is_left_as_it_was(photos):
    found = placed(photos[1])
    assert found.shift == 0 and torch.equal(found.world_from_cam, photos[1].world_from_cam)


def test_a_pose_that_is_far_off_is_not_what_this_is_for(photos):
    wrong = off(photos[0], (0, 0, 0, 0, 0.5, 0))
    assert torch.equal(placed(wrong).world_from_cam, wrong.world_from_cam)


def test_a_flat_photo_says_nothing(photos, tmp_path):
    path = tmp_path / "grey.png"
    write_image(path, torch.full((photos[0].camera.height, photos[0].camera.width, 3), 0.5))
    grey = dataclasses.replace(photos[0], path=path)
    assert placed(grey).shift == 0


def test_a_photo_of_something_else_is_rejected_and_the_others_are_used(photos, tmp_path):
    old = capture_of(BEFORE, tmp_path / "before")
    path = tmp_path / "noise.png"
    shape = (photos[0].camera.height, photos[0].camera.width, 3)
    write_image(path, torch.rand(shape, generator=torch.Generator().manual_seed(0)))
    noise = dataclasses.replace(photos[0], path=path, name="noise.png")
    change = estimate_change(old, BEFORE, [noise, *photos[1:]], EstimateConfig(survey=6))
    assert [p.status for p in change.photos] == ["rejected", "used", "used", "used"]
    assert "another scene" in change.photos[0].why
    assert [o.kind for o in change.objects] == ["moved"] and len(change.masks_in) == 3
    again = dataclasses.replace(noise, name="again.png")
    for others in ([noise], [noise, again, photos[1]]):
        with pytest.raises(InputError, match="is this the same scene"):
            estimate_change(old, BEFORE, others, EstimateConfig(survey=6))
