"""nerfstudio's and instant-ngp's dialects in, the same rays out; every refusal names its frame and key."""

import json
import math
import shutil

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from PIL import Image

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.errors import InputError
from refield.scene.images import write_image
from refield.scene.load import load_capture, load_new_photos
from refield.scene.pose import exp
from refield.scene.transforms_json import load_cameras, load_photos, load_transforms, save_transforms, stem
from tests.captures import CAMERA, DISTORTED, write_capture


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_capture(folder, 12)
    return folder


@pytest.fixture
def data(original, tmp_path):
    """A capture's folder and the contents of its transforms.json, to be spoilt."""
    folder = tmp_path / "data"
    shutil.copytree(original, folder)
    return folder, json.loads((folder / "transforms.json").read_text())


def put(folder, contents):
    (folder / "transforms.json").write_text(json.dumps(contents))
    return folder


def same_rays(a: Frame, b: Frame) -> bool:
    ours, theirs = camera_rays(a.camera, a.world_from_cam), camera_rays(b.camera, b.world_from_cam)
    return torch.allclose(ours.origins, theirs.origins, atol=1e-6) and torch.allclose(
        ours.directions, theirs.directions, atol=1e-6
    )


focal = st.floats(20, 100)
small = st.floats(-0.05, 0.05)
cameras = st.builds(Camera, st.just(8), st.just(6), focal, focal, small, small, small, small, small, small)
poses = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(lambda v: exp(torch.tensor(v, dtype=torch.float64)))


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(cameras, poses), min_size=1, max_size=4), st.booleans())
def test_round_trip_keeps_every_ray(tmp_path, views, one_camera):
    frames = []
    for i, (camera, pose) in enumerate(views):
        path = tmp_path / "images" / f"{i}.png"
        if not path.exists():
            write_image(path, torch.zeros(6, 8, 3))
        frames.append(Frame(path, views[0][0] if one_camera else camera, f"images/{i}.png", pose))
    capture = Capture(tuple(frames), points=torch.randn(5, 3))
    save_transforms(tmp_path, capture)
    back = load_transforms(tmp_path)
    assert [f.name for f in back.frames] == [f.name for f in frames]
    assert torch.equal(back.points, capture.points)
    for a, b in zip(capture.frames, back.frames):
        assert a.camera == b.camera
        assert torch.allclose(a.world_from_cam, b.world_from_cam, atol=1e-12)
    assert same_rays(capture.frames[0], back.frames[0])


def test_opengl_axes(data):
    """A camera with the identity matrix looks along the world's -z, with +y up."""
    folder, contents = data
    contents["frames"] = contents["frames"][:1]
    contents["frames"][0]["transform_matrix"] = torch.eye(4).tolist()
    (frame,) = load_transforms(put(folder, contents)).frames
    rays = camera_rays(frame.camera, frame.world_from_cam, torch.tensor([[16.0, 12.0], [16.0, 0.0], [32.0, 12.0]]))
    assert torch.allclose(rays.directions[0], torch.tensor([0.0, 0.0, -1.0]), atol=1e-7)
    assert rays.directions[1][1] > 0 and rays.directions[2][0] > 0


def test_intrinsics_per_frame_win_over_shared(data):
    folder, contents = data
    contents["frames"][3] |= {"fl_x": 77.0, "k1": 0.01}
    frames = load_transforms(put(folder, contents)).frames
    assert (frames[3].camera.fx, frames[3].camera.k1, frames[3].camera.model) == (77.0, 0.01, "OPENCV")
    assert frames[2].camera == CAMERA


def test_instant_ngp_dialect(data):
    """Field of view, no centre, no size, a leading ./, no suffix, and names without their folder."""
    folder, contents = data
    frames = contents["frames"][:3]
    names = ["./images/000", "./images/001.png", "002.png"]
    frames = [{"file_path": n, "transform_matrix": f["transform_matrix"][:3]} for n, f in zip(names, frames)]
    angle = 2 * math.atan(16 / 40)
    put(folder, {"camera_angle_x": angle, "aabb_scale": 4, "frames": frames})
    got = load_transforms(folder / "transforms.json").frames
    assert [f.path.name for f in got] == ["000.png", "001.png", "002.png"]
    assert all(f.camera.fx == pytest.approx(40) and f.camera.fy == pytest.approx(40) for f in got)
    assert (got[0].camera.cx, got[0].camera.cy, got[0].camera.width) == (16, 12, 32)
    put(folder, {"camera_angle_y": 2 * math.atan(12 / 50), "frames": frames})
    assert load_transforms(folder).frames[0].camera.fy == pytest.approx(50)


