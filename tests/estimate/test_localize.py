"""New photos placed in a capture by what they show; those that do not show it are rejected and say why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from refield.estimate.absolute_pose import solve
from refield.estimate.intrinsics import Guess, guesses
from refield.estimate.localize import LocalizeConfig, kept_landmarks, known_by, localize_photos
from refield.photos.lens import Lens
from refield.photos.look import Look
from refield.photos.taken import Taken
from refield.scene.camera import Camera
from refield.scene.images import write_image
from refield.scene.pose import angle_between, exp, transform
from refield.scene.similarity import between, pose_errors
from refield.scene.world import world_of
from refield.vision import pixels
from tests.photos.room import CAMERA, photo, poses, turned, write_photos

CONFIG = LocalizeConfig(features=500)


@pytest.fixture
def known(reconstructed):
    return known_by(reconstructed.found.capture, reconstructed.found.landmarks)


def errors(reconstructed, placed, true):
    to_true = between(reconstructed.found.capture.frames, reconstructed.true.frames)
    away, turn = pose_errors([placed.frame], [true], to_true)
    return float(away) / world_of(reconstructed.true).size, float(turn)


def test_new_photos_are_placed(reconstructed, known, tmp_path):
    true = write_photos(tmp_path / "new", 3, turn=0.5)
    placed = localize_photos(tmp_path / "new", known, tmp_path / "cache", CONFIG)
    for p, frame in zip(placed, true.frames):
        away, turn = errors(reconstructed, p, frame)
        assert p.status == "used" and away < 0.01 and turn < 0.5
        assert p.placement.inliers > 100 and p.placement.error < 1 and "old photos" in p.placement.camera


@pytest.mark.parametrize(
    ("camera", "how"),
    [
        (CAMERA.scaled(300, 225), "that of the old photos, scaled"),
        (turned(CAMERA), "that of the old photos, turned"),
        (replace(CAMERA, width=220, height=200, cx=110.0, cy=100.0, fx=240.0, fy=240.0), "its own, from the matches"),
    ],
)
def test_other_sizes_and_cameras(reconstructed, known, tmp_path, camera, how):
    true = write_photos(tmp_path / "new", 2, turn=0.3, camera=camera)
    for p, frame in zip(localize_photos(tmp_path / "new", known, tmp_path / "cache", CONFIG), true.frames):
        away, _ = errors(reconstructed, p, frame)
        assert p.placement.camera == how and away < 0.06
        assert p.frame.camera.fx == pytest.approx(camera.fx, rel=0.06)


def test_unusable_photos_are_rejected_with_the_reason(known, tmp_path):
    folder = tmp_path / "new"
    image = photo(CAMERA, poses(3, 0.5)[1])
    write_image(folder / "black.png", torch.zeros(150, 200, 3))
    write_image(folder / "blurred.png", torch.from_numpy(pixels.blur(image.numpy(), 8)))
    write_image(folder / "other.png", photo(CAMERA, poses(3)[1], seed=9))
    noise = torch.rand(150, 200, 3, generator=torch.Generator().manual_seed(0))
    write_image(folder / "noise.png", noise)
    (folder / "broken.jpg").write_text("no picture")
    said = {p.name: p for p in localize_photos(folder, known, tmp_path / "cache", CONFIG)}
    assert all(p.status == "rejected" and p.frame is None for p in said.values()) and len(said) == 5
    assert "is black" in said["black.png"].why and "too blurred" in said["blurred.png"].why
    assert "cannot be placed" in said["other.png"].why and "this scene?" in said["other.png"].why
    assert "cannot be placed" in said["noise.png"].why and "not an image" in said["broken.jpg"].why


def test_landmarks_of_a_posed_capture_are_made_once(reconstructed, tmp_path, monkeypatch):
    true = reconstructed.true
    path, cache = tmp_path / "landmarks.safetensors", tmp_path / "cache"
    first = kept_landmarks(path, true, cache)
    monkeypatch.setattr("refield.estimate.localize.triangulated", lambda *a, **k: pytest.fail("made again"))
    assert torch.equal(kept_landmarks(path, true, cache).points, first.points)
    new = write_photos(tmp_path / "new", 1, turn=0.5)
    (placed,) = localize_photos(tmp_path / "new", known_by(true, first), tmp_path / "cache", CONFIG)
    assert float((placed.frame.centre - new.frames[0].centre).norm()) < 0.01, "in the capture's own world"


def seen(count: int, seed: int = 0) -> tuple[Camera, torch.Tensor, np.ndarray, np.ndarray]:
    """A camera, its pose, and points that it sees: pixels (N, 2) and world points (N, 3)."""
    random = np.random.default_rng(seed)
    pose = poses(1)[0]
    xy = random.random((count, 2)) * [CAMERA.width, CAMERA.height]
    rays = CAMERA.unproject(torch.from_numpy(xy)).numpy() * random.uniform(2, 5, (count, 1))
    xyz = rays @ pose[:3, :3].numpy().T + pose[:3, 3].numpy()
    return CAMERA, pose, xy + random.normal(0, 0.3, xy.shape), xyz


def off(found, pose) -> tuple[float, float]:
    return float((found.world_from_cam[:3, 3] - pose[:3, 3]).norm()), float(angle_between(found.world_from_cam, pose))


@pytest.mark.parametrize("share", [0.33, 0.45])
def test_matches_on_moved_things_do_not_drag_the_pose(share):
    camera, pose, xy, xyz = seen(300)
    moved = np.arange(300) < share * 300
    motion = exp(torch.tensor([0.3, -0.1, 0.05, 0.1, 0.2, -0.3], dtype=torch.float64))
    xyz[moved] = transform(motion, torch.from_numpy(xyz[moved])).numpy()
    away, turn = off(solve(xy, xyz, [Guess(camera, "given")], 2.0), pose)
    assert away < 0.02 and turn < 0.3


def test_what_stands_around_is_believed_before_what_fills_a_spot():
    """More matches on one moved thing than on all of the scene: the scene's pose is taken."""
    camera, pose, xy, xyz = seen(400)
    spot = (np.abs(xy - [60, 60]) < 40).all(1)
    pick = spot | (np.arange(400) < 60)
    xy, xyz, spot = xy[pick], xyz[pick], spot[pick]
    motion = exp(torch.tensor([0.4, 0.1, 0.0, 0.0, 0.1, 0.3], dtype=torch.float64))
    xyz[spot] = transform(motion, torch.from_numpy(xyz[spot])).numpy()
    found = solve(xy, xyz, [Guess(camera, "given")], 2.0)
    assert spot.sum() > (~spot).sum(), "the spot has the majority"
    away, turn = off(found, pose)
    assert away < 0.05 and turn < 0.6 and found.inliers[~spot].mean() > 0.9


def test_matches_at_random_give_no_pose():
    random = np.random.default_rng(1)
    xy, xyz = random.random((200, 2)) * [200, 150], random.normal(0, 2, (200, 3))
    found = solve(xy, xyz, [Guess(CAMERA, "given")], 2.0)
    assert found is None or found.count < 20


def taken(size: tuple[int, int], lens: Lens) -> Taken:
    return Taken("new", Path("new"), "new", *size, lens, Look(1.8, 0.5, 0.2))


def test_the_old_camera_is_tried_where_it_may_be_that(reconstructed):
    capture, landmarks = reconstructed.found.capture, reconstructed.found.landmarks
    old = capture.frames[0].camera
    first, last = guesses(taken((200, 150), Lens()), capture, landmarks)
    assert first.camera == old and last.search and last.refine
    phone = replace(landmarks, lenses=(Lens("Acme", 26.0),) * 8)
    assert [g.camera for g in guesses(taken((200, 150), Lens("Acme", 26.0)), capture, phone)] == [old]
    (other,) = guesses(taken((200, 150), Lens("Other", 50.0)), capture, phone)
    assert other.camera.fx == pytest.approx(50 * 250 / 43.2666, rel=1e-4) and not other.search
