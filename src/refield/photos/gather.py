"""Photos made ready: upright, of a workable size, named by their content, looked at once and remembered.

    CACHE/photos/<hash>.jpg   CACHE/photos.json   what is known of each source, by name, size and time of change

Nothing here changes the folder that was given.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from refield.photos.lens import Lens
from refield.photos.look import Look, usual_sharpness
from refield.photos.sources import Source, find_sources
from refield.photos.taken import FOLDER, PhotoConfig, Taken, from_picture, from_video, need_heif, stamp
from refield.scene.errors import InputError
from refield.scene.files import read_json, write_json

OnProgress = Callable[[int, int], None]
INDEX = "photos.json"
_KEEP_EVERY = 25  # sources between two writes of the index


@dataclass(frozen=True)
class Gathered:
    """A folder of photos, made ready."""

    photos: tuple[Taken, ...]
    left_out: tuple[tuple[str, str], ...]
    """names, and why each cannot be used"""


def gather(
    folder: Path,
    cache: Path,
    config: PhotoConfig | None = None,
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
    config = config or PhotoConfig()
    sources = find_sources(folder)
    need_heif([s for s in sources if s.kind == "heic"])
    known = _read_index(cache, config)
    records: dict[str, Any] = {}
    for i, source in enumerate(sources):
        records[source.name] = _fresh(cache, source, known) or _made(cache, source, config)
        if i % _KEEP_EVERY == _KEEP_EVERY - 1 or i == len(sources) - 1:
            write_json(cache / INDEX, {"config": asdict(config), "photos": known | records})
        if on_progress is not None:
            on_progress(i + 1, len(sources))
    return _sorted_out(cache, records, among)


def forget(cache: Path) -> None:
    """Remove what `gather` made."""
    shutil.rmtree(cache / FOLDER, ignore_errors=True)
    (cache / INDEX).unlink(missing_ok=True)


def _read_index(cache: Path, config: PhotoConfig) -> dict[str, Any]:
    """What was known, if it was made the same way; a damaged index is only work to be done again."""
    try:
        data = read_json(cache / INDEX)
    except InputError:
        return {}
    photos = data.get("photos")
    return photos if data.get("config") == asdict(config) and isinstance(photos, dict) else {}


def _fresh(cache: Path, source: Source, known: dict[str, Any]) -> dict[str, Any] | None:
    record = known.get(source.name)
    if not isinstance(record, dict) or record.get("stamp") != stamp(source):
        return None
    try:
        there = all(_taken(cache, p).path.is_file() for p in record["photos"])
    except (KeyError, TypeError, ValueError):
        return None
    return record if there else None


def _made(cache: Path, source: Source, config: PhotoConfig) -> dict[str, Any]:
    record: dict[str, Any] = {"stamp": stamp(source), "photos": [], "fault": ""}
    try:
        if source.kind == "video":
            record["photos"] = [_record(p) for p in from_video(cache, source, config)]
        else:
            record["photos"] = [_record(from_picture(cache, source, config))]
    except InputError as error:
        record["fault"] = error.what
    return record


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
