"""project ∘ unproject is the identity on pixels, with distortion; the conventions are pinned."""

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.pose import exp

FOX = Camera(270, 480, 343.88, 343.62, 138.64, 241.32, 0.0578, -0.0805, -0.00098, 0.000156)
lens = st.builds(
    lambda k1, k2, p1, p2, k3: Camera(160, 120, 150.0, 155.0, 78.0, 61.0, k1, k2, p1, p2, k3),
    st.floats(-0.15, 0.15),
    st.floats(-0.05, 0.05),
    st.floats(-5e-3, 5e-3),
    st.floats(-5e-3, 5e-3),
    st.floats(-0.01, 0.01),
)


@settings(deadline=None, max_examples=25)
@given(lens, st.floats(0.2, 20))
def test_project_undoes_unproject(camera, distance):
    pixels = camera.pixel_centres()[::7]
    directions = camera.unproject(pixels)
    assert torch.allclose(directions.norm(dim=-1), torch.ones(len(pixels), dtype=torch.float64))
    back, z = camera.project(directions * distance)
    assert (back - pixels).abs().max() < 1e-6
    assert (z > 0).all()


def test_distortion_is_opencvs():
    cv2 = pytest.importorskip("cv2")
    points = np.random.default_rng(0).normal(size=(50, 3)) * [0.3, 0.5, 0.1] + [0, 0, 2]
    matrix = np.array([[FOX.fx, 0, FOX.cx], [0, FOX.fy, FOX.cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), matrix, np.array([FOX.k1, FOX.k2, FOX.p1, FOX.p2, FOX.k3])
    )
    found, _ = FOX.project(torch.from_numpy(points))
    assert np.abs(found.numpy() - expected[:, 0]).max() < 1e-9


def test_pixel_centres_are_at_one_half_and_row_by_row():
    camera = Camera(3, 2, 1.0, 1.0, 1.5, 1.0)
    assert camera.pixel_centres()[:4].tolist() == [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [0.5, 1.5]]
    axis = camera.unproject(torch.tensor([1.5, 1.0], dtype=torch.float64))
    assert axis.tolist() == [0.0, 0.0, 1.0]  # the principal point looks along +z
    down = camera.unproject(torch.tensor([1.5, 2.0], dtype=torch.float64))
    assert down[1] > 0  # +y is down


def test_scaled_camera_sees_the_same_rays():
    half = FOX.scaled(135, 240)
    rays = half.unproject(half.pixel_centres())
    assert torch.allclose(rays, FOX.unproject(half.pixel_centres() * 2), atol=1e-9)


def test_what_is_behind_has_negative_depth():
    _, z = FOX.project(torch.tensor([0.1, 0.2, -2.0]))
    assert z < 0


def test_rays_pass_through_projected_points(tmp_path):
    pose = exp(torch.tensor([0.3, -0.2, 1.0, 0.2, 0.5, -0.4], dtype=torch.float64))
    rays = camera_rays(FOX, pose)
    points = rays.origins + 2.5 * rays.directions
    seen, _ = FOX.project((points.double() - pose[:3, 3]) @ pose[:3, :3])
    assert (seen - FOX.pixel_centres()).abs().max() < 1e-3


@given(st.integers(0, 60), st.integers(0, 12))
def test_train_and_held_out_share_nothing_and_lose_nothing(count, every):
    frames = tuple(Frame(f"{i}.png", FOX, f"{i}", torch.eye(4)) for i in range(count))
    capture = Capture(frames, held_out_every=every)
    names = {f.name for f in capture.train}, {f.name for f in capture.held_out}
    assert not names[0] & names[1]
    assert len(names[0] | names[1]) == count
    assert every == 0 or len(names[1]) <= count / max(every, 1) + 1
