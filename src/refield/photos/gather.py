"""Photos made ready: upright, of a workable size, named by their content, looked at once and remembered.

    CACHE/photos/<hash>.jpg   CACHE/photos.json   what is known of each source, by name, size and time of change

HEIC needs pillow-heif (extra ``heic``). Nothing here changes the folder that was given.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import io
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from refield.photos import video
from refield.photos.lens import Lens, read_lens
from refield.photos.look import Look, look_at, usual_sharpness
from refield.photos.sources import Source, find_sources
from refield.scene import images
from refield.scene.errors import InputError
from refield.scene.files import read_json, write_bytes, write_json

OnProgress = Callable[[int, int], None]
INDEX, FOLDER = "photos.json", "photos"
_KEEP_EVERY = 25  # sources between two writes of the index
_AS_THEY_ARE = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class PhotoConfig:
    """How photos without poses are taken in."""

    longest: int = 1600
    """pixels of the longer side; larger photos are scaled down to it"""
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


@dataclass(frozen=True)
class Gathered:
    """A folder of photos, made ready."""

    photos: tuple[Taken, ...]
    left_out: tuple[tuple[str, str], ...]
    """names, and why each cannot be used"""


def gather(
    folder: Path,
    cache: Path,
    config: PhotoConfig = PhotoConfig(),
    on_progress: OnProgress | None = None,
    *,
    among: bool = True,
) -> Gathered:
    """The photos and the videos' frames in ``folder``, made ready in ``cache``; what was made before is kept.

    Args:
        among: judge a photo's blur by the others; a few new photos are judged by the old ones instead.

    Raises:
        InputError: there are none, or HEIC files and nothing that reads them.
    """
    sources = find_sources(folder)
    _need_heif([s for s in sources if s.kind == "heic"])
    known = _read_index(cache, config)
    records: dict[str, Any] = {}
    for i, source in enumerate(sources):
        records[source.name] = _fresh(cache, source, known) or _made(cache, source, config)
        if i % _KEEP_EVERY == _KEEP_EVERY - 1 or i == len(sources) - 1:
            write_json(cache / INDEX, {"config": asdict(config), "photos": known | records})
        if on_progress is not None:
            on_progress(i + 1, len(sources))
    return _sorted_out(cache, records, among)


def pixels_of(photo: Taken) -> np.ndarray:
    """(H, W, 3) uint8."""
    return np.asarray(images.read_image(photo.path).numpy())


def _need_heif(sources: Sequence[Source]) -> None:
    if sources and importlib.util.find_spec("pillow_heif") is None:
        more = f" (and {len(sources) - 1} more files)" if len(sources) > 1 else ""
        what = f"is HEIC{more}, which needs the package pillow-heif"
        raise InputError(sources[0].path, what, "pip install 'refield[heic]', or convert to JPEG")


def _read_index(cache: Path, config: PhotoConfig) -> dict[str, Any]:
    """What was known, if it was made the same way; a damaged index is only work to be done again."""
    try:
        data = read_json(cache / INDEX)
    except InputError:
        return {}
    photos = data.get("photos")
    return photos if data.get("config") == asdict(config) and isinstance(photos, dict) else {}


def _stamp(source: Source) -> list[int]:
    stat = source.path.stat()
    return [stat.st_size, stat.st_mtime_ns]


def _fresh(cache: Path, source: Source, known: dict[str, Any]) -> dict[str, Any] | None:
    record = known.get(source.name)
    if not isinstance(record, dict) or record.get("stamp") != _stamp(source):
        return None
    try:
        there = all(_taken(cache, p).path.is_file() for p in record["photos"])
    except (KeyError, TypeError, ValueError):
        return None
    return record if there else None


def _made(cache: Path, source: Source, config: PhotoConfig) -> dict[str, Any]:
    record: dict[str, Any] = {"stamp": _stamp(source), "photos": [], "fault": ""}
    try:
        if source.kind == "video":
            record["photos"] = [_record(p) for p in _from_video(cache, source, config)]
        else:
            record["photos"] = [_record(_from_picture(cache, source, config))]
    except InputError as error:
        record["fault"] = error.what
    return record


def _from_picture(cache: Path, source: Source, config: PhotoConfig) -> Taken:
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


def _from_video(cache: Path, source: Source, config: PhotoConfig) -> Iterator[Taken]:
    stat = _stamp(source)
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


def _record(photo: Taken) -> dict[str, Any]:
    return {k: v for k, v in asdict(photo).items() if k != "path"}


def _taken(cache: Path, record: dict[str, Any]) -> Taken:
    lens, look = Lens(**record["lens"]), Look(**record["look"])
    key = Path(record["key"]).name  # stays in the cache, whatever the index says
    return Taken(record["name"], cache / FOLDER / key, key, record["width"], record["height"], lens, look)


def _sorted_out(cache: Path, records: dict[str, Any], among: bool) -> Gathered:
    """What can be used, and what not: unreadable, black, blurred beside the others, the same picture twice."""
    everything = [_taken(cache, p) for record in records.values() for p in record["photos"]]
    usual = usual_sharpness([photo.look for photo in everything])
    left_out = [(name, record["fault"]) for name, record in records.items() if record["fault"]]
    photos: dict[str, Taken] = {}
    for photo in everything:
        same = photos.get(photo.key)
        why = f"is the same picture as {same.name}" if same else photo.look.fault
        if among and not why:
            why = photo.look.blur(usual)
        if why:
            left_out.append((photo.name, why))
        else:
            photos[photo.key] = photo
    return Gathered(tuple(photos.values()), tuple(left_out))
