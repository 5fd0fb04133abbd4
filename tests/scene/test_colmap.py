"""A COLMAP model, text and binary, gives the same rays back."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from refield.scene.capture import Capture, camera_rays
from refield.scene.colmap import PARAMETERS, load_colmap, save_colmap
from refield.scene.errors import InputError
from refield.scene.load import load_capture, load_new_photos
from tests.captures import CAMERA, DISTORTED, write_capture
from tests.conftest import HERE

pycolmap = pytest.importorskip("pycolmap")


def capture_with_points(folder, camera=CAMERA, count=5) -> Capture:
    capture = replace(write_capture(folder, count, camera), points=torch.randn(30, 3))
    (folder / "transforms.json").unlink()
    return capture


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("place", ["sparse/0", "colmap/sparse/0", "sparse", "."])
@pytest.mark.parametrize("camera", [CAMERA, DISTORTED])
def test_round_trip_keeps_every_ray(tmp_path, text, place, camera):
    capture = capture_with_points(tmp_path, camera)
    save_colmap(tmp_path / place, capture, text=text)
    back = load_capture(tmp_path)
    assert torch.allclose(back.points, capture.points, atol=1e-6)
    assert len(back.frames) == len(capture.frames)
    for a, b in zip(capture.frames, back.frames):
        assert a.path.resolve() == b.path and a.camera == b.camera
        ours, theirs = camera_rays(a.camera, a.world_from_cam), camera_rays(b.camera, b.world_from_cam)
        assert torch.allclose(ours.origins, theirs.origins, atol=1e-6)
        assert torch.allclose(ours.directions, theirs.directions, atol=1e-6)


def one_camera_model(folder, model, params):
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=32, height=24, params=params, camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    pose = pycolmap.Rigid3d(np.eye(3, 4))
    reconstruction.add_image_with_trivial_frame(pycolmap.Image(name="000.png", camera_id=1, image_id=1), pose)
    folder.mkdir(parents=True, exist_ok=True)
    reconstruction.write(str(folder))


VALUES = {"f": 40, "fx": 40, "fy": 42, "cx": 15, "cy": 11, "k1": 0.1, "k2": -0.05, "p1": 1e-3, "p2": 2e-3}


@pytest.mark.parametrize("model", PARAMETERS)
def test_models_project_as_colmap_does(tmp_path, model):
    capture_with_points(tmp_path)
    params = [VALUES[key] for key in PARAMETERS[model]]
    one_camera_model(tmp_path / "sparse" / "0", model, params)
    (frame,) = load_colmap(tmp_path).frames
    theirs = pycolmap.Camera(model=model, width=32, height=24, params=params)
    points = np.random.default_rng(0).normal(size=(20, 3)) * [0.2, 0.2, 0.1] + [0, 0, 1]
    ours, _ = frame.camera.project(torch.from_numpy(points))
    expected = np.array([theirs.img_from_cam(p) for p in points]).reshape(-1, 2)
    assert np.abs(ours.numpy() - expected).max() < 1e-9


def test_the_largest_model_is_used_and_said(tmp_path):
    capture = capture_with_points(tmp_path)
    save_colmap(tmp_path / "sparse" / "0", replace(capture, frames=capture.frames[:2]))
    save_colmap(tmp_path / "sparse" / "1", capture)
    said = []
    assert len(load_colmap(tmp_path, warn=said.append).frames) == 5
    assert "0: 2, 1: 5" in said[0] and "1 is used" in said[0]


def test_unsupported_cameras_are_refused_by_name(tmp_path):
    capture_with_points(tmp_path)
    one_camera_model(tmp_path / "sparse" / "0", "OPENCV_FISHEYE", [40, 40, 16, 12, 0, 0, 0, 0])
    with pytest.raises(InputError, match="OPENCV_FISHEYE is not supported; undistort"):
        load_colmap(tmp_path)


def test_scaled_images_and_missing_ones_are_announced(tmp_path):
    capture = capture_with_points(tmp_path)
    big = tuple(replace(f, camera=f.camera.scaled(64, 48)) for f in capture.frames)
    save_colmap(tmp_path / "sparse" / "0", replace(capture, frames=big))
    (tmp_path / "images" / "001.png").unlink()
    said = []
    back = load_colmap(tmp_path, warn=said.append)
    assert len(back.frames) == 4 and back.frames[0].camera == CAMERA
    assert any("001.png" in s for s in said) and any("32x24" in s for s in said)


def test_a_name_that_leads_out_is_refused(tmp_path):
    capture_with_points(tmp_path)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=32, height=24, params=[40, 40, 16, 12], camera_id=1)
    )
    image = pycolmap.Image(name="../../etc/passwd", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.eye(3, 4)))
    (tmp_path / "sparse").mkdir()
    model.write(str(tmp_path / "sparse"))
    with pytest.raises(InputError, match=r"passwd.*leads out"):
        load_colmap(tmp_path)


@pytest.mark.parametrize("text", [True, False])
def test_a_damaged_model_is_named(tmp_path, text):
    save_colmap(tmp_path / "sparse" / "0", capture_with_points(tmp_path), text=text)
    for path in (tmp_path / "sparse" / "0").iterdir():
        path.write_bytes(b"1 broken\n" * 3)
    with pytest.raises(InputError, match="not a readable COLMAP model"):
        load_colmap(tmp_path)
    with pytest.raises(InputError, match="no COLMAP model"):
        load_colmap(tmp_path / "images")


_TERMINATED = """
import os, signal, sys
from pathlib import Path
signal.signal(signal.SIGTERM, lambda *a: sys.exit(77))
from refield.scene.colmap import load_colmap
load_colmap(Path(sys.argv[1]))
os.kill(os.getpid(), signal.SIGTERM)
"""


def test_pycolmap_does_not_take_our_signals(tmp_path):
    """Its import installs a handler of SIGTERM that prints a stack trace and kills."""
    save_colmap(tmp_path / "sparse" / "0", capture_with_points(tmp_path))
    done = subprocess.run([sys.executable, "-c", _TERMINATED, str(tmp_path)], env=HERE, stderr=subprocess.DEVNULL)
    assert done.returncode == 77


def test_new_photos_as_a_model_are_told_what_is_read(tmp_path):
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "cameras.txt").touch()
    (tmp_path / "sparse" / "0" / "images.txt").touch()
    (tmp_path / "sparse" / "0" / "points3D.txt").touch()
    with pytest.raises(InputError, match=r"COLMAP model, which is read for first photos only; give a transforms\.json"):
        load_new_photos(tmp_path, Capture(()))
