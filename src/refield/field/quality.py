"""How much a fit does: a field as large as its photos can fill, for as long as its quality asks.

Small captures are fitted by the smallest of all, whatever is asked: more would learn nothing from them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from refield.field.fit import FitConfig
from refield.field.photo_model import PhotoModelConfig
from refield.field.radiance import HashFieldConfig
from refield.scene.capture import Frame

Quality = Literal["draft", "good", "best"]


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
_GROWTH = 1.5  # from level to level


def sized(config: FitConfig, frames: Sequence[Frame], quality: Quality) -> FitConfig:
    """The config with what a quality says for the training frames, wherever it is the default's."""
    pixels, effort = sum(f.camera.width * f.camera.height for f in frames), _EFFORTS[quality]
    usual = FitConfig()
    log2 = round(math.log2(max(pixels, 1) / _PIXELS_PER_ENTRY))
    log2 = int(min(max(log2, usual.field.log2_table), effort.largest_table))
    large = log2 > usual.field.log2_table
    finest = round(2.5 * 2 ** (log2 / 2))
    shape = HashFieldConfig(
        levels=max(round(1 + math.log(finest / usual.field.coarsest) / math.log(_GROWTH)), usual.field.levels),
        log2_table=log2,
        width=64 if large else usual.field.width,
    )
    samples = 2 * usual.samples if large else usual.samples
    steps = max(usual.steps * usual.samples, effort.samples_per_pixel * pixels) / samples
    chosen = FitConfig(
        steps=round(steps),
        max_seconds=effort.seconds,
        samples=samples,
        field=_with(config.field, shape),
        photos=_with(config.photos, PhotoModelConfig(exposures=True)),
    )
    return _with(config, chosen)


def _with(given: Any, chosen: Any) -> Any:
    """A config with what was chosen for those of its numbers that are the default's."""
    usual = type(given)()
    other = {f.name for f in fields(given) if getattr(given, f.name) != getattr(usual, f.name)}
    kept = {f.name: getattr(chosen, f.name) for f in fields(given) if f.name not in other}
    own = {name: getattr(chosen, name) for name in other if name in ("field", "photos")}  # merged already
    return replace(given, **kept, **own)
