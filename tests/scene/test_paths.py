"""Camera paths, by what holds of them whatever the cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from refield.scene.camera import Camera
from refield.scene.capture import Frame, centres
from refield.scene.paths import SPREADS, orbit, smooth_path, tour, typical_camera
from refield.scene.pose import angle_between, exp
from tests.captures import CAMERA, looking_at, ring

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def frames_at(poses, camera=CAMERA):
    return [Frame(Path(f"{i}.png"), camera, f"{i}.png", world_from_cam=pose) for i, pose in enumerate(poses)]


def photos(seed, count=40, low=-0.5, high=1.2, arc=2 * torch.pi, goal=(1.0, -2.0, 0.5)):
    """Around a point, at changing distances and heights, within an arc about the x axis."""
    g = torch.Generator().manual_seed(seed)
    goal = torch.tensor(goal, dtype=torch.float64)
    u = torch.rand(count, 3, generator=g, dtype=torch.float64)
    turn = (torch.arange(count) + 0.5) / count * arc - arc / 2
    high = low + (high - low) * u[:, 1]
    way = torch.stack([turn.cos() * high.cos(), turn.sin() * high.cos(), high.sin()], -1)
    return frames_at([looking_at(goal + (2 + r) * w, goal) for r, w in zip(u[:, 0], way)]), goal


@given(seed=st.integers(0, 1000), count=st.integers(1, 50), spread=st.sampled_from(SPREADS))
@settings(max_examples=30, deadline=None)
def test_an_orbit_looks_at_the_centre_from_the_photos_distance(seed, count, spread):
    frames, goal = photos(seed)
    poses = torch.stack(orbit(frames, UP, count, spread))
    ways = poses[:, :3, 3] - goal
    distance = ways.norm(dim=1)
    assert torch.allclose(-ways / distance[:, None], poses[:, :3, 2], atol=1e-3)
    theirs = (centres(frames) - goal).norm(dim=1)
    assert (distance > theirs.min() - 1e-3).all() and (distance < theirs.max() + 1e-3).all()
    assert poses[:, 2, 0].abs().max() < 1e-9 and (poses[:, 2, 1] < 0).all()  # level, and not upside down
    assert torch.allclose(torch.linalg.det(poses[:, :3, :3]), torch.ones(count, dtype=torch.float64))


def test_an_orbit_of_a_ring_is_the_ring():
    poses = torch.stack(orbit(frames_at(ring(24)), UP, 24))
    assert torch.allclose(poses, torch.stack(ring(24)), atol=1e-5)


def test_an_orbit_ends_where_it_began_and_goes_all_the_way_round():
    frames, goal = photos(3)
    at = torch.stack(orbit(frames, UP, 60))[:, :3, 3]
    steps = (at.roll(-1, 0) - at).norm(dim=1)
    assert steps.max() < 2 * steps.median()
    turn = torch.atan2(*(at - goal)[:, [1, 0]].T).sort().values.diff()
    assert turn.max() < 0.2


def test_an_orbit_does_not_go_where_no_photo_was_taken():
    frames, goal = photos(5, arc=2.0)
    ways = torch.stack(orbit(frames, UP, 40))[:, :3, 3] - goal
    turn = torch.atan2(ways[:, 1], ways[:, 0])
    assert turn.abs().max() < 1.001 and turn.min() < -0.9 and turn.max() > 0.9
    assert (turn[0] - turn[-1]).abs() < 0.2


def test_a_narrow_orbit_keeps_to_the_photographers_places():
    """Photos from near on one side and from far on the other."""
    goal = torch.zeros(3, dtype=torch.float64)
    near = torch.arange(72, dtype=torch.float64) * (torch.pi / 36)
    eyes = [(1 + 4 * (a.cos() > 0)) * torch.stack([a.cos(), a.sin(), 0.2 + 0 * a]) for a in near]
    frames = frames_at([looking_at(eye, goal) for eye in eyes])

    def away(spread):
        at = torch.stack(orbit(frames, UP, 72, spread))[:, :3, 3]
        return torch.cdist(at, centres(frames)).amin(1).mean()

    assert away(5.0) < 0.3 * away(40.0)


def test_photos_that_look_around_are_followed_from_their_midst():
    g = torch.Generator().manual_seed(0)
    eyes = 0.3 * torch.randn(30, 3, generator=g, dtype=torch.float64)
    turn = torch.arange(30) * (2 * torch.pi / 30)
    ways = torch.stack([turn.cos(), turn.sin(), 0 * turn], -1).double()
    frames = frames_at([looking_at(eye, eye + way) for eye, way in zip(eyes, ways)])
    poses = torch.stack(orbit(frames, UP, 30))
    assert poses[:, :3, 3].norm(dim=1).max() < eyes.norm(dim=1).max()
    assert poses[:, 2, 2].abs().max() < 1e-6 and torch.atan2(poses[:, 1, 2], poses[:, 0, 2]).unique().numel() == 30


def random_keyframes(seed, count):
    g = torch.Generator().manual_seed(seed)
    return frames_at(exp(torch.randn(count, 6, generator=g, dtype=torch.float64)))


@given(seed=st.integers(0, 1000), number=st.integers(1, 9), more=st.integers(0, 60))
@settings(max_examples=30, deadline=None)
def test_a_path_passes_through_its_keyframes(seed, number, more):
    keyframes = random_keyframes(seed, number)
    count = 3 * number + 60 + more
    path = smooth_path(keyframes, count)
    assert len(path) == count
    poses = torch.stack([pose for _, pose in path])
    found = [(poses - key.world_from_cam).abs().amax((1, 2)).argmin() for key in keyframes]
    assert all(torch.equal(poses[n], key.world_from_cam) for n, key in zip(found, keyframes))
    if number > 1:
        assert found == sorted(found) and found[0] == 0 and found[-1] == count - 1


def test_a_path_is_smooth_and_of_an_even_pace():
    poses = torch.stack([pose for _, pose in smooth_path(random_keyframes(1, 6), 6000)])
    assert torch.allclose(poses[:, :3, :3] @ poses[:, :3, :3].mT, torch.eye(3).double(), atol=1e-9)
    steps = poses[1:, :3, 3] - poses[:-1, :3, 3]
    turns = angle_between(poses[:-1], poses[1:])
    bends = torch.nn.functional.cosine_similarity(steps[1:], steps[:-1])
    assert bends.min() > 0.99, "a corner"
    size = float((centres(random_keyframes(1, 6)).amax(0) - centres(random_keyframes(1, 6)).amin(0)).max())
    pace = steps.norm(dim=1) / size + turns.deg2rad()
    assert pace.max() < 1.2 * pace.min()


def test_two_keyframes_are_joined_straight():
    a, b = frames_at([torch.eye(4, dtype=torch.float64), exp(torch.tensor([3.0, 0, 0, 0, 0, 0], dtype=torch.float64))])
    at = torch.stack([pose[:3, 3] for _, pose in smooth_path([a, b, b], 31)])
    assert torch.allclose(at[:, 0], torch.linspace(0, 3, 31).double()) and at[:, 1:].abs().max() < 1e-12


def test_lenses_go_over_into_each_other():
    a, b = random_keyframes(2, 2)
    b = replace(b, camera=Camera(64, 48, 120.0, 122.0, 33.0, 24.0, k1=0.1))
    cameras = [camera for camera, _ in smooth_path([a, b], 11)]
    assert cameras[0] == CAMERA and {(c.width, c.height) for c in cameras} == {(32, 24)}
    assert (cameras[-1].fx, cameras[-1].fy, cameras[-1].cx, cameras[-1].k1) == pytest.approx((60.0, 61.0, 16.5, 0.1))
    assert [c.fx for c in cameras] == sorted((c.fx for c in cameras), reverse=CAMERA.fx > 60)


def way(frames):
    return float(centres(frames).diff(dim=0).norm(dim=1).sum())


def test_a_tour_is_short_whatever_the_photos_are_called():
    known = frames_at(ring(40))
    mixed = [known[i] for i in torch.randperm(40, generator=torch.Generator().manual_seed(0))]
    for given_order in (known, mixed):
        found = tour(given_order)
        assert {f.name for f in found} <= {f.name for f in known} and len({f.name for f in found}) == len(found)
        assert 12 < len(found) <= 25 and way(found) < 1.05 * way(known)
    assert [f.name for f in tour(known[:5])] == [f.name for f in known[:5]], "a good order is kept"
    assert len(tour(known[:1])) == 1


def test_the_typical_camera_is_that_of_most():
    frames = [replace(f, camera=replace(CAMERA, k1=0.2)) for f in frames_at(ring(6))]
    frames += [replace(f, camera=CAMERA.scaled(100, 200)) for f in frames_at(ring(3))]
    assert typical_camera(frames) == replace(CAMERA, cx=CAMERA.width / 2, cy=CAMERA.height / 2)
