"""What lies in a folder of photos: pictures, HEIC, videos; in the order in which they were taken, by their names."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from refield.scene import images
from refield.scene.errors import InputError
from refield.scene.left_out import named

HEIC = (".heic", ".heif", ".hif")
VIDEO = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
_SUFFIXES = (*images.SUFFIXES, *HEIC, *VIDEO)
MOST = 5000
"""files; more are more likely a mistake than a capture"""


@dataclass(frozen=True)
class Source:
    """A file that holds one photo, or a video's many."""

    path: Path
    name: str
    """relative to the folder that was given"""
    kind: Literal["picture", "heic", "video"]


def find_sources(folder: Path) -> tuple[Source, ...]:
    """The pictures and videos in ``folder``, or in its ``images/``; ``IMG_9`` comes before ``IMG_10``.

    Raises:
        InputError: there is no such folder, nothing in it can be used, or there are too many files.
    """
    if not folder.is_dir():
        what = "is not a folder" if folder.exists() else "there is no such folder"
        raise InputError(folder, what, "give the folder that holds the photos")
    found = _found(folder)
    if not found:
        below = sorted(p.name for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".") and _found(p))
        if below:
            what = f"holds no photos itself, but folders of photos ({named(below)})"
            raise InputError(folder, what, "give one of them: each visit's photos are a folder of their own")
        out = sorted(
            p.name for place in _places(folder) for p in place.iterdir() if _is_photo(p) and _leads_out(folder, p)
        )
        if out:
            what = f"holds no photos, but links that lead out of it ({named(out)}), which are not followed"
            raise InputError(folder, what, "give the folder that they lead to, or copies")
        what = "holds no photos, no transforms.json and no COLMAP model"
        raise InputError(folder, what, f"photos are files that end in one of {', '.join(_SUFFIXES)}")
    if len(found) > MOST:
        raise InputError(folder, f"holds {len(found)} photos, the limit is {MOST}", "give the folder of one capture")
    return tuple(sorted(found, key=lambda s: _natural(s.name)))


def _found(folder: Path) -> list[Source]:
    for place in _places(folder):
        found = [source for path in place.iterdir() if (source := _source(folder, path)) is not None]
        if found:
            return found
    return []


def _places(folder: Path) -> list[Path]:
    return [place for place in (folder, folder / "images") if place.is_dir()]


def _leads_out(folder: Path, path: Path) -> bool:
    return not path.resolve().is_relative_to(folder.resolve())


def _is_photo(path: Path) -> bool:
    """Or a video, by its name."""
    return not path.name.startswith(".") and path.suffix.lower() in _SUFFIXES and path.is_file()


def _source(folder: Path, path: Path) -> Source | None:
    if not _is_photo(path) or _leads_out(folder, path):
        return None
    suffix = path.suffix.lower()
    name = path.relative_to(folder).as_posix()
    if suffix in images.SUFFIXES:
        return Source(path, name, "picture")
    if suffix in HEIC:
        return Source(path, name, "heic")
    return Source(path, name, "video")


def _natural(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Numbers in a name count as numbers."""
    parts = re.findall(r"\d+|\D+", name.lower())
    return [(0, int(p), "") if p.isdecimal() and p.isascii() else (1, 0, p) for p in parts], name
