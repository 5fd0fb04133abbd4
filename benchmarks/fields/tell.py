"""Rows as tables in Markdown, to go into ``docs/results.md`` as they are."""

from __future__ import annotations

import bisect
from collections.abc import Sequence

from record import Row, markdown

TIMES = (5, 10, 20, 30, 45, 60, 90, 120, 180, 240, 300, 450, 600, 900, 1200, 1800)
"""seconds of training at which curves are told"""
_LEVELS = (15, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 30, 32, 34)
_MOST = 7  # columns of either
MEASURES = """Over the photos left out of the fit (every tenth). *Held-out*: a photo's exposure (three gains in linear
light, nothing else) is fitted on its left half, PSNR is of its right half, the mean over photos; *pooled*: of all those
pixels together; *as rendered*: the same right halves, no exposure fitted. *Sharpness*: root of the energy between 1/8
and 1/4 cycles a pixel, render over photo, right halves. *Floaters*: pixels in which more than a tenth of the light is
stopped at less than half of the distance at which the other photos show anything there."""


def fits_table(rows: Sequence[Row]) -> str:
    """A line for each fit."""
    return markdown([_line(row) for row in rows])


def _line(row: Row) -> Row:
    head: Row = {"capture": row["name"], "fit": row["how"]}
    if "failed" in row:
        return head | {"held-out, dB": f"failed: {row['failed']}"}
    share = row["floaters"]
    cells: dict[str, str | None] = {
        "held-out, dB": _fixed(row["heldout"], 2),
        "pooled": _fixed(row["heldout pooled"], 2),
        "as rendered": _fixed(row["no exposure fitted"], 2),
        "sharpness": _fixed(row["sharpness"], 2),
        "floaters, %": _fixed(100 * share, 2),
        "photos (left out)": f"{row['photos']} ({row['left out']})",
        "poses, s": _fixed(row.get("poses"), 0),
        "fit, s": _fixed(row.get("fit"), 0),
        "whole, s": _fixed(row.get("whole"), 0),
        "peak, GB": _fixed(row.get("peak"), 2),
    }
    return head | cells


def _fixed(value: float | None, digits: int) -> str | None:
    return None if value is None or value != value else f"{value:.{digits}f}"


def curves_tables(rows: Sequence[Row]) -> str | None:
    """PSNR over time as the fits told it, those of a capture below each other; None if none told anything."""
    known = [row for row in rows if row.get("looks")]
    if not known:
        return None
    until = max(row["looks"][-1]["seconds"] for row in known)
    times = [t for t in TIMES if t < until][-_MOST:]
    told = [look["psnr"] for row in known for look in row["looks"]]
    levels = [v for v in _LEVELS if min(told) < v <= max(told)][-_MOST:]
    at = markdown([_line_of(row, {f"{t} s": psnr_at(row["looks"], t) for t in times}) | _end(row) for row in known])
    to = markdown([_line_of(row, {f"{v} dB": time_to(row["looks"], v) for v in levels}) for row in known])
    return (
        "PSNR of left-out pixels (pooled, as rendered, dB) over seconds of training; between two looks, their line. "
        f"Seconds hold the looks.\n\n{at}\n\nSeconds to equal PSNR.\n\n{to}"
    )


def _line_of(row: Row, values: dict[str, float | None]) -> Row:
    return {"capture": row["name"], "fit": row["how"]} | {title: _fixed(v, 1) for title, v in values.items()}


def _end(row: Row) -> Row:
    last = row["looks"][-1]
    return {"end": _fixed(last["psnr"], 1), "at, s": _fixed(last["seconds"], 0), "steps": last["step"]}


def psnr_at(looks: Sequence[dict[str, float]], seconds: float) -> float | None:
    """Between the two looks around; None before the first and after the last."""
    times = [look["seconds"] for look in looks]
    i = bisect.bisect_left(times, seconds)
    if i == len(times) or (i == 0 and times[0] > seconds):
        return None
    if i == 0:
        return looks[0]["psnr"]
    a, b = looks[i - 1], looks[i]
    part = (seconds - a["seconds"]) / max(b["seconds"] - a["seconds"], 1e-9)
    return a["psnr"] + part * (b["psnr"] - a["psnr"])


def time_to(looks: Sequence[dict[str, float]], psnr: float) -> float | None:
    """Seconds at which the line through the looks first comes to a value; None if it never does."""
    for k, look in enumerate(looks):
        if look["psnr"] >= psnr:
            if k == 0:
                return look["seconds"]
            a = looks[k - 1]
            part = (psnr - a["psnr"]) / (look["psnr"] - a["psnr"])
            return a["seconds"] + part * (look["seconds"] - a["seconds"])
    return None
