"""Disturbed photos are off by what was asked for, and by nothing else."""

import numpy as np
import pytest
import torch

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.errors import InputError
from refield.scene.images import frame_image, write_image
from refield.scene.pose import angle_between, invert
from refield.scene.srgb import to_linear
from refield.scene.transforms_json import load_transforms, save_transforms
from refield.synthetic.cameras import ring, square_camera
from refield.synthetic.disturb import Disturbance, displacement, disturbed, disturbed_photo, disturbed_pose, gains

TARGET = (0.0, 0.0, 0.15)
DISTANCE = 2.1
GREY = torch.full((120, 120, 3), 128, dtype=torch.uint8)


@pytest.fixture()
def folder(tmp_path):
    """A capture of four photos with what a written world has beside them."""
    rng, frames = np.random.default_rng(0), []
    here = tmp_path / "after"
    (here / "images").mkdir(parents=True)
    for i, pose in enumerate(ring(TARGET)[::2]):
        path = here / "images" / f"{i:04d}.png"
        write_image(path, torch.from_numpy(rng.integers(0, 255, (32, 32, 3), dtype=np.uint8)))
        frames.append(Frame(path, square_camera(32), f"images/{path.name}", pose))
    save_transforms(here, Capture(tuple(frames)))
    (here / "masks_in").mkdir()
    write_image(here / "masks_in" / "0000.png", torch.ones(32, 32, dtype=torch.bool))
    return here


def frame(camera, i=1):
    return Frame(None, camera, f"images/{i:04d}.png", ring(TARGET)[i])


def test_no_disturbance_changes_nothing(folder, tmp_path):
    disturbed(folder, tmp_path / "out", Disturbance())
    then, now = load_transforms(folder), load_transforms(tmp_path / "out")
    assert [f.name for f in now.frames] == [f.name for f in then.frames]
    for a, b in zip(then.frames, now.frames):
        assert torch.equal(frame_image(a), frame_image(b)) and a.camera == b.camera
        assert torch.allclose(a.world_from_cam, b.world_from_cam, rtol=0, atol=1e-14)


def test_what_lies_beside_the_photos_is_copied_and_nothing_else_written(folder, tmp_path):
    disturbed(folder, tmp_path / "out", Disturbance(exposure=0.5, pose_px=1.0))
    names = [sorted(p.relative_to(at).as_posix() for p in at.rglob("*")) for at in (folder, tmp_path / "out")]
    assert names[0] == names[1]
    mask = "masks_in/0000.png"
    assert (folder / mask).read_bytes() == (tmp_path / "out" / mask).read_bytes()


