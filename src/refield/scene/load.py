"""Find out how a capture was handed over, and load it: transforms.json, or a COLMAP model.

Photos without poses are told apart here; they are placed by `refield.photos` and `refield.estimate.localize`.
"""

from __future__ import annotations

from pathlib import Path

from refield.scene import colmap, images, transforms_json
from refield.scene.capture import Capture, Frame, check_capture
from refield.scene.errors import InputError
from refield.scene.files import AnyPath, as_path, log_warning
from refield.scene.left_out import Warn

_GIVE = "a transforms.json (nerfstudio, instant-ngp) or a COLMAP model in sparse/0, with the images beside it"


def is_posed(data: AnyPath) -> bool:
    """Whether there are camera poses: a transforms.json or a COLMAP model, not only photos.

    Raises:
        InputError: there is no such file or folder.
    """
    data = as_path(data, "the photos")
    if not data.exists():
        raise InputError(data, "there is no such file or folder", f"give the photos' folder, or {_GIVE}")
    return data.is_file() or (data / transforms_json.NAME).is_file() or bool(colmap.find_models(data))


def load_capture(data: AnyPath, *, warn: Warn = log_warning) -> Capture:
    """Posed photos from a transforms.json (file or folder), else from a COLMAP model in the folder.

    Raises:
        InputError: nothing of the kind is there, or what is there cannot be used.
    """
    data = as_path(data, "the capture to load")
    if not data.exists():
        raise InputError(data, "there is no such file or folder", f"give {_GIVE}")
    if data.is_file() or (data / transforms_json.NAME).is_file():
        return transforms_json.load_transforms(data, warn=warn)
    if colmap.find_models(data):
        return colmap.load_colmap(data, warn=warn)
    raise _unposed(data)


def load_new_photos(photos: AnyPath, capture: Capture, *, warn: Warn = log_warning) -> list[Frame]:
    """A few new photos with poses in the capture's world.

    Raises:
        InputError: no poses are given, or a photo is missing or unreadable.
    """
    photos = as_path(photos, "the new photos to load")
    check_capture(capture)
    if not photos.exists():
        raise InputError(photos, "there is no such file or folder", "give the folder of the new photos")
    if photos.is_dir() and not (photos / transforms_json.NAME).is_file():
        give = "a transforms.json with their poses in the capture's world, or the photos alone"
        if colmap.find_models(photos):
            raise InputError(photos, "holds a COLMAP model, which is read for first photos only", f"give {give}")
        raise _unposed(photos, give, "localize_photos")
    return transforms_json.load_photos(photos, warn=warn)


def _unposed(folder: Path, give: str = _GIVE, place: str = "capture_from_photos") -> InputError:
    count = sum(p.suffix.lower() in images.SUFFIXES for p in [*folder.glob("*"), *folder.glob("images/*")])
    if count:
        what = f"holds {count} photos but no camera poses"
        return InputError(folder, what, f"place them first (refield.{place}), or give {give}")
    return InputError(folder, "holds neither transforms.json nor a COLMAP model", f"give {give}")