def test_distortion_is_kept(data, tmp_path):
    write_capture(tmp_path / "d", 2, DISTORTED)
    assert load_transforms(tmp_path / "d").frames[0].camera == DISTORTED


def test_scaled_images_scale_the_intrinsics_and_are_announced(data):
    folder, contents = data
    put(folder, contents | {"w": 64, "h": 48, "fl_x": 80.0, "fl_y": 80.0, "cx": 32.0, "cy": 24.0})
    said = []
    assert load_transforms(folder, warn=said.append).frames[0].camera == CAMERA
    assert "64x48" in said[0] and "32x24" in said[0]


def test_missing_double_and_unreadable_images_are_reported(data):
    folder, contents = data
    (folder / "images" / "003.png").unlink()
    (folder / "images" / "005.png").write_bytes(b"broken")
    contents["frames"].append(dict(contents["frames"][0], file_path="./images/000.png"))
    said = []
    capture = load_transforms(put(folder, contents), warn=said.append)
    names = [f.name for f in capture.frames]
    assert len(names) == 10 and "images/003.png" not in names and "images/005.png" not in names
    text = "\n".join(said)
    assert "listed twice" in text and "images/000.png" in text
    assert "1 of 12 images are missing" in text and "images/003.png" in text
    assert "unreadable" in text and "images/005.png" in text


def test_warnings_reach_stderr_by_default(data, caplog):
    folder, _ = data
    (folder / "images" / "003.png").unlink()
    load_capture(folder)
    assert "images/003.png" in caplog.text


def matrix(contents, rows):
    contents["frames"][4]["transform_matrix"] = rows


def scaled(rows, factor):
    return [[v * factor for v in row[:3]] + row[3:] for row in rows[:3]] + rows[3:]


def mirrored(rows):
    return [[-row[0], *row[1:]] for row in rows[:3]] + rows[3:]


def spoil(change):
    def apply(contents):
        change(contents, contents["frames"][4])

    return apply


