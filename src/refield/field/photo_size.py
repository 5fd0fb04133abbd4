"""At what size a fit reads its photos.

Pixels that a fit never gets round to cost memory and time to read, and detail that its field cannot hold is noise to
it: of large photos a half or a quarter of each side, averaged, is all that pays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from refield.field.photos import Since
from refield.scene.capture import Capture, Frame
from refield.scene.errors import InputError

_SMALL = 1 << 18  # pixels; photos of so many or fewer are not halved
_WORDS = {0.5: "a half", 0.25: "a quarter", 0.125: "an eighth"}


@dataclass(frozen=True)
class PhotoSizeConfig:
    """At what size a fit reads its photos; files, and whatever else reads them, stay as they are."""

    part: float | Literal["auto"] = "auto"
    """of each side; auto: the largest of 1, 1/2, 1/4, ... with which all photos together have at most ``pixels``"""
    pixels: float = 2e8
    """that a fit has use for"""

    def __post_init__(self) -> None:
        if self.part != "auto" and not 0 < self.part <= 1:
            raise InputError("the photos' size", f"cannot be {self.part:g} of theirs", "give a part up to 1, or auto")


def sizes_that_pay(pixels: Sequence[int], budget: float) -> list[float]:
    """At which part of each side, 1, 1/2, 1/4, ..., photos of so many pixels each are read: at most ``budget`` in all.

    The largest are halved first, so that photos of one size stay of one size. Below a quarter of a million pixels none
    is halved.
    """
    parts, now = [1.0] * len(pixels), list(pixels)
    while sum(now) > budget and max(now) > _SMALL:
        most = max(now)
        for i, n in enumerate(now):
            if n > max(most / 2, _SMALL):
                parts[i], now[i] = parts[i] / 2, n // 4
    return parts


def as_read(capture: Capture, since: Since, config: PhotoSizeConfig) -> tuple[Capture, Since]:
    """The same photos, and what is known of their pixels, at the size at which a fit reads them.

    A pixel that is averaged from some that are out of date is out of date.
    """
    frames = (*capture.frames, *since.carried, *since.frames)
    parts = _parts(frames, config)
    if all(part == 1 for part in parts):
        return capture, since
    smaller = tuple(f.shrunk(part) for f, part in zip(frames, parts))
    first, last = len(capture.frames), len(frames) - len(since.frames)
    old, carried, new = smaller[:first], smaller[first:last], smaller[last:]
    valid = {f.name: _shrunk(since.valid[f.name], f) for f in old + carried if f.name in since.valid}
    return replace(capture, frames=old), replace(since, frames=new, carried=carried, valid=valid)


def at_full_size(capture: Capture) -> Capture:
    """The capture with its photos at the size of their files, whatever became known of their cameras."""
    return replace(capture, frames=tuple(f.whole() for f in capture.frames))


def _shrunk(mask: Tensor, frame: Frame) -> Tensor:
    """Where all of a mask's pixels that make up a frame's are true."""
    size = frame.camera.width, frame.camera.height
    share = cv2.resize(mask.numpy().astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(share > 1 - 1e-4)


def sizes_told(capture: Capture, config: PhotoSizeConfig) -> str | None:
    """A line on photos that are read smaller than they are; None if none is."""
    parts = _parts(capture.frames, config)
    lines = []
    for part in sorted(set(parts) - {1.0}, reverse=True):
        mine = [f.shrunk(part).camera for f, p in zip(capture.frames, parts) if p == part]
        sizes = ", ".join(dict.fromkeys(f"{c.width} x {c.height}" for c in mine))
        who = "photos are" if len(mine) == len(parts) else f"{len(mine)} of {len(parts)} photos are"
        lines.append(f"{who} read at {_WORDS.get(part, f'{part:.3g}')} of their size ({sizes})")
    return "; ".join(lines) or None


def _parts(frames: Sequence[Frame], config: PhotoSizeConfig) -> list[float]:
    if config.part != "auto":
        return [config.part] * len(frames)
    return sizes_that_pay([f.camera.width * f.camera.height for f in frames], config.pixels)
