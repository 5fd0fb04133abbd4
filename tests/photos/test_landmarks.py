"""Landmarks: kept whole, of this capture only, and made from given poses where they are lacking."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from refield.photos.landmarks import read_landmarks, triangulated, write_landmarks
from refield.scene.capture import Capture
from refield.scene.errors import InputError
from refield.scene.pose import exp
from tests.photos.reconstructed import QUICK
from tests.photos.room import write_photos


def test_they_come_back_whole(reconstructed, tmp_path):
    landmarks, path = reconstructed.found.landmarks, tmp_path / "landmarks.safetensors"
    write_landmarks(path, landmarks)
    back = read_landmarks(path, reconstructed.found.capture)
    assert back is not None and back.lenses == landmarks.lenses and back.sharpness == landmarks.sharpness
    for name in ("points", "descriptors", "point_of", "frame_of", "words", "globals_", "poses"):
        assert torch.equal(getattr(back, name), getattr(landmarks, name))


def test_those_of_another_capture_or_damaged_ones_are_not_taken(reconstructed, tmp_path):
    capture, path = reconstructed.found.capture, tmp_path / "landmarks.safetensors"
    assert read_landmarks(path, capture) is None
    write_landmarks(path, reconstructed.found.landmarks)
    assert read_landmarks(path, Capture(capture.frames[:-1])) is None
    assert read_landmarks(path, reconstructed.true) is None, "the same photos in another world"
    path.write_bytes(path.read_bytes()[:-100])
    assert read_landmarks(path, capture) is None
    path.write_bytes(b"no tensors")
    assert read_landmarks(path, capture) is None


def test_a_posed_capture_is_triangulated_in_its_own_world(reconstructed, tmp_path):
    landmarks = triangulated(reconstructed.true, tmp_path / "cache", QUICK.motion)
    points = landmarks.points
    off = torch.stack([points[:, 2].abs(), (points[:, 0] + 2).abs(), (points[:, 1] + 2).abs()]).min(0).values
    assert len(points) > 200 and float(off.median()) < 0.01
    assert len(landmarks.globals_) == 8 and landmarks.frame_of.unique().tolist() == list(range(8))


def test_poses_that_are_wrong_are_told(tmp_path):
    capture = write_photos(tmp_path, 4)
    random = torch.Generator().manual_seed(0)
    turns = [exp(torch.randn(6, generator=random, dtype=torch.float64)) for _ in capture.frames]
    wrong = [replace(f, world_from_cam=turn) for f, turn in zip(capture.frames, turns)]
    with pytest.raises(InputError, match="points of its photos agree with their poses; check its poses"):
        triangulated(Capture(tuple(wrong)), tmp_path / "cache", QUICK.motion)