REFUSED = {
    "no frames": (spoil(lambda c, f: c.pop("frames")), "frames"),
    "empty frames": (spoil(lambda c, f: c.update(frames=[])), "frames"),
    "frame is text": (spoil(lambda c, f: c.update(frames=["a"])), r"frames\[0\]"),
    "no file_path": (spoil(lambda c, f: f.pop("file_path")), r"frames\[4\]: file_path"),
    "no matrix": (spoil(lambda c, f: f.pop("transform_matrix")), "004.*transform_matrix.*missing"),
    "matrix of text": (
        spoil(lambda c, f: f.update(transform_matrix=[["a"] * 4] * 4)),
        "004.*transform_matrix",
    ),
    "matrix 2x4": (spoil(lambda c, f: f.update(transform_matrix=[[1, 0, 0, 0]] * 2)), "4x4 or 3x4"),
    "scaled": (spoil(lambda c, f: matrix(c, scaled(f["transform_matrix"], 1.01))), "no rotation"),
    "mirrored": (spoil(lambda c, f: matrix(c, mirrored(f["transform_matrix"]))), "mirrored"),
    "last row": (spoil(lambda c, f: f["transform_matrix"][3].__setitem__(0, 1.0)), "last row"),
    "no focal": (spoil(lambda c, f: (c.pop("fl_x"), c.pop("fl_y"))), "fl_x.*no focal length"),
    "no fl_x": (spoil(lambda c, f: c.pop("fl_x")), "fl_x.*no focal length"),
    "negative focal": (spoil(lambda c, f: f.update(fl_x=-5)), "004.*fl_x"),
    "focal is text": (spoil(lambda c, f: f.update(fl_x="40")), "004.*fl_x.*not a number"),
    "focal is true": (spoil(lambda c, f: f.update(fl_x=True)), "004.*fl_x.*not a number"),
    "huge number": (spoil(lambda c, f: f.update(cx=10**400)), "004.*cx.*out of range"),
    "half a pixel": (spoil(lambda c, f: f.update(w=31.5)), "004.*: w: 31.5"),
    "fisheye": (spoil(lambda c, f: c.update(camera_model="OPENCV_FISHEYE")), "OPENCV_FISHEYE.*not supported"),
    "is_fisheye": (spoil(lambda c, f: c.update(is_fisheye=True)), "fisheye"),
    "k4": (spoil(lambda c, f: c.update(k4=0.1)), "k4.*not supported"),
    "angle": (spoil(lambda c, f: f.update(camera_angle_x=4.0)), "camera_angle_x.*radians"),
    "aspect": (spoil(lambda c, f: c.update(w=24, h=32)), "32x24 pixels but w, h say 24x32"),
    "absolute": (spoil(lambda c, f: f.update(file_path="/etc/passwd")), "frame '/etc/passwd'.*leads out"),
    "dots": (spoil(lambda c, f: f.update(file_path="../../x.png")), "frame '../../x.png'.*leads out"),
    "ply": (spoil(lambda c, f: c.update(ply_file_path="../p.ply")), "ply_file_path.*leads out"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(data, case):
    folder, contents = data
    change, says = REFUSED[case]
    change(contents)
    with pytest.raises(InputError, match=says) as caught:
        load_transforms(put(folder, contents))
    assert "transforms.json" in str(caught.value) and caught.value.remedy


def test_too_little_is_left(data):
    folder, _ = data
    for i in (1, 2):
        (folder / "images" / f"00{i}.png").write_bytes(b"broken")
    with pytest.raises(InputError, match="2 of 12 images cannot be read"):
        load_transforms(folder)
    shutil.rmtree(folder / "images")
    with pytest.raises(InputError, match="none of its 12 images exists"):
        load_transforms(folder)


def test_a_link_that_leaves_is_refused(data, tmp_path):
    folder, _ = data
    write_image(tmp_path / "secret.png", torch.zeros(24, 32, 3))
    (folder / "images" / "004.png").unlink()
    (folder / "images" / "004.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError, match=r"004.*leads out"):
        load_transforms(folder)


def test_a_nearly_exact_rotation_is_made_exact(data):
    folder, contents = data
    rows = contents["frames"][0]["transform_matrix"]
    contents["frames"][0]["transform_matrix"] = scaled(rows, 1 + 1e-4)
    r = load_transforms(put(folder, contents)).frames[0].world_from_cam[:3, :3]
    assert torch.allclose(r.T @ r, torch.eye(3, dtype=torch.float64), atol=1e-12)


def test_turned_photo_disagrees_with_its_camera(data):
    folder, _ = data
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(folder / "images" / "000.png") as image:
        image.save(folder / "images" / "000.png", exif=exif)
    with pytest.raises(InputError, match="24x32 pixels but w, h say 32x24"):
        load_transforms(folder)


def test_new_photos_must_all_be_there(data):
    folder, _ = data
    assert len(load_photos(folder)) == 12
    whole = (folder / "images" / "002.png").read_bytes()
    (folder / "images" / "002.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"002\.png"):
        load_photos(folder)
    (folder / "images" / "002.png").unlink()
    with pytest.raises(InputError, match=r"frame 'images/002.png'.*no such image"):
        load_photos(folder)


def test_cameras_need_no_images(data):
    folder, contents = data
    shutil.rmtree(folder / "images")
    frames = load_cameras(folder / "transforms.json")
    assert [stem(f) for f in frames][:2] == ["000", "001"] and frames[0].camera == CAMERA
    del contents["w"]
    with pytest.raises(InputError, match=": w: is missing"):
        load_cameras(put(folder, contents))


@pytest.mark.parametrize(
    "name, expected",
    [
        ("images/a.png", "a"),
        ("./a.b.JPG", "a.b"),
        ("r_0", "r_0"),
        ("frame.0001", "frame.0001"),
        ("x\\y.jpeg", "y"),
    ],
)
def test_stems(name, expected):
    assert stem(Frame(None, CAMERA, name, torch.eye(4))) == expected  # type: ignore[arg-type]


def test_photos_without_poses_say_what_is_needed(data, tmp_path):
    folder, _ = data
    capture = load_capture(folder)
    (folder / "transforms.json").unlink()
    with pytest.raises(InputError, match=r"12 photos but no camera poses.*transforms.json"):
        load_capture(folder)
    with pytest.raises(InputError, match=r"12 photos but no camera poses.*capture's world"):
        load_new_photos(folder, capture)
    with pytest.raises(InputError, match=r"neither transforms.json nor a COLMAP model"):
        load_capture(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        load_capture(tmp_path / "none")
