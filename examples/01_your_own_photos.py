"""Your own photos, step by step: what `refield train` and `update` do, from Python.

Run: python examples/01_your_own_photos.py BEFORE AFTER OUT
BEFORE and AFTER are folders of photos. Poses that they have (a transforms.json, for BEFORE also a COLMAP model) are
used; where they have none, they are found.
"""

from __future__ import annotations

import sys
from pathlib import Path

import refield
from refield.estimate.localize import kept_landmarks
from refield.field.fit import FitConfig
from refield.photos.landmarks import NAME
from refield.report import Comparison, VisitReport, summary, write_report
from refield.scene.change import PlacedPhoto
from refield.scene.images import frame_image
from refield.scene.load import is_posed
from refield.scene.world import world_of


def main(before: Path, after: Path, out: Path) -> None:
    cache = out / "cache"  # what was found of the photos, so that a second run is quick
    capture = refield.load_capture(before) if is_posed(before) else refield.capture_from_photos(before, cache).capture
    field = refield.fit_field(capture, FitConfig(max_seconds=120), on_progress=print)

    placed = new_photos(after, capture, cache)
    for photo in placed:
        print(photo.name, photo.status, photo.why, photo.placement or "")
    frames = [photo.frame for photo in placed if photo.frame is not None]
    change = refield.estimate_change(capture, field, frames, on_stage=print).among(placed)
    print(summary(change), change.why)
    if not change.objects:
        return
    updated = refield.update_field(capture, field, change, on_stage=print)

    shown = tuple(
        Comparison(
            name=frame.name,
            photo=frame_image(frame),
            before=refield.render_frame(field, frame).rgb,
            after=refield.render_frame(updated, frame).rgb,
            frame=frame,
        )
        for frame in change.frames
    )
    report = VisitReport(before.resolve().name, change, photos=shown, world=world_of(capture))
    print("report:", write_report(out, report))


def new_photos(after: Path, capture: refield.Capture, cache: Path) -> list[PlacedPhoto]:
    """The new photos with poses in the capture's world; some may be rejected."""
    if is_posed(after):
        frames = refield.load_new_photos(after, capture)
        return [PlacedPhoto(frame.name, "used", frame=frame) for frame in frames]
    landmarks = kept_landmarks(cache / NAME, capture, cache)
    return refield.localize_photos(after, refield.known_by(capture, landmarks), cache)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    try:
        main(*(Path(p) for p in sys.argv[1:4]))
    except refield.InputError as error:  # one line: where, what, what to do
        sys.exit(str(error))
