"""How much a fit does follows from its photos, and from what is asked."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import torch
from numba.core import event

from refield.field.compiling import compiling
from refield.field.fit import FitConfig
from refield.field.photo_model import PhotoModelConfig
from refield.field.quality import OPEN, asked_of, sized
from refield.field.radiance import HashFieldConfig
from refield.scene.camera import Camera
from refield.scene.capture import Frame


def frames(count: int, width: int, height: int) -> tuple[Frame, ...]:
    camera = Camera(width, height, width, width, width / 2, height / 2)
    return tuple(Frame(Path(f"{i}.png"), camera, f"{i}.png", torch.eye(4, dtype=torch.float64)) for i in range(count))


def test_small_captures_are_fitted_as_ever_whatever_is_asked() -> None:
    for quality in ("draft", "good", "best"):
        found = sized(OPEN, frames(40, 96, 96), quality)
        usual = FitConfig()
        assert (found.steps, found.samples, found.field) == (usual.steps, usual.samples, usual.field)
        assert not (found.sharpen or found.photos.exposures or found.photos.poses)


def test_more_photos_and_more_quality_make_larger_fields() -> None:
    photos = frames(60, 540, 960)
    draft, good, best = (sized(OPEN, photos, quality) for quality in ("draft", "good", "best"))
    assert draft.field.log2_table < good.field.log2_table <= best.field.log2_table
    assert draft.steps < good.steps < best.steps and draft.max_seconds < good.max_seconds < best.max_seconds
    assert all(c.sharpen and c.photos.exposures and c.field.width == 64 for c in (draft, good, best))
    assert sized(OPEN, photos[:10], "good").field.log2_table < good.field.log2_table


def test_what_is_said_goes_before_the_quality() -> None:
    said = replace(
        OPEN,
        steps=2000,
        max_seconds=7.0,
        sharpen=False,
        field=replace(OPEN.field, log2_table=17),
        photos=PhotoModelConfig(exposures=False),
    )
    found = sized(said, frames(60, 540, 960), "good")
    assert (found.steps, found.max_seconds, found.sharpen) == (2000, 7.0, False)
    assert found.field.log2_table == 17 and found.field.levels >= HashFieldConfig().levels
    assert found.photos == PhotoModelConfig(exposures=False, poses=False)


def test_the_other_architecture_asks_for_exposures_of_large_captures_too() -> None:
    few, many, unsaid = frames(40, 96, 96), frames(60, 540, 960), PhotoModelConfig()
    assert not asked_of(few, unsaid).exposures and asked_of(many, unsaid).exposures
    assert asked_of(few, PhotoModelConfig(exposures=True)).exposures
    found = asked_of(many, PhotoModelConfig(exposures=False, poses=True))
    assert found == PhotoModelConfig(exposures=False, poses=True)


def test_compiling_is_noticed() -> None:
    @numba.njit
    def twice(x):  # type: ignore[no-untyped-def]
        return x * 2

    with compiling() as first:
        twice(np.float32(3))
    with compiling() as again:
        twice(np.float32(3))
    assert first.seconds > 0 and again.seconds == 0


def test_compiling_within_what_is_timed_is_no_work() -> None:
    with compiling() as whole, compiling() as part, event.trigger_event("numba:compile"):
        time.sleep(0.2)
    assert whole.seconds >= 0.2 and part.seconds >= 0.2 and whole.worked < 0.2
