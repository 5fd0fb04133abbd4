"""The page's tables: objects, scores, seconds, and the numbers at its head."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from refield.report.visit import VisitReport, lengths, object_shift, turn, uncertainty
from refield.scene.change import ObjectChange, PlacedPhoto
from refield.scene.world import World

_SCORES = {  # key of `refield.evaluate.Scores` -> heading, decimals
    "psnr_in": ("PSNR in", 2),
    "psnr_out": ("PSNR out", 2),
    "psnr_untouched": ("PSNR untouched", 2),
    "psnr": ("PSNR all", 2),
    "ssim_in": ("SSIM in", 3),
    "ssim_out": ("SSIM out", 3),
    "lpips_in": ("LPIPS in", 3),
    "lpips_out": ("LPIPS out", 3),
}
_SMALLER_IS_BETTER = ("lpips_in", "lpips_out")
_JUST_VISIBLE = {2: 0.05, 3: 0.002}  # differences below this are shown without a colour


def chips(report: VisitReport) -> str:
    """The numbers at the head of the page."""
    facts = dict(report.facts)
    if report.seconds:
        facts["seconds in all"] = f"{sum(report.seconds.values()):.1f}"
    items = "".join(f"<li>{escape(name)} <b>{escape(_told(value))}</b></li>" for name, value in facts.items())
    return f'<ul class="chips">{items}</ul>' if items else ""


def objects_table(objects: Sequence[ObjectChange], world: World | None = None) -> str:
    """One row per object; lengths in the world's own units, as a part of the scene, and in metres if known."""
    if not objects:
        return ""
    rows = "".join(_object_row(i, o, world) for i, o in enumerate(objects))
    heads = ("", "kind", "its centre moved by", "and turned by", "uncertainty (1 σ)", "confidence", "note")
    scene = "" if world is None else f" The scene is {_number(world.size)} from camera to outermost camera."
    return _table(heads, rows) + f'<p class="lead"><small>Lengths in the units of the capture.{scene}</small></p>'


def placements_table(photos: Sequence[PlacedPhoto]) -> str:
    """How well photos that came without poses were placed; empty if all came with theirs."""
    rows = "".join(
        f'<tr><td>{escape(p.name)}</td><td class="n">{p.placement.inliers} of {p.placement.matches}</td>'
        f'<td class="n">{p.placement.error:.2f}</td><td>{escape(p.placement.camera)}</td></tr>'
        for p in photos
        if p.placement is not None and p.frame is not None
    )
    return _table(("photo", "points that agree", "error, px", "camera"), rows) if rows else ""


def _object_row(index: int, o: ObjectChange, world: World | None) -> str:
    shift, sure = object_shift(o), uncertainty(o)
    moved = turned = spread = "–"
    if o.new_from_old is not None and shift is not None:
        angle, axis = turn(o.new_from_old)
        units = math.hypot(*shift)
        along = f"<small>({', '.join(_number(v if abs(v) > 1e-3 * units else 0.0) for v in shift)})</small>"
        moved = f"{_number(units)}{_told_lengths(units, world)} {along}"
        about = f" <small>about ({', '.join(f'{v:.2f}' for v in axis)})</small>" if any(axis) else ""
        turned = f"{angle:.2f}°{about}"
    if sure is not None:
        spread = f"{_number(sure[0])}, {f'{sure[1]:.2f}°' if sure[1] < 180 else 'any turn'}"
    cells = (f'<span class="kind {o.kind}">{o.kind}</span>', moved, turned, spread, f"{o.confidence:.2f}")
    row = "".join(f"<td>{c}</td>" for c in (index, *cells))
    return f'<tr>{row}<td class="note">{escape(o.note)}</td></tr>'


def _told_lengths(units: float, world: World | None) -> str:
    part, metres = lengths(units, world)
    told = [] if part is None else [f"{100 * part:.1f} % of the scene"]
    told += [] if metres is None else [f"{_number(metres)} m"]
    return f" = {', '.join(told)}" if told else ""


def scores_table(evaluation: Mapping[str, Any]) -> str:
    """``refield.evaluate.Report.to_dict()``: a row per view, two for all; small: the old field."""
    rows = [(str(v["name"]), v["scores"], v.get("before"), "") for v in evaluation.get("views", ())]
    for label, key in (("all pixels together", "pooled"), ("mean of the views", "mean")):
        rows.append((label, evaluation[key], evaluation.get(f"{key}_before"), ' class="all"'))
    shown = [k for k in _SCORES if any(scores.get(k) is not None for _, scores, _, _ in rows)]
    body = "".join(
        f"<tr{style}><td>{escape(name)}</td>{''.join(_score_cell(k, scores, before) for k in shown)}</tr>"
        for name, scores, before, style in rows
    )
    note = "PSNR in dB; SSIM over the masks' boxes. "
    note += "Small: the field before the update." if evaluation.get("pooled_before") else ""
    heads = ("view", *(_SCORES[k][0] for k in shown))
    return _table(heads, body, numeric_from=1) + f'<p class="lead"><small>{note}</small></p>'


def _score_cell(key: str, scores: Mapping[str, Any], before: Mapping[str, Any] | None) -> str:
    value, digits = scores.get(key), _SCORES[key][1]
    if value is None:
        return '<td class="n">–</td>'
    old = None if before is None else before.get(key)
    if old is None:
        return f'<td class="n">{value:.{digits}f}</td>'
    gain = (old - value) if key in _SMALLER_IS_BETTER else (value - old)
    style = "" if abs(gain) < _JUST_VISIBLE[digits] else (" good" if gain > 0 else " bad")
    return f'<td class="n{style}">{value:.{digits}f} <small>{old:.{digits}f}</small></td>'


def bars(seconds: Mapping[str, float]) -> str:
    """Seconds per stage, as bars."""
    if not seconds:
        return ""
    longest = max([*seconds.values(), 1e-9])
    rows = "".join(
        f'<span>{escape(name)}</span><i style="width:{100 * max(s, 0) / longest:.1f}%"></i><b>{s:.1f}</b>'
        for name, s in seconds.items()
    )
    return f'<div class="card"><div class="bars">{rows}</div></div>'


def _table(heads: Sequence[str], rows: str, numeric_from: int = 99) -> str:
    style = ' class="n"'
    cells = "".join(f"<th{style if i >= numeric_from else ''}>{escape(h)}</th>" for i, h in enumerate(heads))
    return f'<div class="card scroll"><table><thead><tr>{cells}</tr></thead><tbody>{rows}</tbody></table></div>'


def _told(value: str | int | float) -> str:
    return _number(value) if isinstance(value, float) else str(value)


def _number(value: float) -> str:
    """Four significant digits, never an exponent for everyday sizes."""
    if not math.isfinite(value):
        return "–"
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        digits = 4 if value == 0 else max(0, min(4, 3 - math.floor(math.log10(abs(value)))))
        return f"{value:.{digits}f}"
    return f"{value:.2e}"
