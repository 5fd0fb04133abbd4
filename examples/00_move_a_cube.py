"""Fit a field to the packaged photos, tell it from four new ones what moved, and look at the result.

Run: python examples/00_move_a_cube.py [OUT [SCENE]]
SCENE is a folder with before/, after/, eval/ and truth/, as `refield synth` writes it; by default the packaged one.
"""

from __future__ import annotations

import sys
from pathlib import Path

import refield
from refield.evaluate import evaluate, pose_error
from refield.scene.change_files import load_change
from refield.synthetic import sample_folder


def main(out: Path, scene: Path) -> None:
    capture = refield.load_capture(scene / "before")
    print(f"{len(capture.train)} photos to train on, {len(capture.held_out)} held out")
    field = refield.fit_field(capture, on_progress=lambda p: print(f"  step {p.step}: {p.psnr:.1f} dB"))

    photos = refield.load_new_photos(scene / "after", capture)
    change = refield.estimate_change(capture, field, photos, on_stage=print)
    updated = refield.update_field(capture, field, change, on_stage=print)

    truth = load_change(scene / "truth")
    for found, true in zip(change.objects, truth.objects):
        print(f"{found.kind}, confidence {found.confidence:.2f}")
        if found.new_from_old is not None and true.new_from_old is not None:
            centre = true.grid.tight_aabb().mean(0)
            distance, degrees = pose_error(found.new_from_old, true.new_from_old, centre)
            print(f"  off by {100 * distance:.2f} cm and {degrees:.2f} degrees")

    report = evaluate(updated, scene / "eval", old=field)
    print("after: ", report.pooled)
    print("before:", report.pooled_before)
    for view in report.views:
        refield.write_image(out / f"{Path(view.name).stem}.png", view.render)
    print(f"pictures in {out}")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(Path(given[0] if given else "moved-cube"), Path(given[1]) if given[1:] else sample_folder())
