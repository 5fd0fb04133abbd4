"""An updated field is a field: update it again. Here the object goes back to where it was.

Run: python examples/04_update_twice.py [OUT [SCENE]]
SCENE is a folder with before/ and after/, photos with poses; by default the packaged one.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import torch

import refield
from refield.history import retouched
from refield.scene.pose import angle_between
from refield.synthetic import sample_folder


def main(out: Path, scene: Path) -> None:
    capture = refield.load_capture(scene / "before")
    field = refield.fit_field(capture)

    there = refield.load_new_photos(scene / "after", capture)
    first = refield.estimate_change(capture, field, there)
    moved = refield.update_field(capture, field, first)

    back = capture.held_out[:4]  # photos of the first state, which the field has not been trained on
    with tempfile.TemporaryDirectory() as scratch:
        # the old photos show the first state; where that differs, the updated field's picture stands in
        now = retouched(capture, moved, Path(scratch))
        second = refield.estimate_change(now, moved, back)
        returned = refield.update_field(now, moved, second)

    for there_and_back in zip(first.objects, second.objects):
        a, b = (o.new_from_old for o in there_and_back)
        if a is not None and b is not None:
            turn = float(angle_between(b @ a, torch.eye(4, dtype=torch.float64)))
            print(f"there and back: {turn:.2f} degrees left over")
    view = capture.held_out[-1]
    for name, state in (("0_before", field), ("1_moved", moved), ("2_returned", returned)):
        refield.write_image(out / f"{name}.png", refield.render_frame(state, view).rgb)
    print(f"pictures in {out}")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(Path(given[0] if given else "update-twice"), Path(given[1]) if given[1:] else sample_folder())
