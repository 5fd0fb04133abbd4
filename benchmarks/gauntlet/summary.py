"""Rows as tables: shares with their intervals, quantiles, groups, each scene; and which are the worst."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from record import Row, markdown

_LOST = 0.1
"""dB; untouched pixels that lose more are worth a count"""
_QUANTILES = {"10th": 0.1, "median": 0.5, "90th": 0.9}
_WILSON = 1.96
"""standard deviations: 95 %"""


def failed(row: Row, *how: str) -> bool:
    """Whether a command of the scene failed, in one of these ways if any are named."""
    fault = row.get("failed")
    return fault is not None and (not how or fault["how"] in how)


def badness(row: Row) -> tuple[float, ...]:
    """For sorting, the worst first by the largest: a crash, a refusal, wrong kinds, then by the lowest PSNR."""
    if failed(row, "crashed", "stopped", "died"):
        rank = 3
    elif failed(row):
        rank = 2
    else:
        rank = int(row.get("right") is False or bool(row.get("not understood")))
    known = [v for k in ("psnr_in", "psnr_out", "psnr_untouched", "psnr") if (v := row.get(k)) is not None]
    return (rank, -min(known)) if known else (rank, math.inf)


def verdict(row: Row) -> str:
    """What is wrong with a scene, in a few words."""
    if failed(row):
        fault = row["failed"]
        return f"{fault['command']} {fault['how']}: {fault['why']}"
    if row.get("right") is False:
        said = [f"{what} {row[what]}" for what in ("false", "pieces", "missed") if row.get(what)]
        wrong = [f"{o['true']} taken for {o['told']}" for o in row["objects"] if o["told"] not in (None, o["true"])]
        unclear = ["not understood"] if row.get("not understood") else []
        return ", ".join([*wrong, *said, *unclear])
    return "not understood" if row.get("not understood") else ""


def kinds(told: Sequence[str] | None) -> str:
    if told is None:
        return "–"
    return ", ".join(f"{told.count(k)} {k}" for k in dict.fromkeys(told)) or "nothing"


def won(row: Row) -> float | None:
    """dB that untouched pixels have won (lost, if negative); None where that was not measured."""
    now, was = row.get("psnr_untouched"), row.get("psnr_untouched before")
    return None if now is None or was is None else now - was


def rows_table(rows: Sequence[Row]) -> str:
    return markdown([_line(row) for row in rows])


def _line(row: Row) -> Row:
    now, was = row.get("psnr_untouched"), row.get("psnr_untouched before")
    moved = [o for o in row.get("objects", []) if "off" in o]
    return {
        "scene": row["name"],
        **{k: str(row["facts"][k]) for k in ("path", "place") if k in row.get("facts", {})},
        "true": kinds(row.get("true")),
        "told": kinds(row.get("told")),
        "off, % of the distance": " ".join(f"{o['off, % of distance']:.2f}" for o in moved) or None,
        "off, °": " ".join(f"{o['off, °']:.2f}" for o in moved if "off, °" in o) or None,
        "PSNR-in": row.get("psnr_in"),
        "-out": row.get("psnr_out"),
        "untouched (before)": None if now is None or was is None else f"{now:.2f} ({was:.2f})",
        "IoU of masks, in": row.get("mask-in"),
        "out": row.get("mask-out"),
        "held-out": row.get("held-out"),
        "train, s": row["seconds"].get("train"),
        "update, s": row["seconds"].get("update"),
        "what failed": verdict(row),
    }


# --- over all ---


_MEASURES: dict[str, Callable[[Row], Iterable[Any]]] = {
    "PSNR-in, dB": lambda r: [r.get("psnr_in")],
    "PSNR-out, dB": lambda r: [r.get("psnr_out")],
    "untouched, dB": lambda r: [r.get("psnr_untouched")],
    "untouched, after less before, dB": lambda r: [won(r)],
    "whole views, dB": lambda r: [r.get("psnr")],
    "held-out of the first field, dB": lambda r: [r.get("held-out")],
    "moved objects, off, % of the distance": lambda r: [o.get("off, % of distance") for o in r.get("objects", [])],
    "moved objects, off, °": lambda r: [o.get("off, °") for o in r.get("objects", [])],
    "IoU of masks, in": lambda r: [r.get("mask-in")],
    "IoU of masks, out": lambda r: [r.get("mask-out")],
    "train, s": lambda r: [r["seconds"].get("train")],
    "update, s": lambda r: [r["seconds"].get("update")],
}


def quantiles_table(rows: Sequence[Row]) -> str:
    lines: list[Row] = []
    for name, of in _MEASURES.items():
        known = [v for row in rows for v in of(row) if v is not None]
        if known:
            at = np.quantile(known, list(_QUANTILES.values()))
            lines.append({"": name, "of": len(known)} | {q: float(v) for q, v in zip(_QUANTILES, at)})
    return markdown(lines)


def shares_table(rows: Sequence[Row]) -> str:
    known = told(rows)
    changed, same = ([r for r in known if "true" in r and bool(r["true"]) == some] for some in (True, False))
    measured = [r for r in rows if won(r) is not None]
    lines = [
        _share("a traceback", rows, lambda r: failed(r, "crashed", "died")),
        _share("past the time limit", rows, lambda r: failed(r, "stopped")),
        _share("refused where something changed", changed, lambda r: failed(r, "refused")),
        _share("as many of each kind told as there are", known, lambda r: bool(r.get("same kinds"))),
        _share("each object right, nothing false or not understood", known, lambda r: bool(r.get("right"))),
        _share("false objects where something changed", changed, lambda r: r["false"] > 0),
        _share("false objects where nothing changed", same, lambda r: r["false"] > 0),
        _share("not understood where nothing changed", same, lambda r: bool(r.get("not understood"))),
        _share(f"untouched pixels lose more than {_LOST} dB", measured, lambda r: (won(r) or 0) < -_LOST),
    ]
    return markdown([line for line in lines if line is not None])


def _share(what: str, among: Sequence[Row], of: Callable[[Row], bool]) -> Row | None:
    if not among:
        return None
    count = sum(of(r) for r in among)
    lo, hi = wilson(count, len(among))
    return {
        "scenes with": what,
        "": f"{count} of {len(among)}",
        "share": f"{100 * count / len(among):.0f} %",
        "95 % interval (Wilson)": f"{100 * lo:.0f} to {100 * hi:.0f} %",
    }


def wilson(count: int, of: int) -> tuple[float, float]:
    """The interval for a share that was seen ``count`` times among ``of`` (Wilson 1927)."""
    z, p = _WILSON, count / of
    middle = p + z * z / (2 * of)
    half = z * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    scale = 1 + z * z / of
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def groups_table(rows: Sequence[Row], by: str) -> str | None:
    """The main figures for each value of a fact ("path", "place") or of what changed ("change")."""
    known = told(rows)
    values = {id(r): _value(r, by) for r in known}
    names = sorted(set(values.values()))
    if not names or (by != "change" and names == ["–"]):
        return None
    return markdown([_group(by, name, [r for r in known if values[id(r)] == name]) for name in names])


def _value(row: Row, by: str) -> str:
    facts = row.get("facts", {})
    if by == "change":
        return ", ".join(facts["changes"]) or "nothing" if "changes" in facts else kinds(row.get("true"))
    return str(facts.get(by, "–"))


def told(rows: Sequence[Row]) -> list[Row]:
    """Those of which the truth is known, or was not reached."""
    return [r for r in rows if "right" in r or failed(r)]


def _group(by: str, name: str, mine: Sequence[Row]) -> Row:
    right = sum(bool(r.get("right")) for r in mine)
    lo, hi = wilson(right, len(mine))
    line: Row = {by: name, "scenes": len(mine), "right": f"{right} ({100 * lo:.0f} to {100 * hi:.0f} %)"}
    line["failed"] = sum(failed(r) for r in mine)
    for measure in ("PSNR-in, dB", "PSNR-out, dB", "untouched, after less before, dB"):
        line[f"{measure}, median"] = _median(mine, measure)
    for measure in ("moved objects, off, % of the distance", "moved objects, off, °"):
        line[f"{measure.removeprefix('moved objects, ')}, median"] = _median(mine, measure)
    return line


def _median(rows: Sequence[Row], measure: str) -> float | None:
    known = [v for row in rows for v in _MEASURES[measure](row) if v is not None]
    return float(np.median(known)) if known else None