def test_a_seed_is_one_disturbance_and_another_another(folder, tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        disturbed(folder, tmp_path / name, Disturbance(0.4, 0.05, 0.02, 0.6, 1.0, 90, seed))
    a, b, c = (load_transforms(tmp_path / name) for name in "abc")
    for x, y, z in zip(a.frames, b.frames, c.frames):
        assert torch.equal(frame_image(x), frame_image(y)) and torch.equal(x.world_from_cam, y.world_from_cam)
        assert not torch.equal(frame_image(x), frame_image(z))
        assert not torch.allclose(x.world_from_cam, z.world_from_cam)


def test_a_written_pose_is_off_by_as_many_pixels_as_asked(folder, tmp_path):
    disturbed(folder, tmp_path / "out", Disturbance(pose_px=1.5), TARGET)
    then, now = load_transforms(folder), load_transforms(tmp_path / "out")
    for a, b in zip(then.frames, now.frames):
        off = displacement(a.camera, invert(a.world_from_cam) @ b.world_from_cam, DISTANCE)
        assert off == pytest.approx(1.5, rel=1e-8)
        assert torch.equal(frame_image(a), frame_image(b))


@pytest.mark.parametrize("pixels", [0.01, 1.0, 5.0, 20.0])
def test_a_pose_error_is_exact_for_any_size_and_lens(pixels):
    lens = Camera(160, 90, 130.0, 128.0, 83.0, 44.0, k1=-0.12, k2=0.02, p1=0.001)
    for i in range(4):
        true = frame(lens, i)
        wrong = disturbed_pose(true, Disturbance(pose_px=pixels, seed=i), DISTANCE)
        assert displacement(lens, invert(true.world_from_cam) @ wrong, DISTANCE) == pytest.approx(pixels, rel=1e-8)
        assert angle_between(true.world_from_cam, wrong) > 0 and (wrong - true.world_from_cam)[:3, 3].norm() > 0
        assert torch.allclose(wrong[:3, :3] @ wrong[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-12)


def test_the_displacement_of_a_small_turn_is_the_focal_length_times_the_angle():
    from refield.scene.pose import exp

    camera = Camera(64, 64, 4000.0, 4000.0, 32.0, 32.0)  # so long that the picture is flat
    turn = exp(torch.tensor([0, 0, 0, 0, 1e-4, 0], dtype=torch.float64))
    assert displacement(camera, turn, 3.0) == pytest.approx(0.4, rel=1e-3)
    shift = exp(torch.tensor([1e-3, 0, 0, 0, 0, 0], dtype=torch.float64))
    assert displacement(camera, shift, 2.0) == pytest.approx(2.0, rel=1e-3)


def test_an_impossible_pose_error_is_refused():
    with pytest.raises(ValueError, match="pixels off"):
        disturbed_pose(frame(square_camera(32)), Disturbance(pose_px=1e9), DISTANCE)


def test_the_exposure_can_be_read_back_from_the_photo():
    asked = Disturbance(exposure=0.7, white_balance=0.1, seed=2)
    for name in ("a", "b", "c"):
        photo = disturbed_photo(GREY // 2, asked, name)
        ratio = to_linear(photo.numpy() / np.float32(255)) / to_linear((GREY // 2).numpy() / np.float32(255))
        assert np.allclose(ratio.mean((0, 1)), gains(asked, name), rtol=0.02)


def test_gains_have_the_spread_asked_for():
    drawn = np.stack([gains(Disturbance(exposure=0.5, white_balance=0.06), f"{i}") for i in range(2000)])
    stops = np.log2(drawn).mean(1)
    assert stops.std() == pytest.approx(0.5, rel=0.06) and abs(stops.mean()) < 0.05
    cast = np.log(drawn) - np.log(drawn).mean(1, keepdims=True)
    assert cast.std() == pytest.approx(0.06 * (2 / 3) ** 0.5, rel=0.06)


def test_what_is_too_bright_is_clipped():
    asked, bright = Disturbance(exposure=3.0), torch.full((4, 4, 3), 250, dtype=torch.uint8)
    name = next(n for n in "abcdefgh" if gains(asked, n).min() > 1.5)
    assert (disturbed_photo(bright, asked, name) == 255).all()


def test_noise_has_the_strength_asked_for_at_mid_grey_and_more_light_brings_more():
    noisy = disturbed_photo(GREY, Disturbance(noise=0.03), "a").double() / 255
    assert float(noisy.std()) == pytest.approx(0.03, rel=0.05)
    light = [to_linear((disturbed_photo(p, Disturbance(noise=0.03), "a") / 255).numpy()) for p in (GREY // 2, GREY)]
    assert light[1].std() > 1.3 * light[0].std()


def test_blur_spreads_an_edge_by_as_many_pixels():
    step = torch.zeros(32, 64, 3, dtype=torch.uint8)
    step[:, 32:] = 255
    row = to_linear(disturbed_photo(step, Disturbance(blur=2.0), "a").numpy()[16, :, 0] / np.float32(255))
    weight, at = np.diff(row.astype(float)), np.arange(63) - 31
    assert (weight * at**2).sum() ** 0.5 == pytest.approx(2.0, rel=0.1)


def test_jpeg_costs_what_its_quality_says():
    rng = np.random.default_rng(0)
    photo = torch.from_numpy(rng.integers(0, 255, (64, 64, 3), dtype=np.uint8))
    off = [(disturbed_photo(photo, Disturbance(jpeg=q), "a").double() - photo).abs().mean() for q in (95, 30)]
    assert 0 < off[0] < off[1]


def test_one_effect_leaves_the_others_as_they_were():
    a, b = Disturbance(exposure=0.5), Disturbance(exposure=0.5, noise=0.01, pose_px=2.0)
    assert np.array_equal(gains(a, "x"), gains(b, "x"))
    poses = [disturbed_pose(frame(square_camera(32)), d, DISTANCE) for d in (b, Disturbance(pose_px=2.0))]
    assert torch.equal(*poses)


def test_bad_requests_are_refused(folder, tmp_path):
    with pytest.raises(InputError, match="blur"):
        Disturbance(blur=-1)
    with pytest.raises(InputError, match="quality"):
        Disturbance(jpeg=0)
    with pytest.raises(InputError, match="already"):
        disturbed(folder, folder, Disturbance())
    with pytest.raises(InputError, match="in the capture"):
        disturbed(folder, folder / "images" / "x", Disturbance())
