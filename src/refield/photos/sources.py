"""What lies in a folder of photos: pictures, HEIC, videos; in the order in which they were taken, by their names."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from refield.scene import images
from refield.scene.errors import InputError

HEIC = (".heic", ".heif", ".hif")
VIDEO = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
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
    """The pictures and videos in ``folder`` and below, hidden ones and masks left out; numbers in names count as such.

    Raises:
        InputError: there is no such folder, nothing in it can be used, or there are too many files.
    """
    if not folder.is_dir():
        what = "is not a folder" if folder.exists() else "there is no such folder"
        raise InputError(folder, what, "give the folder that holds the photos")
    found = [source for path in folder.rglob("*") if (source := _source(folder, path)) is not None]
    if not found:
        kinds = ", ".join((*images.SUFFIXES, *HEIC, *VIDEO))
        raise InputError(folder, "holds no photos", f"give a folder with files that end in one of {kinds}")
    if len(found) > MOST:
        raise InputError(folder, f"holds {len(found)} photos, the limit is {MOST}", "give the folder of one capture")
    return tuple(sorted(found, key=lambda s: _natural(s.name)))


def holds_photos(folder: Path) -> bool:
    """Whether there is anything that `find_sources` would find."""
    return folder.is_dir() and any(_source(folder, path) for path in folder.rglob("*"))


def _source(folder: Path, path: Path) -> Source | None:
    relative = path.relative_to(folder)
    hidden = path.name.startswith(".") or any(part.startswith((".", "masks")) for part in relative.parts[:-1])
    suffix = path.suffix.lower()
    if hidden or not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
        return None
    name = relative.as_posix()
    if suffix in images.SUFFIXES:
        return Source(path, name, "picture")
    if suffix in HEIC:
        return Source(path, name, "heic")
    return Source(path, name, "video") if suffix in VIDEO else None


def _natural(name: str) -> tuple[list[tuple[int, str]], str]:
    """``IMG_9`` before ``IMG_10``."""
    parts = re.findall(r"\d+|\D+", name.lower())
    return [(int(p), "") if p.isdecimal() and p.isascii() else (-1, p) for p in parts], name
