"""A visit's page: one HTML text with its style, its few lines of script and its pictures inside.

It is complete without the script, which turns pairs of pictures into sliders, enlarges them and shows the scene in 3-D.
Whatever comes from files or from the user passes `html.escape`; the page fetches nothing.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources

from refield.report import words
from refield.report.plan import Thing, plan
from refield.report.space import space
from refield.report.tables import technical
from refield.report.views import ALL_PIXELS, MOST_VIEWS, card, legend, pictures_in, spots_in
from refield.report.visit import Comparison, VisitReport
from refield.scene.change import ObjectChange
from refield.scene.world import World

GENERATOR = '<meta name="generator" content="refield">'
"""by which a page of ours is known"""
NEXT = ("<!--next-->", "<!--/next-->")
"""between these the next visit is linked once there is one (`refield.report.write.link_next`)"""
_PLAN_NOTE = (
    "The scene from above, seen as the first new photo looks. Dashed: where a thing was. Filled: where it is now. "
    "Wedges: where the new photos were taken."
)
_PLAN_ALONE = "The scene from above. Dashed: where a thing was. Filled: where it is now."
_BY_HAND = "Before and after, from where old photos were taken"


def html_page(report: VisitReport) -> str:
    """The whole page."""
    return document(report.title, (part for part in _parts(report) if part))


def document(title: str, parts: Iterable[str]) -> str:
    """A page of ours around its parts."""
    style, script = _resource("style.css"), _resource("page.js") + _resource("space.js")
    # no other script runs, whatever a text from outside holds
    known = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none';"
        f" script-src 'sha256-{known}'"
    )
    head = (
        f'<meta charset="utf-8"><title>{escape(title)}</title>{GENERATOR}'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><style>{style}</style>'
    )
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body><main>\n{body}\n</main>'
        f"<script>{script}</script></body></html>\n"
    )


def thing(number: int, o: ObjectChange, world: World | None, again: str = "") -> str:
    """An item of a list: one object in words, how sure it is, and why; ``again``: a further sentence."""
    told = [f'<span class="kind {o.kind}">{words.KINDS[o.kind]}</span>, {escape(words.sure(o.confidence))}']
    around = words.give_or_take(o, world)
    told += [escape(around)] if around else []
    why = f'<p class="soft">Why: {escape(o.note)}.</p>' if o.note else ""
    said = f'<p class="said">{escape(words.sentence(number, o, world))}</p>'
    badge = f'<b class="no {o.kind}" aria-hidden="true">{number}</b>'
    more = f"<p>{escape(again)}</p>" if again else ""
    return f"<li>{badge}{said}<p>{'; '.join(told)}</p>{more}{why}</li>"


def _resource(name: str) -> str:
    return resources.files("refield.report").joinpath(name).read_text(encoding="utf-8")


def _parts(report: VisitReport) -> Iterable[str]:
    objects, world = report.change.objects, report.world
    yield _header(report)
    yield _warnings(report.warnings)
    cameras = [(f"photo {i}", frame) for i, frame in enumerate(report.change.frames, 1)]
    things = [Thing(str(n), o) for n, o in enumerate(objects, 1)]
    note = _PLAN_NOTE if cameras else _PLAN_ALONE
    yield _changed(objects, world, plan(things, world, cameras, report.old_frames), note)
    rejected = {p.name for p in report.change.photos if p.status == "rejected"}
    photos = [v for v in report.photos if v.name not in rejected]
    yield space(photos, objects, world)
    views = report.evaluation_views[:MOST_VIEWS]
    most = ALL_PIXELS / max(pictures_in([*photos, *views]), 1)
    heads = (_BY_HAND, "View") if report.change.by_hand else ("New photos", "Photo")
    yield _cards(*heads, photos, report, most)
    yield _rejected(report)
    yield _cards("How true is it? Views that took no part in the update", "View", views, report, most)
    yield _technical(report)


def _header(report: VisitReport) -> str:
    change = report.change
    made = f'<time datetime="{report.made.isoformat(timespec="seconds")}">{words.date(report.made)}</time>'
    used = len(change.frames)
    seen = "by hand" if change.by_hand else f"{used} new photo{'' if used == 1 else 's'}"
    over = f'<p class="over">{escape(report.title)} · {made} · {seen}</p>'
    lead = "".join(f'<p class="lead">{escape(text)}</p>' for text in _lead(report))
    return f"<header>{over}<h1>{escape(words.headline(change))}</h1>{lead}{_links(report)}</header>"


def _lead(report: VisitReport) -> Iterable[str]:
    change = report.change
    if change.unexplained:
        part = "Part of what changed is" if change.objects else "What changed is"
        yield (
            f"{part} not understood: it may be something that bends, flows or shines, or light that changed. It is "
            "marked violet in the photos."
        )
    elif not change.objects:
        yield "In what the new photos show, no object moved, left or arrived. The model stays as it was."
    if not change.objects and change.why:
        yield f"Why: {change.why}."


def _links(report: VisitReport) -> str:
    links = []
    if report.number is not None:
        if report.number > 1:
            links.append(visit_link(report.number - 1, "Previous"))
        links.append("".join(NEXT))
        links.append('<a href="change.json">What changed, for programs (change.json)</a>')
    links.append('<a href="report.json">This report, for programs (report.json)</a>')
    return f'<nav aria-label="Other pages and files">{"".join(links)}</nav>'


def visit_link(number: int, which: str) -> str:
    """A link to a neighbouring visit's page."""
    return f'<a href="../{number:03d}/report.html">{which}: visit {number}</a>'


