"""Your own photos, step by step: what `refield train`, `update` and `render` do, from Python.

Run: python examples/01_your_own_photos.py BEFORE AFTER OUT
BEFORE and AFTER hold photos and a transforms.json (poses in one world); BEFORE may be a COLMAP model instead.
"""

from __future__ import annotations

import sys
from pathlib import Path

import refield
from refield.field.fit import FitConfig
from refield.report import Comparison, VisitReport, summary, write_report
from refield.scene.images import frame_image


def main(before: Path, after: Path, out: Path) -> None:
    capture = refield.load_capture(before)
    field = refield.fit_field(capture, FitConfig(max_seconds=120), on_progress=print)

    photos = refield.load_new_photos(after, capture)
    change = refield.estimate_change(capture, field, photos, on_stage=print)
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
        )
        for frame in change.frames
    )
    print("report:", write_report(out, VisitReport(before.resolve().name, change, photos=shown)))


if __name__ == "__main__":
    try:
        main(*(Path(p) for p in sys.argv[1:4]))
    except refield.InputError as error:  # one line: where, what, what to do
        sys.exit(str(error))
