"""Up, size and scale of a world; similarities between two placements of the same photos."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from refield.scene.capture import Capture
from refield.scene.errors import InputError
from refield.scene.pose import angle_between, exp, transform
from refield.scene.similarity import Similarity, between, pose_errors, similarity
from refield.scene.world import World, world_of
from tests.captures import write_capture

TURN = exp(torch.tensor([0, 0, 0, 0.4, -0.7, 1.1], dtype=torch.float64))[:3, :3]
SIM = Similarity(2.5, TURN, torch.tensor([3.0, -1, 0.5], dtype=torch.float64))


def moved(capture: Capture) -> Capture:
    return Capture(tuple(replace(f, world_from_cam=SIM.pose(f.world_from_cam)) for f in capture.frames))


def test_up_and_size_turn_and_scale_with_the_world(tmp_path):
    capture = write_capture(tmp_path, 8)
    world, other = world_of(capture, 0.5), world_of(moved(capture))
    assert world.up == pytest.approx((0, 0, 1), abs=1e-6) and world.size == pytest.approx(6)
    assert other.up == pytest.approx((TURN @ torch.tensor([0, 0, 1.0], dtype=torch.float64)).tolist(), abs=1e-6)
    assert other.size == pytest.approx(2.5 * 6) and (world.metres_per_unit, other.metres_per_unit) == (0.5, None)


def test_a_world_comes_back(tmp_path):
    world = World((0.0, 0.6, 0.8), 3.5, 0.25)
    assert World.from_dict(world.to_dict(), tmp_path) == world
    for wrong in ({}, {"up": [1, 2], "size": 1}, {"up": [0, 0, 1], "size": -1}, {"up": [0, 0, 1], "size": "x"}):
        with pytest.raises(InputError, match="train again"):
            World.from_dict(wrong, tmp_path)


def test_a_similarity_is_found_and_nothing_remains(tmp_path):
    capture = write_capture(tmp_path, 6)
    other = moved(capture)
    found = between(capture.frames, other.frames)
    assert found.scale == pytest.approx(2.5) and torch.allclose(found.rotation, TURN)
    away, turned = pose_errors(capture.frames, other.frames, found)
    assert float(away.max()) < 1e-9 and float(turned.max()) < 1e-5


def test_a_motion_is_the_same_in_both_worlds():
    motion = exp(torch.tensor([0.2, -0.4, 0.1, 0.3, 0.2, -0.5], dtype=torch.float64))
    points = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    there = transform(SIM.motion(motion), SIM.point(points))
    assert torch.allclose(there, SIM.point(transform(motion, points)))
    assert float(angle_between(SIM.motion(motion), torch.eye(4, dtype=torch.float64))) == pytest.approx(
        float(angle_between(motion, torch.eye(4, dtype=torch.float64)))
    )


def test_one_place_has_no_similarity():
    with pytest.raises(ValueError, match="three points"):
        similarity(torch.zeros(5, 3, dtype=torch.float64), torch.ones(5, 3, dtype=torch.float64))
