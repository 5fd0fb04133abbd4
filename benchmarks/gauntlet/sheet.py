"""The worst scenes as one picture: old render · photo · render now · error, with what failed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont
from record import Row
from tables.tiles import CAPTION, GAP, SIDE, write_picture

from gauntlet.row import BRIGHTER, STRIP
from gauntlet.summary import badness, verdict

COLUMNS = ("before", "photo", "now", f"absolute error, times {BRIGHTER}")
WORST = 10
_INK = (60, 60, 67)
_LETTER = 7
"""pixels, about, of a letter of a caption"""


def sheet(rows: Sequence[Row], folders: dict[str, Path], path: Path) -> None:
    """``folders``: each scene's, by name. A scene that failed before it had pictures has a caption alone."""
    worst = sorted(rows, key=badness, reverse=True)[:WORST]
    width = len(COLUMNS) * (SIDE + GAP) + GAP
    out = Image.new("RGB", (width, CAPTION + len(worst) * (CAPTION + SIDE + GAP)), "white")
    draw, font = ImageDraw.Draw(out), ImageFont.load_default(13)
    for i, column in enumerate(COLUMNS):
        draw.text((GAP + i * (SIDE + GAP), CAPTION / 2), column, fill=_INK, font=font, anchor="lm")
    for k, row in enumerate(worst):
        top = CAPTION + k * (CAPTION + SIDE + GAP)
        draw.text((GAP, top + CAPTION / 2), _caption(row)[: width // _LETTER], fill=_INK, font=font, anchor="lm")
        strip = folders[row["name"]] / STRIP
        if strip.is_file():
            with Image.open(strip) as picture:
                out.paste(picture, (GAP, top + CAPTION))
    write_picture(path, out)


def _caption(row: Row) -> str:
    psnr = [f"{k[5:]} {row[k]:.1f}" for k in ("psnr_in", "psnr_out", "psnr_untouched") if row.get(k) is not None]
    return " · ".join(part for part in (row["name"], verdict(row), f"{' '.join(psnr)} dB" if psnr else "") if part)
