"""Images that a capture lists but that cannot be used: left out, counted and named, never silently."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from refield.scene import images
from refield.scene.errors import InputError

Warn = Callable[[str], None]

UNREADABLE_SHARE = 0.1
"""Of a capture's images, so many may be unreadable."""
_SHOWN = 5  # names in a message


def named(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    shown = ", ".join(names[:_SHOWN])
    return shown if len(names) <= _SHOWN else f"{shown} and {len(names) - _SHOWN} more"


@dataclass
class LeftOut:
    """Collects what is missing or unreadable while a capture is being loaded."""

    decode: bool = True
    """look at the pixels too, not only at the headers: finds truncated files before work is lost on them"""
    missing: list[str] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    reason: str = ""
    """what is wrong with the first unreadable one"""

    def size_of(self, image: Path | None, name: str) -> tuple[int, int] | None:
        """The image's (width, height), or None if it has to be left out, which is noted."""
        if image is None or not image.is_file():
            self.missing.append(name)
            return None
        try:
            size = images.read_size(image)
            if self.decode:
                images.check_decodes(image)
            return size
        except InputError as error:
            self.unreadable.append(name)
            self.reason = self.reason or error.what
            return None

    def report(self, where: Path, total: int, warn: Warn) -> None:
        """Name what is left out of ``total`` images.

        Raises:
            InputError: no image exists, or more than a tenth cannot be read.
        """
        missing, unreadable = self.missing, self.unreadable
        if len(missing) == total:
            what = f"none of its {total} images exists ({named(missing)})"
            raise InputError(where, what, "put the images beside it, or correct their paths")
        if len(unreadable) > UNREADABLE_SHARE * (total - len(missing)):
            what = f"{len(unreadable)} of {total} images cannot be read ({named(unreadable)}: {self.reason})"
            raise InputError(where, what, "replace them or remove their frames")
        for names, fault in ((missing, "missing"), (unreadable, f"unreadable ({self.reason})")):
            if names:
                warn(f"{where}: {len(names)} of {total} images are {fault} and left out: {named(names)}")