def _changed(objects: Sequence[ObjectChange], world: World | None, drawing: str, of_plan: str) -> str:
    """The objects in words, beside the plan and what is said of it."""
    if not objects:
        return ""
    items = "".join(thing(number, o, world) for number, o in enumerate(objects, 1))
    figure = f'<figure class="map card">{drawing}<figcaption>{of_plan}</figcaption></figure>' if drawing else ""
    note = f'<p class="soft">{escape(words.scale_note(world))}</p>'
    return (
        f'<h2>What changed</h2><div class="changed"><div><ol class="things card">{items}</ol>{note}</div>{figure}</div>'
    )


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return ""
    items = "".join(f"<li>{escape(w)}</li>" for w in warnings)
    return f'<h2>Please note</h2><div class="card warn"><ul class="notes">{items}</ul></div>'


def _cards(title: str, noun: str, views: Sequence[Comparison], report: VisitReport, most: float) -> str:
    """A heading and a card per view, each of whose pictures has so many pixels at ``most``."""
    shown = "".join(
        card(
            f"{noun} {i} ({v.name.rpartition('/')[2]})",
            v,
            spots_in(v.frame, report.change.objects, report.world),
            most,
        )
        for i, v in enumerate(views, 1)
    )
    return f"<h2>{escape(title)}</h2>{legend(views)}{shown}" if shown else ""


def _rejected(report: VisitReport) -> str:
    """Photos that could not be used, with the reason."""
    rejected = [p for p in report.change.photos if p.status == "rejected"]
    if not rejected:
        return ""
    items = "".join(f"<li>{escape(p.name)}: {escape(p.why or 'no reason given')}</li>" for p in rejected)
    return f'<h2>Photos that could not be used</h2><div class="card warn"><ul class="notes">{items}</ul></div>'


def _technical(report: VisitReport) -> str:
    tables = [(title, content) for title, content in technical(report) if content]
    why = f"<h3>Why</h3><p>{escape(report.change.why)}</p>" if report.change.why and report.change.objects else ""
    inner = why + "".join(f"<h3>{title}</h3>{content}" for title, content in tables)
    return f"<details><summary>Technical: numbers and seconds</summary>{inner}</details>" if inner else ""
