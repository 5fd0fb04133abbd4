"""Give the update a change that is known (§12.2.2): here the packaged world's truth, or one that you correct.

Run: python examples/03_true_change.py [OUT [SCENE]]
SCENE is a folder with before/, after/, eval/ and truth/, as `refield synth` writes it; by default the packaged one.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import torch

import refield
from refield.evaluate import evaluate
from refield.scene.change_files import load_change
from refield.synthetic import sample_folder


def main(out: Path, scene: Path) -> None:
    capture = refield.load_capture(scene / "before")
    photos = refield.load_new_photos(scene / "after", capture)
    field = refield.fit_field(capture)

    truth = load_change(scene / "truth", capture, photos=photos)
    known = refield.update_field(capture, field, truth)
    print("with the true change:   ", evaluate(known, scene / "eval").pooled)

    # a change is plain data: shift the object by 2 cm and see what that costs
    off = torch.eye(4, dtype=torch.float64)
    off[0, 3] = 0.02
    objects = tuple(
        o if o.new_from_old is None else replace(o, new_from_old=off @ o.new_from_old) for o in truth.objects
    )
    wrong = refield.update_field(capture, field, replace(truth, objects=objects))
    print("with the object 2 cm off:", evaluate(wrong, scene / "eval").pooled)

    view = refield.load_capture(scene / "eval").frames[0]
    refield.write_image(out / "true_change.png", refield.render_frame(known, view).rgb)
    print(f"a picture in {out}")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(Path(given[0] if given else "true-change"), Path(given[1]) if given[1:] else sample_folder())
