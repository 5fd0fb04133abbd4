"""One photo made ready: an upright copy of a workable size, named by its content, and a look at it.

HEIC needs pillow-heif (extra ``heic``).
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import io
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from refield.photos import video
from refield.photos.lens import Lens, read_lens
from refield.photos.look import Look, look_at
from refield.photos.sources import Source
from refield.scene import images
from refield.scene.errors import InputError
from refield.scene.files import write_bytes

FOLDER = "photos"
"""of the copies, in the cache"""
_AS_THEY_ARE = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class PhotoConfig:
    """How photos without poses are taken in."""

    longest: int = field(default=1600, metadata={"usual": True})
    """pixels of the longer side, at most. Larger photos are scaled down to it"""
    video_frames: int = 120
    """taken from a video: the sharpest, spread over its length"""

    def __post_init__(self) -> None:
        for name, least in (("longest", 64), ("video_frames", 2)):
            if getattr(self, name) < least:
                remedy = f"give at least {least}"
                raise InputError(f"--photos.{name.replace('_', '-')}", f"is {getattr(self, name)}", remedy)


@dataclass(frozen=True)
class Taken:
    """A photo made ready."""

    name: str
    """how the user knows it"""
    path: Path
    """the upright copy"""
    key: str
    """its name in the cache, by its content"""
    width: int
    height: int
    lens: Lens
    look: Look


def pixels_of(photo: Taken) -> np.ndarray:
    """(H, W, 3) uint8."""
    return np.asarray(images.read_image(photo.path).numpy())


def need_heif(sources: Sequence[Source]) -> None:
    """Check that HEIC files can be read, if there are any.

    Raises:
        InputError: they cannot.
    """
    if sources and importlib.util.find_spec("pillow_heif") is None:
        more = f" (and {len(sources) - 1} more files)" if len(sources) > 1 else ""
        what = f"is HEIC{more}, which needs the package pillow-heif"
        raise InputError(sources[0].path, what, "pip install 'refield[heic]', or convert to JPEG")


def stamp(source: Source) -> list[int]:
    """Size and time of change: what tells that a file is still the same."""
    stat = source.path.stat()
    return [stat.st_size, stat.st_mtime_ns]


def from_picture(cache: Path, source: Source, config: PhotoConfig) -> Taken:
    """The copy of a picture, in ``cache``.

    Raises:
        InputError: it cannot be decoded.
    """
    formats: Sequence[str] = images.FORMATS
    if source.kind == "heic":
        importlib.import_module("pillow_heif").register_heif_opener()
        formats = ("HEIF",)
    digest = hashlib.sha256(source.path.read_bytes()).hexdigest()[:16]
    with images.opened(source.path, formats=formats) as image:
        lens = read_lens(image)
        as_it_is = not images.is_turned(image) and max(image.size) <= config.longest
        upright = images.upright_rgb(source.path, image)
    target = cache / FOLDER / f"{digest}.jpg"
    if as_it_is and source.path.suffix.lower() in _AS_THEY_ARE:
        target = target.with_suffix(source.path.suffix.lower())
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source.path, target)
    else:
        upright = _scaled(upright, config.longest)
        _write_jpeg(target, upright)
    return Taken(source.name, target, target.name, *upright.size, lens, look_at(np.asarray(upright)))


def from_video(cache: Path, source: Source, config: PhotoConfig) -> Iterator[Taken]:
    """Copies of a video's best frames, in ``cache``.

    Raises:
        InputError: it cannot be opened.
    """
    stat = stamp(source)
    digest = hashlib.sha256(f"{source.path.resolve()} {stat}".encode()).hexdigest()[:12]
    for i, (seconds, frame) in enumerate(video.sharp_frames(source.path, config.video_frames)):
        picture = _scaled(Image.fromarray(frame), config.longest)
        target = cache / FOLDER / f"{digest}{i:04d}.jpg"
        _write_jpeg(target, picture)
        name, look = f"{source.name} at {seconds:.2f} s", look_at(np.asarray(picture))
        yield Taken(name, target, target.name, *picture.size, Lens(), look)


def _scaled(image: Image.Image, longest: int) -> Image.Image:
    scale = longest / max(image.size)
    if scale >= 1:
        return image
    width, height = (max(round(side * scale), 1) for side in image.size)
    return image.resize((width, height), Image.Resampling.LANCZOS, reducing_gap=3.0)


def _write_jpeg(path: Path, image: Image.Image) -> None:
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=95, subsampling=0)
    write_bytes(path, buffer.getvalue(), durable=False)
