"""How much a fit does: a field as large as its photos can fill, for as long as its quality asks.

Small captures are fitted by the smallest of all, whatever is asked: more would learn nothing from them, and poses that
follow a coarse field's errors come out worse than they were.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal, TypeVar

from refield.field.fit import FitConfig
from refield.field.photo_model import PhotoModelConfig
from refield.field.radiance import HashFieldConfig
from refield.scene.capture import Frame

Quality = Literal["draft", "good", "best"]
_Part = TypeVar("_Part", HashFieldConfig, PhotoModelConfig)


@dataclass(frozen=True)
class _Effort:
    """What a quality is worth."""

    samples_per_pixel: float
    """of all training pixels: several pixels are never looked at, but cells of the size of a pixel are"""
    largest_table: int
    seconds: float
    """the longest that it takes"""


_EFFORTS: dict[Quality, _Effort] = {
    "draft": _Effort(1.0, 18, 55.0),
    "good": _Effort(5.0, 19, 330.0),
    "best": _Effort(16.0, 20, 1500.0),
}
_PIXELS_PER_ENTRY = 60
"""of a level's table: fewer pixels leave it empty, more meet in it by chance"""
_DECAY = 0.1
"""of large tables"""
_GROWTH = 1.5  # from level to level


OPEN = FitConfig(steps=0, samples=0, field=HashFieldConfig(levels=0, log2_table=0, width=0))
"""What a quality is to decide: numbers that are 0, and what is None"""


def sized(config: FitConfig, frames: Sequence[Frame], quality: Quality) -> FitConfig:
    """The config with what a quality says for the training frames, wherever it leaves that open, see `OPEN`."""
    pixels, effort, usual = sum(f.camera.width * f.camera.height for f in frames), _EFFORTS[quality], FitConfig()
    log2 = config.field.log2_table or _log2_table(pixels, effort)
    large = log2 > usual.field.log2_table
    finest = 2.5 * 2 ** (log2 / 2)  # see `placing.finest_for`
    shape = HashFieldConfig(
        levels=max(round(1 + math.log(finest / usual.field.coarsest) / math.log(_GROWTH)), usual.field.levels),
        log2_table=log2,
        width=64 if large else usual.field.width,
    )
    samples = config.samples or (2 * usual.samples if large else usual.samples)
    steps = config.steps or round(max(usual.steps * usual.samples, effort.samples_per_pixel * pixels) / samples)
    return replace(
        config,
        steps=steps,
        max_seconds=config.max_seconds or effort.seconds,
        samples=samples,
        decay=(_DECAY if large else 0.0) if config.decay is None else config.decay,
        look_around=large if config.look_around is None else config.look_around,
        sharpen=large if config.sharpen is None else config.sharpen,
        field=_with(config.field, shape),
        photos=_with(config.photos, PhotoModelConfig(exposures=large)),
    )


def asked_of(frames: Sequence[Frame], photos: PhotoModelConfig) -> PhotoModelConfig:
    """What a fit of the other architecture, whose size is its own, finds out about the training frames: where
    ``photos`` leaves that open, exposures of as many pixels as make a quality's field larger than the smallest."""
    pixels = sum(f.camera.width * f.camera.height for f in frames)
    large = _log2_table(pixels, _EFFORTS["draft"]) > FitConfig().field.log2_table
    return _with(photos, PhotoModelConfig(exposures=large))


def _log2_table(pixels: int, effort: _Effort) -> int:
    least = FitConfig().field.log2_table
    return int(min(max(round(math.log2(max(pixels, 1) / _PIXELS_PER_ENTRY)), least), effort.largest_table))


def _with(given: _Part, chosen: _Part) -> _Part:
    """A config with what was chosen for what it leaves open."""
    said = {f.name: getattr(given, f.name) for f in fields(given)}
    return replace(
        chosen, **{name: value for name, value in said.items() if value is not None and (value is False or value != 0)}
    )
