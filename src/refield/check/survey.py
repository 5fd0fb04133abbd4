"""What a capture holds, what will become of it, and whether that is enough."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from refield.check.coverage import Coverage, coverage_of
from refield.field.fit import FitConfig
from refield.field.memory import Memory, memory_fault, memory_of
from refield.field.quality import Quality, sized
from refield.photos.features import photo_features
from refield.photos.gather import Gathered
from refield.photos.lens import Lens
from refield.photos.look import Look, look_at, stops, usual_sharpness
from refield.photos.motion import MotionConfig
from refield.photos.taken import Taken, pixels_of
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, centres
from refield.scene.images import read_image
from refield.scene.left_out import named
from refield.scene.world import World, world_of

FEW, TOO_FEW = 30, 3
_SPREAD = 1.0  # stops, from which on exposure is spoken of
_GAP, _SEEN = 120.0, 3.0
_SIFT_HERE = 1.1  # seconds a megapixel, on the machine that the rest was measured on: 2 cores of a Xeon
_PER_PAIR, _PER_POSE, _PER_SAMPLE, _PER_ENTRY = 0.035, 0.12, 0.9e-6, 1.9e-9  # seconds there


@dataclass(frozen=True)
class Survey:
    """A capture looked over."""

    names: tuple[str, ...]
    """of the photos that are used"""
    looks: tuple[Look, ...]
    """of the same"""
    sizes: Counter[tuple[int, int]]
    cameras: int
    """distinct ones, by lens and size or by their intrinsics"""
    left_out: tuple[tuple[str, str], ...]
    """names, and why each is skipped"""
    memory: Memory
    seconds: dict[str, float]
    """about, per stage, on this machine"""
    capture: Capture | None = None
    """with poses; None where they are not known yet"""
    world: World | None = None
    coverage: Coverage | None = None
    faults: tuple[str, ...] = field(default=())
    """why it cannot be used; each with what to do"""
    advice: tuple[str, ...] = field(default=())
    """what would make it better"""


def survey_capture(
    capture: Capture,
    asked: tuple[FitConfig, Quality],
    left_out: Sequence[tuple[str, str]] = (),
    on_progress: Callable[[int, int], None] | None = None,
) -> Survey:
    """Look over photos with poses, that are to be fitted as ``asked``."""
    looks, rate = [], []
    for i, frame in enumerate(capture.frames):
        image = read_image(frame.path).numpy()
        looks.append(look_at(image))
        if i < 3:
            rate.append(_seconds_per_megapixel(image))
        if on_progress is not None:
            on_progress(i + 1, len(capture.frames))
    world, config = world_of(capture), sized(asked[0], capture.train, asked[1])
    coverage, memory = coverage_of(capture, world), memory_of(capture, config)
    sizes = Counter((f.camera.width, f.camera.height) for f in capture.frames)
    seconds = {"fit": _fit_seconds(config, _slowness(rate))}
    names = tuple(f.name for f in capture.frames)
    faults = [*_too_little(len(names)), *_memory(memory), *_one_place(capture)]
    advice = [*_photo_advice(names, looks), *_coverage_advice(coverage)]
    return Survey(
        names, tuple(looks), sizes, len({f.camera for f in capture.frames}), tuple(left_out), memory, seconds,
        capture, world, coverage, tuple(faults), tuple(advice),
    )  # fmt: skip


def survey_photos(gathered: Gathered, asked: tuple[FitConfig, Quality], motion: MotionConfig) -> Survey:
    """Look over photos without poses, to be fitted as ``asked``; where they were taken takes longer to find."""
    photos = gathered.photos
    capture = Capture(tuple(_unplaced(p) for p in photos))
    config = sized(asked[0], capture.train, asked[1])
    memory = memory_of(capture, config)
    names, looks = tuple(p.name for p in photos), [p.look for p in photos]
    rate = [_seconds_per_megapixel(pixels_of(p)) for p in photos[:3]]
    lenses: set[tuple[Lens, int, int]] = {(p.lens, p.width, p.height) for p in photos}
    seconds = _motion_seconds(photos, motion, _slowness(rate))
    seconds["fit"] = _fit_seconds(config, _slowness(rate))
    return Survey(
        names, tuple(looks), Counter((p.width, p.height) for p in photos), len(lenses), gathered.left_out, memory,
        seconds, faults=(*_too_little(len(photos)), *_memory(memory)), advice=tuple(_photo_advice(names, looks)),
    )  # fmt: skip


def _fit_seconds(config: FitConfig, slowness: float) -> float:
    step = _PER_SAMPLE * config.samples + _PER_ENTRY * config.field.levels * 2**config.field.log2_table
    return min(config.steps * step * slowness, config.max_seconds or math.inf)


def _unplaced(photo: Taken) -> Frame:
    focal = photo.lens.guess(photo.width, photo.height)
    camera = Camera(photo.width, photo.height, focal, focal, photo.width / 2, photo.height / 2)
    return Frame(photo.path, camera, photo.name, torch.eye(4, dtype=torch.float64))


def _seconds_per_megapixel(image: object) -> float:
    began = time.perf_counter()
    pixels = torch.as_tensor(image)
    photo_features(pixels.numpy())
    return (time.perf_counter() - began) / (pixels.shape[0] * pixels.shape[1] / 1e6)


def _slowness(rates: Sequence[float]) -> float:
    """How much longer this machine takes than the one the figures are of."""
    return max(min(rates, default=_SIFT_HERE) / _SIFT_HERE, 0.1)


def _motion_seconds(photos: Sequence[Taken], motion: MotionConfig, slowness: float) -> dict[str, float]:
    n = len(photos)
    pairs = n * (n - 1) / 2 if n <= motion.exhaustive else n * (0.55 * motion.similar)
    megapixels = sum(p.width * p.height for p in photos) / 1e6
    work = _SIFT_HERE * megapixels + _PER_PAIR * pairs * (motion.features / 3000) + _PER_POSE * n
    return {"find the poses": slowness * work}


def _too_little(count: int) -> list[str]:
    if count >= TOO_FEW:
        return []
    return [f"{count} photos can be used, which are too few; give 50 or more, from many sides"]


def _memory(needed: Memory) -> list[str]:
    fault = memory_fault(needed)
    return [] if fault is None else ["; ".join(fault)]


def _one_place(capture: Capture) -> list[str]:
    at = centres(capture.frames)
    if float((at - at.mean(0)).norm(dim=1).max()) >= 1e-9 * (1 + float(at.abs().max())):
        return []
    return ["all photos were taken from one place; give photos from many sides"]


def _photo_advice(names: Sequence[str], looks: Sequence[Look]) -> list[str]:
    out = []
    if TOO_FEW <= len(names) < FEW:
        out.append(f"{len(names)} photos are few; 50 to 200 show a scene from all sides")
    usual = usual_sharpness(looks)
    soft = [name for name, look in zip(names, looks) if look.blur(usual)]
    if soft:
        out.append(f"{len(soft)} photos are blurred and make the field blurred: {named(soft)}")
    flat = [f"{name} {look.fault}" for name, look in zip(names, looks) if look.fault]
    if flat:
        out.append(f"{len(flat)} photos show nothing: {named(flat)}")
    spread = stops(looks)
    if spread > _SPREAD:
        out.append(f"brightness spreads over {spread:.1f} stops; fix exposure and white balance if you can")
    return out


def _coverage_advice(coverage: Coverage) -> list[str]:
    out = []
    if coverage.gap > _GAP:
        out.append(f"no photo from {coverage.gap:.0f}° around: what is seen only from there stays unknown")
    if coverage.seen_by is not None and coverage.seen_by < _SEEN:
        out.append(f"half of the points lie in {coverage.seen_by:.0f} photos or fewer; photos should overlap more")
    return out


def told(world: Path | str, survey: Survey) -> str:
    """One line: whether it can be used."""
    if survey.faults:
        return f"{world}: not usable: {'; '.join(survey.faults)}"
    return f"{world}: usable"


def survey_document(survey: Survey) -> dict[str, Any]:
    """The same for programs: lengths in units of the world, angles in degrees, bytes, seconds."""
    coverage = survey.coverage
    around = None if coverage is None else {k: getattr(coverage, k) for k in ("around", "lowest", "highest", "seen_by")}
    return {
        "usable": not survey.faults,
        "faults": survey.faults,
        "advice": survey.advice,
        "photos": [
            {"name": name, "sharpness": look.sharpness, "brightness": look.brightness}
            for name, look in zip(survey.names, survey.looks)
        ],
        "skipped": [{"name": name, "why": why} for name, why in survey.left_out],
        "sizes": [{"width": w, "height": h, "photos": n} for (w, h), n in survey.sizes.most_common()],
        "cameras": survey.cameras,
        "brightness_stops": stops(survey.looks) if survey.looks else None,
        "coverage": around,
        "points": None if survey.capture is None else len(survey.capture.points),
        "size": None if survey.world is None else survey.world.size,
        "memory_bytes": survey.memory.total,
        "seconds_expected": survey.seconds,
    }
