"""Photos are read at the size that pays: which it is, what is read, what comes back."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from refield.field.fit import FitConfig, fit_capture
from refield.field.memory import memory_of
from refield.field.photo_size import PhotoSizeConfig, as_read, sizes_that_pay, sizes_told
from refield.field.photos import UNCHANGED, Photos, Since
from refield.field.pixels import PixelBank
from refield.field.radiance import HashFieldConfig
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.errors import InputError
from refield.scene.images import frame_image, write_image

HALF = PhotoSizeConfig(part=0.5)
LARGE = 12_000_000


def _capture(folder, shapes=((24, 16), (16, 24)), count=12) -> Capture:
    """Photos of noise, of (width, height) by turns, on an arc."""
    g = torch.Generator().manual_seed(0)
    frames = []
    for i in range(count):
        width, height = shapes[i % len(shapes)]
        camera = Camera(width, height, 30.0, 30.0, width / 2, height / 2, k1=0.01)
        pose = torch.eye(4, dtype=torch.float64)
        angle = torch.tensor(0.1 * i, dtype=torch.float64)
        pose[0, 0] = pose[2, 2] = angle.cos()
        pose[0, 2], pose[2, 0] = -angle.sin(), angle.sin()
        pose[:3, 3] = 3 * torch.stack([angle.sin(), 0 * angle, -angle.cos()])
        path = folder / f"{i}.png"
        write_image(path, torch.rand(height, width, 3, generator=g))
        frames.append(Frame(path, camera, path.name, pose))
    return Capture(tuple(frames))


@pytest.fixture
def capture(tmp_path) -> Capture:
    return _capture(tmp_path)


def test_photos_are_halved_until_all_fit_the_budget():
    assert sizes_that_pay([LARGE] * 10, 2e8) == [1.0] * 10
    assert sizes_that_pay([LARGE] * 60, 2e8) == [0.5] * 60
    assert sizes_that_pay([LARGE] * 100, 2e8) == [0.25] * 100
    for count in (3, 30, 300):
        parts = sizes_that_pay([LARGE] * count, 1e8)
        assert sum(LARGE * p * p for p in parts) <= 1e8 and len(set(parts)) == 1


def test_the_largest_are_halved_first_and_small_ones_never():
    parts = sizes_that_pay([48_000_000] * 4 + [2_000_000] * 20, 1e8)
    assert parts == [0.5] * 4 + [1.0] * 20
    assert sizes_that_pay([200_000] * 50, 1e5) == [1.0] * 50
    assert sizes_that_pay([], 1e5) == []


def test_a_photo_of_half_the_size_has_the_means_of_its_pixels_and_their_rays(capture: Capture):
    whole, half = capture.frames[0], as_read(capture, UNCHANGED, HALF)[0].frames[0]
    assert (half.camera.width, half.camera.height) == (12, 8)
    means = frame_image(whole).float().reshape(8, 2, 12, 2, 3).mean((1, 3))
    assert (frame_image(half).float() - means).abs().max() <= 0.5
    fine, coarse = PixelBank([whole]), PixelBank([half])
    among = fine.rays(torch.arange(len(fine))).directions.reshape(8, 2, 12, 2, 3).mean((1, 3)).reshape(-1, 3)
    torch.testing.assert_close(
        coarse.rays(torch.arange(len(coarse))).directions,
        torch.nn.functional.normalize(among, dim=-1),
        atol=2e-4,
        rtol=0,
    )
    assert half.whole().camera == whole.camera and half.whole().file_size is None


def test_a_file_that_is_not_as_large_as_it_was_is_refused(capture: Capture):
    half = capture.frames[0].shrunk(0.5)
    write_image(half.path, torch.zeros(8, 12, 3))
    with pytest.raises(InputError, match="12x8 pixels"):
        frame_image(half)


def test_a_pixel_of_which_a_part_is_out_of_date_does_not_teach(capture: Capture):
    first, second = capture.train[:2]
    valid: dict[str, Tensor] = {first.name: torch.ones(16, 24, dtype=torch.bool)}
    valid[first.name][3, 5] = False
    carried = replace(first, name="carried")
    valid["carried"] = valid[first.name]
    small, since = as_read(capture, Since((second,), valid, (carried,), share=0.5), HALF)
    mask = since.valid[first.name]
    assert mask.shape == (8, 12) and not mask[1, 2] and int(mask.sum()) == 8 * 12 - 1
    assert since.frames[0].camera.width == second.camera.width // 2
    assert since.carried[0].camera == small.frames[0].camera and since.share == 0.5
    assert torch.equal(since.valid["carried"], mask)
    assert len(Photos.of(small, since).bank()) == 96 * (len(capture.train) + 2) - 2


def test_a_fit_of_small_photos_hands_the_capture_back_at_full_size(capture: Capture):
    shape = HashFieldConfig(levels=4, finest=64, log2_table=12)
    config = FitConfig(steps=4, samples=1024, field=shape, size=HALF)
    fitted = fit_capture(capture, config)
    for before, after in zip(capture.frames, fitted.capture.frames):
        assert after.file_size is None and after.camera == before.camera
    assert memory_of(capture, config).photos == memory_of(capture, replace(config, size=PhotoSizeConfig())).photos / 4


def test_it_is_said_at_which_size_photos_are_read(capture: Capture):
    assert sizes_told(capture, PhotoSizeConfig()) is None
    assert sizes_told(capture, HALF) == "photos are read at a half of their size (12 x 8, 8 x 12)"
    assert "at 0.3 of their size" in (sizes_told(capture, PhotoSizeConfig(part=0.3)) or "")
    large = [replace(f, camera=f.camera.scaled(4032, 3024)) for f in capture.frames[:4]]
    mixed = replace(capture, frames=(*large, *capture.frames[4:]))
    told = sizes_told(mixed, PhotoSizeConfig(pixels=2e7))
    assert told == "4 of 12 photos are read at a half of their size (2016 x 1512)"
    with pytest.raises(InputError, match="cannot be 2 of"):
        PhotoSizeConfig(part=2.0)
