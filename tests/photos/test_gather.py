"""Photos made ready: upright, of a workable size, each looked at once, unusable ones told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from refield.photos import gather as module
from refield.photos.gather import gather
from refield.photos.lens import Lens
from refield.photos.taken import PhotoConfig, pixels_of
from refield.scene.errors import InputError
from tests.photos.room import texture

ORIENTATION, MAKE, MODEL, EXIF_IFD, FOCAL_35MM = 0x0112, 0x010F, 0x0110, 0x8769, 0xA405


def picture(seed: int = 0, size: tuple[int, int] = (320, 240)) -> Image.Image:
    return Image.fromarray((texture(seed) * 255).astype(np.uint8)).resize(size, Image.Resampling.LANCZOS)


def exif(**tags: object) -> Image.Exif:
    out = Image.Exif()
    for tag, value in tags.items():
        if tag == "focal":
            out.get_ifd(EXIF_IFD)[FOCAL_35MM] = value
        else:
            out[{"orientation": ORIENTATION, "make": MAKE, "model": MODEL}[tag]] = value
    return out


def save(path: Path, image: Image.Image, **tags: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, exif=exif(**tags), quality=95)


def test_turned_photos_stand_upright_and_tell_their_lens(tmp_path):
    upright = picture()
    save(tmp_path / "in" / "a.jpg", upright.rotate(90, expand=True), orientation=6, make="Acme", model="P1", focal=26)
    (photo,) = gather(tmp_path / "in", tmp_path / "cache").photos
    assert (photo.width, photo.height) == (320, 240)
    assert np.abs(pixels_of(photo).astype(int) - np.asarray(upright).astype(int)).mean() < 10
    assert photo.lens == Lens("Acme P1", 26.0)
    # 26 mm of a full-frame diagonal of 43.3 mm, on a diagonal of 400 pixels
    assert photo.lens.focal(320, 240) == pytest.approx(240.4, abs=0.1)


def test_large_photos_are_scaled_and_small_ones_kept_as_they_are(tmp_path):
    save(tmp_path / "in" / "large.jpg", picture(0, (640, 320)))
    picture(1, (200, 100)).save(tmp_path / "in" / "small.png")
    large, small = gather(tmp_path / "in", tmp_path / "cache", PhotoConfig(longest=300)).photos
    assert (large.width, large.height) == (300, 150) and (small.width, small.height) == (200, 100)
    assert small.path.read_bytes() == (tmp_path / "in" / "small.png").read_bytes()


def test_what_cannot_be_used_is_told(tmp_path):
    folder = tmp_path / "in"
    for i in range(4):
        save(folder / f"{i}.jpg", picture(i))
    Image.new("RGB", (320, 240), (3, 3, 3)).save(folder / "black.png")
    Image.new("RGB", (320, 240), (255, 255, 255)).save(folder / "white.png")
    small = picture(5).resize((16, 12), Image.Resampling.BOX).resize((320, 240), Image.Resampling.BICUBIC)
    small.save(folder / "soft.png")
    (folder / "twice.jpg").write_bytes((folder / "0.jpg").read_bytes())
    (folder / "broken.jpg").write_bytes((folder / "1.jpg").read_bytes()[:2000])
    (folder / "text.jpg").write_text("not a picture")
    found = gather(folder, tmp_path / "cache")
    assert [p.name for p in found.photos] == ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]
    why = dict(found.left_out)
    assert set(why) == {"black.png", "white.png", "soft.png", "twice.jpg", "broken.jpg", "text.jpg"}
    assert "is black" in why["black.png"] and "is white" in why["white.png"]
    assert "too blurred" in why["soft.png"] and why["twice.jpg"] == "is the same picture as 0.jpg"
    assert "cannot be decoded" in why["broken.jpg"] and "not an image" in why["text.jpg"]


def test_what_was_made_is_kept_and_what_changed_is_made_again(tmp_path, monkeypatch):
    for i in range(3):
        save(tmp_path / "in" / f"{i}.jpg", picture(i))
    first = gather(tmp_path / "in", tmp_path / "cache")
    made = []
    real = module._made
    monkeypatch.setattr(
        module, "_made", lambda cache, source, config: made.append(source.name) or real(cache, source, config)
    )
    assert gather(tmp_path / "in", tmp_path / "cache") == first and made == []
    save(tmp_path / "in" / "1.jpg", picture(7))
    second = gather(tmp_path / "in", tmp_path / "cache")
    assert made == ["1.jpg"] and second.photos[0] == first.photos[0] and second.photos[1] != first.photos[1]
    (tmp_path / "cache" / "photos.json").write_text("{")
    assert gather(tmp_path / "in", tmp_path / "cache") == second and len(made) == 4


def test_heic_needs_its_package(tmp_path, monkeypatch):
    (tmp_path / "IMG_1.HEIC").touch()
    (tmp_path / "IMG_2.HEIC").touch()
    monkeypatch.setattr("refield.photos.taken.importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"IMG_1.HEIC: is HEIC \(and 1 more files\).*pip install 'refield\[heic\]'"):
        gather(tmp_path, tmp_path / "cache")


def test_heic_is_read_where_the_package_is_there(tmp_path):
    heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")
    heif.register_heif_opener()
    (tmp_path / "in").mkdir()
    lying = picture().rotate(90, expand=True)  # HEIC turns itself; pillow-heif writes that only for a tag in bytes
    lying.save(tmp_path / "in" / "a.heic", exif=exif(orientation=6, make="Acme").tobytes())
    (photo,) = gather(tmp_path / "in", tmp_path / "cache").photos
    assert (photo.width, photo.height, photo.lens.name) == (320, 240, "Acme")


@pytest.mark.parametrize("option", [{"longest": 8}, {"video_frames": 0}])
def test_settings_are_checked(option):
    with pytest.raises(InputError, match="give at least"):
        PhotoConfig(**option)
