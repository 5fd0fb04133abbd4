"""What is found in a folder of photos."""

from pathlib import Path

import pytest

from refield.photos.sources import find_sources
from refield.scene.errors import InputError


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def test_numbers_in_names_count(tmp_path):
    touch(tmp_path, "IMG_10.JPG", "IMG_9.jpg", "IMG_9.mp4", "IMG_1.heic", ".hidden.jpg", "notes.txt", "below/x.jpg")
    found = find_sources(tmp_path)
    assert [s.name for s in found] == ["IMG_1.heic", "IMG_9.jpg", "IMG_9.mp4", "IMG_10.JPG"]
    assert [s.kind for s in found] == ["heic", "picture", "video", "picture"]


def test_photos_may_lie_in_images(tmp_path):
    assert [s.name for s in find_sources(touch(tmp_path, "images/a.png", "masks/a.png"))] == ["images/a.png"]


def test_a_link_that_leads_out_is_not_followed(tmp_path):
    touch(tmp_path / "secret", "photo.png")
    touch(tmp_path / "photos", "a.png")
    (tmp_path / "photos" / "b.png").symlink_to(tmp_path / "secret" / "photo.png")
    assert [s.name for s in find_sources(tmp_path / "photos")] == ["a.png"]


def test_a_folder_of_links_that_lead_out_is_told_as_such(tmp_path):
    touch(tmp_path / "disk", "photo.png")
    touch(tmp_path / "photos", "notes.txt")
    (tmp_path / "photos" / "photo.png").symlink_to(tmp_path / "disk" / "photo.png")
    with pytest.raises(
        InputError, match=r"links that lead out of it \(photo.png\), which are not followed; give the f"
    ):
        find_sources(tmp_path / "photos")


@pytest.mark.parametrize(
    ("names", "says"),
    [
        ((), "there is no such folder; give"),
        (("photos",), "is not a folder; give"),
        (("photos/a.txt",), "no photos, no transforms.json and no COLMAP model; photos are files"),
        (("photos/one/a.jpg", "photos/two/b.jpg"), r"folders of photos \(one, two\); give one of them"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, names, says):
    touch(tmp_path, *names)
    with pytest.raises(InputError, match=says):
        find_sources(tmp_path / "photos")
