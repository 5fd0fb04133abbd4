"""One decoder: orientation, modes, limits, and what is refused."""

import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from refield.scene import images
from refield.scene.camera import Camera
from refield.scene.capture import Photo
from refield.scene.errors import InputError

RGB = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)


def save(path, array, mode=None, **options):
    image = Image.fromarray(array)
    (image if mode is None else image.convert(mode)).save(path, **options)
    return path


def test_png_round_trip(tmp_path):
    images.write_image(tmp_path / "a.png", torch.from_numpy(RGB))
    assert np.array_equal(images.read_image(tmp_path / "a.png").numpy(), RGB)
    images.write_image(tmp_path / "a.png", torch.from_numpy(RGB).float() / 255)
    assert np.array_equal(images.read_image(tmp_path / "a.png").numpy(), RGB)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_mask_round_trip(tmp_path):
    mask = torch.rand(9, 7) > 0.5
    images.write_image(tmp_path / "m.png", mask)
    assert torch.equal(images.read_mask(tmp_path / "m.png"), mask)
    save(tmp_path / "01.png", mask.numpy().astype(np.uint8))  # 0 and 1 instead of 0 and 255
    assert torch.equal(images.read_mask(tmp_path / "01.png"), mask)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = save(tmp_path / "a.png", RGB, exif=exif)
    image = images.read_image(path)
    height, width = image.shape[:2]
    assert (width, height) == images.read_size(path)
    assert (width, height) == ((12, 20) if orientation >= 5 else (20, 12))
    turned = {1: RGB, 3: RGB[::-1, ::-1], 6: np.rot90(RGB, -1), 8: np.rot90(RGB)}
    if orientation in turned:
        assert np.array_equal(image.numpy(), turned[orientation])


def test_a_png_is_decoded_for_its_size_only_where_more_may_follow_its_pixels(tmp_path, monkeypatch):
    exif = Image.Exif()
    exif[0x0112] = 6
    plain, turned = save(tmp_path / "plain.png", RGB), save(tmp_path / "turned.png", RGB, exif=exif).read_bytes()
    at = turned.index(b"eXIf") - 4
    size = int.from_bytes(turned[at : at + 4]) + 12
    rest = turned[at + size :]
    (tmp_path / "late.png").write_bytes(turned[:at] + rest[:-12] + turned[at : at + size] + rest[-12:])
    assert images.read_size(tmp_path / "late.png") == (12, 20)
    assert images.read_image(tmp_path / "late.png").shape == (20, 12, 3)
    monkeypatch.setattr(Image.Image, "load", lambda self: pytest.fail("decoded"))
    assert images.read_size(plain) == (20, 12)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "LA", "P", "1"])
def test_accepted_modes(tmp_path, mode):
    path = save(tmp_path / "a.png", RGB, mode)
    image = images.read_image(path)
    assert image.shape == (12, 20, 3) and image.dtype == torch.uint8
    if mode == "RGBA":
        assert np.array_equal(image.numpy(), RGB)


def test_palette_gives_colours_not_indices(tmp_path):
    flat = np.zeros((4, 4, 3), np.uint8) + np.array([10, 200, 30], np.uint8)
    Image.fromarray(flat).quantize(4).save(tmp_path / "p.png")
    assert images.read_image(tmp_path / "p.png")[0, 0].tolist() == [10, 200, 30]


def test_transparent_pixels_show_the_background(tmp_path):
    rgba = np.zeros((4, 4, 4), np.uint8) + 255
    rgba[:2, :, 3] = 0
    path = save(tmp_path / "a.png", rgba)
    assert images.read_image(path)[0, 0].tolist() == [0, 0, 0]
    assert images.read_image(path, background=(9, 8, 7))[0, 0].tolist() == [9, 8, 7]
    assert images.read_image(path)[3, 3].tolist() == [255, 255, 255]


@pytest.mark.parametrize("name, array", [("a.png", np.full((4, 4), 1000, np.uint16)), ("a.jpg", None)])
def test_modes_that_would_be_a_guess_are_refused(tmp_path, name, array):
    path = tmp_path / name
    Image.fromarray(RGB).convert("CMYK").save(path) if array is None else Image.fromarray(array).save(path)
    with pytest.raises(InputError, match=r"mode (CMYK|I;16).*8-bit RGB"):
        images.read_image(path)


def test_pixel_limit_is_checked_on_the_header(tmp_path):
    path = save(tmp_path / "a.png", RGB)
    with pytest.raises(InputError, match=r"20x12 pixels are over the limit"):
        images.read_image(path, max_pixels=100)
    bomb = tmp_path / "bomb.png"
    raw = bytearray(path.read_bytes())
    raw[16:24] = (50_000).to_bytes(4, "big") * 2
    raw[29:33] = zlib.crc32(bytes(raw[12:29])).to_bytes(4, "big")
    bomb.write_bytes(raw)
    with pytest.raises(InputError, match=r"gigantic|over the limit"):
        images.read_image(bomb)


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif"])
@pytest.mark.parametrize("read", [images.read_image, images.check_decodes])
def test_truncated_file_is_named(tmp_path, suffix, read):
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    path = save(tmp_path / f"a.{suffix}", noise)
    read(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=rf"a\.{suffix}"):
        read(path)


def test_other_failures_are_named(tmp_path):
    (tmp_path / "t.png").write_text("not an image")
    with pytest.raises(InputError, match=r"t\.png.*not an image"):
        images.read_image(tmp_path / "t.png")
    with pytest.raises(InputError, match="no such image"):
        images.read_size(tmp_path / "none.png")
    with pytest.raises(ValueError, match="finite"):
        images.write_image(tmp_path / "nan.png", torch.full((2, 2, 3), torch.nan))


def test_frame_image_wants_the_cameras_size(tmp_path):
    path = save(tmp_path / "a.png", RGB)
    photo = Photo(path, Camera(20, 12, 1, 1, 1, 1), "a")
    assert images.frame_image(photo).shape == (12, 20, 3)
    with pytest.raises(InputError, match=r"20x12 pixels, its camera says 12x20"):
        images.frame_image(Photo(path, Camera(12, 20, 1, 1, 1, 1), "a"))


def test_only_our_own_pictures_are_ours(tmp_path):
    images.write_image(tmp_path / "ours.png", torch.from_numpy(RGB))
    assert images.is_ours(tmp_path / "ours.png")
    assert not images.is_ours(save(tmp_path / "theirs.png", RGB))
    (tmp_path / "t.png").write_text("text")
    assert not images.is_ours(tmp_path / "t.png")
