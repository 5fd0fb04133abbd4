"""Photos without poses, placed among those of a workspace."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from refield.estimate.localize import LocalizeConfig, kept_landmarks, known_by, localize_taken, take_in
from refield.photos.sources import find_sources
from refield.photos.taken import PhotoConfig, Taken
from refield.scene.change import PlacedPhoto
from refield.scene.errors import InputError
from refield.scene.left_out import named
from refield.vision.describer import Describer
from refield.visits.telling import Telling
from refield.workspace import Workspace


@dataclass(frozen=True)
class Placing:
    """How photos without poses are taken in and placed."""

    intake: PhotoConfig = field(default_factory=PhotoConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    describer: Describer | None = None
    """which old photos look like a new one; None: VLAD of the capture's own features"""


def placed_photos(
    folder: Path,
    workspace: Workspace,
    telling: Telling,
    how: Placing = Placing(),
    check: Callable[[Taken], None] | None = None,
) -> list[PlacedPhoto]:
    """The photos of ``folder`` in the capture's world; those that cannot be placed are told. Call under the lock.

    ``check`` hears of every new photo before anything is done with the old ones.

    Raises:
        InputError: none can be used, or placed.
    """
    find_sources(folder)  # nothing is made for the sake of photos that are not there
    telling.stage("localize")
    # as given: what is known of the photos' landmarks is of those poses
    capture, cache = workspace.given_capture(), workspace.cache
    with telling.counters() as counting:
        taken = take_in(folder, cache, how.intake, counting)
        if check is not None:
            for photo in taken.photos:
                check(photo)
        landmarks = kept_landmarks(workspace.landmarks, capture, cache, counting)
        known = known_by(capture, landmarks, how.describer, counting)
        placed = localize_taken(taken, known, how.localize, counting)
    rejected = [f"{photo.name} {photo.why}" for photo in placed if photo.frame is None]
    if len(rejected) == len(placed):
        what = f"none of its {len(placed)} photos can be placed ({named(rejected)})"
        raise InputError(folder, what, "do they show the scene that was trained, in its light?")
    for line in rejected:
        telling.warn(f"left out: {line}")
    return placed
