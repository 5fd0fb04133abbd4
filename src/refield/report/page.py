"""The page itself: one HTML text, with its style, its few lines of script and its pictures inside.

Whatever comes from files or from the user passes `html.escape`; the page fetches nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources

from refield.report.pictures import data_uri, with_masks
from refield.report.tables import bars, chips, objects_table, placements_table, scores_table
from refield.report.visit import Comparison, VisitReport, summary

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
_SCRIPT = (
    "document.querySelectorAll('.slide input').forEach(i=>"
    "i.addEventListener('input',()=>i.parentElement.style.setProperty('--at',i.value+'%')))"
)
_KEY = (
    '<p class="lead"><span class="key in"></span>there now &nbsp; <span class="key out"></span>no longer there'
    ' &nbsp; <span class="key unclear"></span>not understood</p>'
)


def html_page(report: VisitReport) -> str:
    """The whole page."""
    style = resources.files("refield.report").joinpath("style.css").read_text(encoding="utf-8")
    head = (
        f'<meta charset="utf-8"><title>{escape(report.title)}</title>'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><style>{style}</style>'
    )
    body = "\n".join(part for part in _parts(report) if part)
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body><main>\n{body}\n</main>'
        f"<script>{_SCRIPT}</script></body></html>\n"
    )


def _parts(report: VisitReport) -> Iterable[str]:
    yield _header(report)
    yield _warnings(report.warnings)
    yield _slider(report)
    yield _section("What changed", objects_table(report.change.objects, report.world))
    yield _section("New photos", _photos(report))
    yield _section("Views that took no part in the update", _views(report.evaluation_views, "truth"))
    if report.evaluation is not None:
        yield _section("Numbers", scores_table(report.evaluation))
    yield _section("Seconds", bars(report.seconds))
    yield _footer(report)


def _header(report: VisitReport) -> str:
    why = f'<p class="lead">{escape(report.change.why)}</p>' if report.change.why else ""
    title = f'<p class="over">{escape(report.title)}</p>'
    return f"<header>{title}<h1>{escape(summary(report.change))}</h1>{why}{chips(report)}</header>"


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return ""
    items = "".join(f"<li>{escape(w)}</li>" for w in warnings)
    return f'<h2>Please note</h2><div class="card warn"><ul class="notes">{items}</ul></div>'


def _slider(report: VisitReport) -> str:
    """The first view of which both fields' renders are known, to slide over."""
    for view in (*report.evaluation_views, *report.photos):
        if view.before is not None and view.after is not None:
            aspect = view.before.shape[1] / view.before.shape[0]
            return (
                f'<h2>Before and after</h2><div class="slide" style="--aspect:{aspect:.4f}">'
                f'<img alt="before the update" src="{data_uri(view.before)}">'
                f'<img alt="after the update" src="{data_uri(view.after)}">'
                '<span class="l">before</span><span class="r">after</span>'
                '<input type="range" min="0" max="100" value="50" aria-label="before or after"></div>'
            )
    return ""


def _photos(report: VisitReport) -> str:
    """Used photos with their pictures, rejected ones with the reason."""
    rejected = {p.name: p.why for p in report.change.photos if p.status == "rejected"}
    shown = _views([v for v in report.photos if v.name not in rejected], "new photo")
    shown += placements_table(report.change.photos)
    if not rejected:
        return shown
    items = "".join(f"<li>{escape(n)}: {escape(why or 'no reason given')}</li>" for n, why in rejected.items())
    return f'{shown}<div class="card warn"><h3>Rejected</h3><ul class="notes">{items}</ul></div>'


def _views(views: Sequence[Comparison], photo_name: str) -> str:
    cards = "".join(_card(view, photo_name) for view in views)
    masked = any(v.marked for v in views)
    return (_KEY if masked and cards else "") + cards


def _card(view: Comparison, photo_name: str) -> str:
    pictures = [("before", view.before), (photo_name, view.photo), ("updated", view.after)]
    if view.photo is not None and view.marked:
        pictures.append(("changed pixels", with_masks(view.photo, view.mask_in, view.mask_out, view.unclear)))
    figures = "".join(
        f'<figure><img alt="{escape(f"{view.name}: {name}")}" src="{data_uri(picture)}">'
        f"<figcaption>{escape(name)}</figcaption></figure>"
        for name, picture in pictures
        if picture is not None
    )
    return f'<div class="card"><h3>{escape(view.name)}</h3><div class="panels">{figures}</div></div>'


def _section(title: str, content: str) -> str:
    return f"<h2>{escape(title)}</h2>{content}" if content else ""


def _footer(report: VisitReport) -> str:
    told = " · ".join(f"{escape(name)} {escape(version)}" for name, version in report.versions.items())
    return f"<footer>{told}</footer>"
