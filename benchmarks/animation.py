"""The README's animation: the scene of ``refield demo`` as it was and as it is, seen on the same way around it.

    python benchmarks/animation.py WORK [--out docs/images/before_after.webp]

WORK is what ``refield demo WORK`` made. Nothing is shown but what ``refield render`` writes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from refield.cli import main
from refield.scene.film import film

SIDE, GAP, CAPTION = 320, 8, 26
FRAMES, FPS = 72, 12.0
SAID = ("before", "after four new photos")
INK, PAPER = (60, 60, 67), (255, 255, 255)


def pair(pictures: tuple[Path, Path]) -> Image.Image:
    """Both states from one place, side by side under their captions."""
    sheet = Image.new("RGB", (2 * SIDE + GAP, SIDE + CAPTION), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(16)
    for i, (path, said) in enumerate(zip(pictures, SAID)):
        sheet.paste(Image.open(path), (i * (SIDE + GAP), CAPTION))
        draw.text((i * (SIDE + GAP) + 2, 3), said, fill=INK, font=font)
    return sheet


def make(work: Path, out: Path) -> int:
    """Exit code."""
    with tempfile.TemporaryDirectory(prefix="refield-") as folder:
        orbit = ["--orbit", "--frames", str(FRAMES), "--size", str(SIDE)]
        for visit in ("0", "1"):
            code = main(["render", str(work), *orbit, "--visit", visit, "--out", f"{folder}/{visit}"])
            if code:
                return code
        names = sorted(p.name for p in Path(folder, "0").glob("*.png"))
        with film(out, FPS, (2 * SIDE + GAP, SIDE + CAPTION)) as add:
            for name in names:
                add(torch.from_numpy(np.array(pair((Path(folder, "0", name), Path(folder, "1", name))))))
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, metavar="WORK")
    parser.add_argument("--out", type=Path, default=Path("docs/images/before_after.webp"))
    options = parser.parse_args()
    sys.exit(make(options.work, options.out))
