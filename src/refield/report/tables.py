"""The page's numbers, as tables with headings that say what they head: objects, photos' poses, scores, seconds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from refield.report.visit import VisitReport, lengths, object_shift, turn, uncertainty
from refield.report.words import KINDS, stage
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


def technical(report: VisitReport) -> Sequence[tuple[str, str]]:
    """Everything in numbers: headings and tables; those of which nothing is known are empty."""
    return (
        ("Objects", objects_table(report.change.objects, report.world)),
        ("Where the new photos were taken", placements_table(report.change.photos)),
        ("Measured on photos that took no part", "" if report.evaluation is None else scores_table(report.evaluation)),
        ("Further numbers", _pairs("Numbers of this visit", report.facts)),
        ("Time", seconds_table(report.seconds)),
        ("Made with", _pairs("Versions", report.versions)),
    )


def objects_table(objects: Sequence[ObjectChange], world: World | None = None) -> str:
    """One row per object; lengths in the world's own units, as a part of the scene, and in metres if known."""
    if not objects:
        return ""
    rows = [_object_row(i, o, world) for i, o in enumerate(objects, 1)]
    heads = ("object", "kind", "its centre moved by", "and turned by", "uncertainty (1 σ)", "confidence", "why")
    scene = "" if world is None else f" The scene is {_number(world.size)} from camera to outermost camera."
    return table(f"Lengths in the units of the capture.{scene}", heads, rows)


def placements_table(photos: Sequence[PlacedPhoto]) -> str:
    """How well photos that came without poses were placed; empty if all came with theirs."""
    rows = [
        _row(
            escape(p.name),
            _n(f"{p.placement.inliers} of {p.placement.matches}"),
            _n(f"{p.placement.error:.2f}"),
            _td(escape(p.placement.camera)),
        )
        for p in photos
        if p.placement is not None and p.frame is not None
    ]
    heads = ("photo", "points that agree", "error, px", "camera")
    return table("New photos, placed by the points that they show", heads, rows, (1, 2)) if rows else ""


def _object_row(number: int, o: ObjectChange, world: World | None) -> str:
    shift, sure = object_shift(o), uncertainty(o)
    moved = turned = spread = "–"
    if o.new_from_old is not None and shift is not None:
        angle, axis = turn(o.new_from_old)
        units = math.hypot(*shift)
        along = f"<small>({', '.join(_number(v if abs(v) > 1e-3 * units else 0.0) for v in shift)})</small>"
        moved = f"{_number(units)}{_told_lengths(units, world)} {along}"
        rounded = ", ".join(f"{v:.2f}" if abs(v) >= 0.005 else "0.00" for v in axis)
        about = f" <small>about ({rounded})</small>" if any(axis) else ""
        turned = f"{angle:.2f}°{about}"
    if sure is not None:
        spread = f"{_number(sure[0])}, {f'{sure[1]:.2f}°' if sure[1] < 180 else 'any turn'}"
    kind = f'<span class="kind {o.kind}">{KINDS[o.kind]}</span>'
    cells = (_td(c) for c in (kind, moved, turned, spread, f"{o.confidence:.2f}"))
    return _row(f"{number}", *cells, f'<td class="note">{escape(o.note)}</td>')


def _told_lengths(units: float, world: World | None) -> str:
    part, metres = lengths(units, world)
    told = [] if part is None else [f"{100 * part:.1f} % of the scene"]
    told += [] if metres is None else [f"{_number(metres)} m"]
    return f" = {', '.join(told)}" if told else ""


def scores_table(evaluation: Mapping[str, Any]) -> str:
    """``refield.evaluate.Report.to_dict()``: a row per view, two for all; small: the old field."""
    views = [(str(v["name"]), v["scores"], v.get("before"), "") for v in evaluation.get("views", ())]
    for label, key in (("all pixels together", "pooled"), ("mean of the views", "mean")):
        views.append((label, evaluation[key], evaluation.get(f"{key}_before"), "all"))
    shown = [k for k in _SCORES if any(scores.get(k) is not None for _, scores, _, _ in views)]
    rows = [
        _row(escape(name), *(_score_cell(k, scores, before) for k in shown), style=style)
        for name, scores, before, style in views
    ]
    note = "PSNR in dB, SSIM over the masks' boxes; in: where something is now, out: where something was."
    note += " Small: the model before the update." if evaluation.get("pooled_before") else ""
    heads = ("view", *(_SCORES[k][0] for k in shown))
    return table(note, heads, rows, range(1, len(heads)))


def _score_cell(key: str, scores: Mapping[str, Any], before: Mapping[str, Any] | None) -> str:
    value, digits = scores.get(key), _SCORES[key][1]
    if value is None:
        return _n("–")
    old = None if before is None else before.get(key)
    if old is None:
        return _n(f"{value:.{digits}f}")
    gain = (old - value) if key in _SMALLER_IS_BETTER else (value - old)
    style = "" if abs(gain) < _JUST_VISIBLE[digits] else (" good" if gain > 0 else " bad")
    return f'<td class="n{style}">{value:.{digits}f} <small>{old:.{digits}f}</small></td>'


def seconds_table(seconds: Mapping[str, float]) -> str:
    """Seconds per stage: what was done, and its name as in ``report.json``."""
    if not seconds:
        return ""
    longest = max([*seconds.values(), 1e-9])
    rows = []
    for name, s in seconds.items():
        told = escape(stage(name)) + (f" <small>{escape(name)}</small>" if stage(name) != name else "")
        bar = f'<td class="bar"><i style="width:{100 * max(s, 0) / longest:.1f}%"></i></td>'
        rows.append(_row(told, _n(f"{s:.1f}"), bar))
    rows.append(_row("all together", _n(f"{sum(seconds.values()):.1f}"), "<td></td>", style="all"))
    return table("How long each step took", ("step", "seconds", ""), rows, (1,))


def table(caption: str, heads: Sequence[str], rows: Sequence[str], numeric: Sequence[int] = ()) -> str:
    """A table that scrolls on its own where the screen is narrow; ``rows`` begin with their headings."""
    cells = "".join(
        f'<th scope="col"{" class=n" if i in numeric else ""}>{escape(h)}</th>' if h else "<td></td>"
        for i, h in enumerate(heads)
    )
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{cells}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _pairs(caption: str, values: Mapping[str, str | int | float] | Mapping[str, str]) -> str:
    rows = [_row(escape(name), _td(escape(_told(value)))) for name, value in values.items()]
    return table(caption, ("what", "value"), rows) if rows else ""


def _row(head: str, *cells: str, style: str = "") -> str:
    return f'<tr{f" class={style}" if style else ""}><th scope="row">{head}</th>{"".join(cells)}</tr>'


def _td(text: str) -> str:
    return f"<td>{text}</td>"


def _n(text: str) -> str:
    return f'<td class="n">{text}</td>'


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
