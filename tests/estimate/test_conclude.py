"""What is told where the photos' changes meet nowhere in space."""

from types import SimpleNamespace

import numpy as np
import torch

from refield.estimate.conclude import disagreeing
from refield.estimate.detect import Changed, Errors
from refield.estimate.look import View
from refield.scene.camera import Camera

SIDE = 100
CAMERA = Camera(SIDE, SIDE, 100.0, 100.0, SIDE / 2, SIDE / 2)
ERRORS = Errors((), None, np.ones(1), np.ones(1), by_chance=(0.0, 0.001, 0.002) * 3)  # type: ignore[arg-type]


def photo(name: str, share: float) -> Changed:
    mask = np.arange(SIDE * SIDE).reshape(SIDE, SIDE) < share * SIDE * SIDE
    frame = SimpleNamespace(world_from_cam=torch.eye(4, dtype=torch.float64), camera=CAMERA, name=name)
    one, none = np.ones((SIDE, SIDE), np.float32), np.zeros((SIDE, SIDE), bool)
    colours = np.zeros((SIDE, SIDE, 3), np.float32)
    return Changed(View(frame, CAMERA, colours, colours, one, one), 20 * mask, one, mask, none, none)


def told(*shares: float):
    return disagreeing([photo(f"{k}.jpg", share) for k, share in enumerate(shares)], (), ERRORS)


def test_photos_of_different_states_are_not_understood():
    change = told(0.05, 0.04, 0.0, 0.06)
    assert change.unexplained and "one and the same state" in change.why


def test_places_that_are_too_small_for_a_thing_are_not_said_to_be_none():
    changed = [photo(f"{k}.jpg", 0.002) for k in range(2)]
    assert disagreeing(changed, (), ERRORS, 0.003).why.endswith(
        "more than one photo shows, and that fills 0.3 % of any"
    )
    assert disagreeing(changed, (), ERRORS).why.endswith("more than one photo shows")


def test_one_photo_of_several_that_differs_alone_is_named_and_tells_of_no_change():
    change = told(0.0, 0.0, 0.002, 0.034)
    assert not change.unexplained
    assert "3 % of 3.jpg differ, which nothing confirms" in change.why


def test_the_only_photo_there_is_may_tell_of_one():
    assert told(0.05).unexplained
    assert not told(0.01).unexplained


def test_spots_as_large_as_the_fields_own_errors_are_not_spoken_of():
    change = told(0.002, 0.001, 0.003, 0.0)
    assert not change.unexplained and "differ, which" not in change.why
