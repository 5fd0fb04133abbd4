"""capture_from_photos(): a folder of photographs → a capture with poses and points, and its landmarks."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from refield.photos.database import Database
from refield.photos.gather import INDEX, Gathered, forget, gather
from refield.photos.landmarks import NAME, Landmarks, landmarks_of, write_landmarks
from refield.photos.motion import Counting, Motion, MotionConfig, need_three, reconstruct, silent
from refield.photos.taken import PhotoConfig
from refield.scene.capture import Capture
from refield.scene.errors import InputError
from refield.scene.files import AnyPath, as_path, log_warning
from refield.scene.left_out import Warn, named

_SHARE = 0.5  # of the photos, that may be unusable


@dataclass(frozen=True)
class FromPhotosConfig:
    """How photos become a capture."""

    photos: PhotoConfig = field(default_factory=PhotoConfig)
    """taking them in"""
    motion: MotionConfig = field(default_factory=MotionConfig)
    """finding where they were taken"""


@dataclass(frozen=True)
class FromPhotos:
    """A capture that was made from photos alone."""

    capture: Capture
    landmarks: Landmarks
    photos: int
    """that were given"""
    left_out: tuple[tuple[str, str], ...]
    """names, and why each is not part of it"""


def capture_from_photos(
    folder: AnyPath,
    cache: AnyPath,
    config: FromPhotosConfig = FromPhotosConfig(),
    *,
    warn: Warn = log_warning,
    counting: Counting | None = None,
) -> FromPhotos:
    """Poses, intrinsics and points of photos of one scene. Its files lie in ``cache``, where a later call goes on.

    Photos that show nothing, are blurred or cannot be placed are left out and told through ``warn``. The world's
    axes and unit are arbitrary (§10.1.1).

    Raises:
        InputError: too few photos can be used, or can be placed in one model.
    """
    folder, cache = as_path(folder, "the photos' folder"), as_path(cache, "the cache")
    count = counting or silent
    new = not (cache / INDEX).exists()
    gathered = gather(folder, cache, config.photos, count("photos"))
    total = len(gathered.photos) + len(gathered.left_out)
    try:
        _enough(folder, gathered, total)
    except InputError:
        if new:
            forget(cache)
        raise
    with Database.opened(cache, config.motion.features, warn) as database:
        motion = reconstruct(gathered.photos, database, config.motion, count)
        by_name = {photo.name: photo for photo in gathered.photos}
        placed = [by_name[frame.name] for frame in motion.capture.frames]
        landmarks = landmarks_of(motion.model, database, placed, motion.capture)
    write_landmarks(cache / NAME, landmarks)
    left_out = (*gathered.left_out, *((name, "cannot be placed among the others") for name in motion.unplaced))
    _tell(folder, motion, left_out, warn)
    return FromPhotos(motion.capture, landmarks, total, left_out)


def _enough(folder: Path, gathered: Gathered, total: int) -> None:
    if len(gathered.left_out) > _SHARE * total:
        reasons = named([f"{name} {why}" for name, why in gathered.left_out])
        what = f"{len(gathered.left_out)} of its {total} photos cannot be used ({reasons})"
        raise InputError(folder, what, "replace them")
    need_three(folder, len(gathered.photos))


def _tell(folder: Path, motion: Motion, left_out: tuple[tuple[str, str], ...], warn: Warn) -> None:
    for why in dict.fromkeys(why for _, why in left_out):
        names = [name for name, reason in left_out if reason == why]
        warn(f"{folder}: left out, {why}: {named(names)}")
    if len(motion.parts) > 1:
        parts = ", ".join(map(str, motion.parts))
        warn(f"{folder}: the photos fall into separate parts of {parts}; the largest is used")
