"""All visits of a scene on one page, made from what they keep: what changed when, in words, a plan, marked photos."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from html import escape

from refield.report import words
from refield.report.page import document, thing
from refield.report.plan import Thing, plan
from refield.report.tables import table
from refield.report.views import ALL_PIXELS, card, legend, pictures_in, spots_in
from refield.report.visit import Comparison
from refield.scene.change import OccupancyGrid, SceneChange
from refield.scene.world import World

_MOST_PHOTOS = 4  # of a visit; its own page has them all
_MOST_CAMERAS = 40  # in the plan
_PLAN_NOTE = (
    "All visits from above. A number such as 2.1 is object 1 of visit 2. Dashed: where a thing was. Filled: where it "
    "was after that visit. Wedges: where new photos were taken; the first of them looks up the page."
)


@dataclass(frozen=True)
class PastVisit:
    """What is known of one visit."""

    number: int
    change: SceneChange
    photos: tuple[Comparison, ...] = ()
    """the new photos with what changed marked; none are kept where nothing changed"""
    made: datetime | None = None
    link: str | None = None
    """to its own page, as seen from this one; None if there is none"""


def history_page(title: str, visits: Sequence[PastVisit], world: World | None) -> str:
    """The whole page; the visits in order."""
    return document(title, (part for part in _parts(title, visits, world) if part))


def earlier_numbers(changes: Sequence[SceneChange]) -> dict[tuple[int, int], tuple[int, int]]:
    """Which objects are known from before: (visit, object) to the (visit, object) that brought it to where it was found
    now, all numbered from 1. A thing is the same where its middle lies in that object's shape."""
    standing: dict[tuple[int, int], OccupancyGrid] = {}
    out: dict[tuple[int, int], tuple[int, int]] = {}
    for visit, change in enumerate(changes, 1):
        arrived: dict[tuple[int, int], OccupancyGrid] = {}
        for number, o in enumerate(change.objects, 1):
            middle = o.grid.tight_aabb().mean(0)
            same = [] if o.kind == "added" else [k for k, grid in standing.items() if bool(grid.contains(middle))]
            if same:
                out[visit, number] = same[-1]
                del standing[same[-1]]
            if o.grid_now is not None:
                arrived[visit, number] = o.grid_now
        standing |= arrived
    return out


def _parts(title: str, visits: Sequence[PastVisit], world: World | None) -> Iterable[str]:
    yield _header(title, visits)
    yield _overview(visits)
    things = [Thing(f"{v.number}.{n}", o) for v in visits for n, o in enumerate(v.change.objects, 1)]
    cameras = [("", frame) for v in visits if v.change.objects for frame in v.change.frames]
    drawing = plan(things, world, cameras[:_MOST_CAMERAS])
    if drawing:
        note = f"{_PLAN_NOTE} {words.scale_note(world)}"
        yield f'<h2>Plan</h2><figure class="map card">{drawing}<figcaption>{escape(note)}</figcaption></figure>'
    elif things:
        yield f'<p class="soft">{escape(words.scale_note(world))}</p>'
    known = earlier_numbers([v.change for v in visits])
    most = ALL_PIXELS / max(sum(pictures_in(v.photos[:_MOST_PHOTOS]) for v in visits), 1)
    for visit in visits:
        yield _visit(visit, world, known, most)


def _header(title: str, visits: Sequence[PastVisit]) -> str:
    dates = [v.made for v in visits if v.made is not None]
    changes = sum(bool(v.change.objects) for v in visits)
    when = ""
    if dates:
        first, last = words.day(dates[0]), words.day(dates[-1])
        when = f" on {first}" if first == last else f" from {first} to {last}"
    count = words.counted(len(visits), "visit")
    lead = f"{count[0].upper()}{count[1:]}{when}; {words.counted(changes, 'visit')} found that things had changed."
    return (
        f'<header><p class="over">{escape(title)}</p><h1>History of the scene</h1><p class="lead">{lead}</p></header>'
    )


def _overview(visits: Sequence[PastVisit]) -> str:
    rows = []
    for v in visits:
        when = "not known" if v.made is None else _time(v.made)
        what = escape(words.headline(v.change))
        rows.append(
            f'<tr><th scope="row"><a href="#visit-{v.number}">Visit {v.number}</a></th><td>{when}</td><td>{what}</td>'
            f'<td class="n">{len(v.change.frames)}</td></tr>'
        )
    heads = ("visit", "when", "what changed", "photos")
    return f'<div class="card">{table("All visits, the first one first", heads, rows, (3,))}</div>'


def _visit(visit: PastVisit, world: World | None, known: dict[tuple[int, int], tuple[int, int]], most: float) -> str:
    change = visit.change
    when = "" if visit.made is None else f"{_time(visit.made)}"
    link = "" if visit.link is None else f'<a href="{escape(visit.link)}">Full report of visit {visit.number}</a>'
    over = f'<p class="over">{" · ".join(p for p in (when, link) if p)}</p>'
    items = []
    for number, o in enumerate(change.objects, 1):
        before = known.get((visit.number, number))
        again = "" if before is None else f"Known from before: object {before[1]} of visit {before[0]}."
        items.append(thing(number, o, world, again))
    listed = f'<ol class="things card">{"".join(items)}</ol>' if items else ""
    why = f"<p>{escape(change.why)}</p>" if change.why and not items else ""
    unclear = "<p>Part of what changed is not understood.</p>" if items and change.unexplained else ""
    photos = "".join(
        card(f"Photo {i} ({v.name.rpartition('/')[2]})", v, spots_in(v.frame, change.objects, world), most)
        for i, v in enumerate(visit.photos[:_MOST_PHOTOS], 1)
    )
    colours = legend(visit.photos[:_MOST_PHOTOS])
    title = f"Visit {visit.number}: {words.headline(change)}"
    return (
        f'<section class="visit" id="visit-{visit.number}"><h2>{escape(title)}</h2>{over}{why}{listed}{unclear}'
        f'{colours}<div class="photos">{photos}</div></section>'
    )


def _time(moment: datetime) -> str:
    return f'<time datetime="{moment.isoformat(timespec="seconds")}">{words.date(moment)}</time>'
