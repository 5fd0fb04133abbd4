"""The report's words, numbers on pictures and plan: the same objects under the same numbers, told as they are."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from refield.report import write_report
from refield.report.page import html_page
from refield.report.plan import Thing, plan
from refield.report.scene_history import PastVisit, earlier_numbers, history_page
from refield.report.views import spots_in
from refield.report.words import headline, length, sentence, stage, sure
from refield.report.write import PAGE, link_next
from refield.scene import pose
from refield.scene.boxes import upright_box
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.world import World
from tests.visit_pages import CAMERA, WORLD, box, frame, moved, objects, visit_report

UNITS = replace(WORLD, metres_per_unit=None)


class Page(HTMLParser):
    """What of a page is asked about here: elements with their attributes, parents and own text."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.elements: list[dict[str, str]] = []
        self.path: list[int] = []
        self.feed(source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        above = " ".join(self.elements[i]["is"] for i in self.path)
        known = {k: v or "" for k, v in attrs}
        self.elements.append({**known, "tag": tag, "is": f"{tag}.{known.get('class', '')}", "in": above, "text": ""})
        if tag not in ("meta", "img", "input"):
            self.path.append(len(self.elements) - 1)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if self.path and self.elements[self.path[-1]]["tag"] == tag:
            self.path.pop()

    def handle_endtag(self, tag: str) -> None:
        self.path.pop()

    def handle_data(self, data: str) -> None:
        for i in self.path:
            self.elements[i]["text"] += data

    def all(self, tag: str, within: str = "") -> list[dict[str, str]]:
        return [e for e in self.elements if e["tag"] == tag and within in e["in"]]


def pages() -> dict[str, str]:
    report = visit_report()
    past = PastVisit(2, report.change, report.photos[:2], report.made, "visits/002/report.html")
    return {"visit": html_page(report), "history": history_page("kitchen", [past], WORLD)}


@pytest.fixture(params=["visit", "history"], scope="module")
def page(request: pytest.FixtureRequest) -> Page:
    return Page(pages()[request.param])


def test_every_table_has_headings_with_a_scope_and_a_caption(page: Page) -> None:
    tables = page.all("table")
    assert tables
    assert all(h.get("scope") in ("col", "row") and h["text"] for h in page.all("th"))
    assert all(c["text"] for c in page.all("caption")) and len(page.all("caption")) == len(tables)
    assert len([h for h in page.all("th", "tbody") if h["scope"] == "row"]) == len(page.all("tr", "tbody"))
    assert {h["scope"] for h in page.all("th", "thead")} == {"col"}


def test_every_picture_is_told_in_words_and_every_control_named(page: Page) -> None:
    pictures = page.all("img")
    assert pictures and all("alt" in p for p in pictures)
    assert all(p["alt"] for p in pictures if p.get("class") != "marks")
    for box_ in page.all("input"):
        assert "label" in box_["in"]
    assert {e["text"].strip() for e in page.all("label")} <= {"what changed", "as it is now"}
    assert all(s.get("aria-label") or s.get("aria-hidden") for s in page.all("svg"))
    (language,) = page.all("html")
    assert language["lang"] == "en"
    heads = [int(e["tag"][1]) for e in page.elements if re.fullmatch(r"h\d", e["tag"])]
    assert heads[0] == 1 and heads.count(1) == 1
    assert all(b - a <= 1 for a, b in pairwise(heads))


def test_numbers_are_the_same_in_words_pictures_and_plan() -> None:
    page = Page(pages()["visit"])
    items = page.all("li", "ol.things")
    said = [re.search(r"Object (\d+), a thing of .*?(moved|no longer|new)", i["text"]) for i in items]
    words = {int(m[1]): m[2] for m in said if m}
    assert words == {1: "moved", 2: "no longer", 3: "new"}
    assert [i["text"][0] for i in items] == ["1", "2", "3"]  # the badge in front
    kinds = {"moved": "moved", "removed": "no longer", "added": "new"}
    badges = page.all("b", "div.stage")
    assert {(int(b["text"]), kinds[b["class"].split()[1]]) for b in badges} == set(words.items())
    drawn = [e["text"] for e in page.all("text", "svg.plan") if e.get("class") == "no"]
    assert drawn == ["1", "2", "3"]
    for picture in page.all("img", "div.half"):
        numbers = set(re.findall(r"\d", picture["alt"].partition(";")[2]))
        assert numbers == ({"1", "2"} if ", before:" in picture["alt"] else {"1", "3"}), picture["alt"]


@pytest.mark.parametrize(
    ("world", "told"),
    [
        (WORLD, "Object 1, a thing of 50 × 40 × 30 cm, moved 40 cm and turned 30° clockwise, seen from above."),
        (
            UNITS,
            "Object 1, a thing of 1.2 × 1.0 × 0.8 units, moved 1.0 units (10 % of the scene) and turned 30° clockwise,"
            " seen from above.",
        ),
        (None, "Object 1, a thing of 1.2 × 0.8 × 1.0 units, moved 1.0 units and turned 30°."),
    ],
)
def test_a_move_is_told_in_the_units_that_are_known(world: World | None, told: str) -> None:
    assert sentence(1, moved(), world) == told


def test_what_a_thing_did_is_told_by_how_well_it_is_known() -> None:
    assert "stayed in its place and turned 30°" in sentence(1, moved(by=0.0), WORLD)
    assert sentence(1, moved(degrees=0.0), WORLD).endswith("moved 40 cm without turning.")
    blind = torch.diag(torch.tensor([1e-8] * 4 + [4.0, 1e-8], dtype=torch.float64))
    assert "do not show how it turned" in sentence(1, replace(moved(), covariance=blind), WORLD)
    rough = torch.eye(6, dtype=torch.float64) * 1e-8
    rough[4, 4] = math.radians(20) ** 2  # a turn of 30 degrees may then be none
    assert "without turning" in sentence(1, replace(moved(), covariance=rough), WORLD)
    up = torch.eye(4, dtype=torch.float64)
    up[1, 3] = -1.0
    assert "moved 40 cm (40 cm up) without" in sentence(1, ObjectChange("moved", box(0.0), up), WORLD)
    tip = pose.exp(torch.tensor([0, 0, 0, 0, 0, math.radians(90)], dtype=torch.float64))
    assert "tipped by 90°" in sentence(1, ObjectChange("moved", box(0.0), tip), WORLD)
    assert [sure(c).split(" (")[0] for c in (0.93, 0.7, 0.4)] == ["sure", "fairly sure", "not sure"]


@pytest.mark.parametrize(
    ("metres", "told"), [(0.0004, "0.40 mm"), (0.012, "12 mm"), (0.058, "5.8 cm"), (0.58, "58 cm"), (1.234, "1.23 m")]
)
def test_lengths_have_the_unit_that_one_would_say(metres: float, told: str) -> None:
    assert length(metres / 0.4, WORLD) == told


def test_headlines() -> None:
    o = objects()
    assert headline(SceneChange(o[:1])) == "One object moved"
    assert headline(SceneChange((o[1], o[1]))) == "Two objects are gone"
    assert headline(SceneChange((o[2],) * 13)) == "13 objects are new"
    assert headline(SceneChange()) == "Nothing changed"
    unclear = torch.ones(2, 2, dtype=torch.bool)
    assert headline(SceneChange(unexplained=(unclear,))) == "Something changed that is not understood"


def test_every_stage_of_an_update_has_words() -> None:
    source = Path(__file__).parents[1] / "src/refield"
    files = [*(source / "estimate").rglob("*.py"), *(source / "update").glob("*.py")]
    files += [*(source / "visits").glob("*.py"), source / "commands" / "train.py"]
    called = {
        n for f in files for n in re.findall(r"\b(?:say|clock\.stage|telling\.stage)\(\"([^\"]+)\"\)", f.read_text())
    }
    assert len(called) > 12
    assert [n for n in called if stage(n) == n] == []


def test_a_box_is_as_small_as_its_footprint_allows() -> None:
    """Of a long thing that stands at 30 degrees to the world's axes."""
    lattice = OccupancyGrid(torch.tensor([[-2.0, -2, -2], [2, 2, 2]]), torch.zeros(81, 81, 81))
    turn = math.radians(30)
    x, _, z = lattice.nodes().unbind(-1)
    y = lattice.nodes()[..., 1]
    along, aside = x * math.cos(turn) + z * math.sin(turn), -x * math.sin(turn) + z * math.cos(turn)
    inner = (along.abs() <= 1.5) & (aside.abs() <= 0.5) & (y.abs() <= 0.25)
    sides = upright_box(replace(lattice, values=inner.float()), torch.tensor(WORLD.up, dtype=torch.float64)).sides
    assert sides == pytest.approx((3.0, 1.0, 0.5), abs=0.12)


def test_badges_lie_on_top_of_their_objects() -> None:
    spots = {(s.number, s.now): s for s in spots_in(frame("a"), objects(), WORLD)}
    assert set(spots) == {(1, False), (1, True), (2, False), (3, True)}
    for (number, now), x in {(1, False): -2.0, (1, True): -1.0, (2, False): 1.0, (3, True): 2.6}.items():
        spot = spots[number, now]
        assert spot.left == pytest.approx(100 * (30 + 40 * x / 6) / CAMERA.width, abs=0.1)
        nearest = 6 - (0.65 if (number, now) == (1, True) else 0.5)  # its upper edge lies 0.375 above its middle
        assert spot.top == pytest.approx(100 * (20 - 0.9 * 40 * 0.375 / nearest) / CAMERA.height, abs=1.0)
    behind = replace(frame("b"), world_from_cam=torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64)))
    assert spots_in(behind, objects(), WORLD) == [] == spots_in(None, objects(), WORLD)


def test_the_plan_is_to_scale_and_seen_as_the_first_photo_looks() -> None:
    drawing = plan([Thing("1", moved(by=2.0))], UNITS, [("photo 1", frame("a"))])
    start = [float(v) for v in re.search(r'class="from" cx="([\d.]+)" cy="([\d.]+)"', drawing).groups()]  # type: ignore[union-attr]
    end = [float(v) for v in re.search(r'class="no" x="([\d.]+)" y="([\d.]+)"', drawing).groups()]  # type: ignore[union-attr]
    bar = float(re.search(r'class="bar" d="[^h]*h([\d.]+)v', drawing)[1])  # type: ignore[index]
    units = float(re.search(r">([\d.]+) units?</text>", drawing)[1])  # type: ignore[index]
    assert end[0] - start[0] == pytest.approx(2 * bar / units, abs=0.3)  # to the right
    assert end[1] - 4.6 == pytest.approx(start[1], abs=0.3)
    camera = [float(v) for v in re.search(r'class="camera" points="([\d.]+),([\d.]+)', drawing).groups()]  # type: ignore[union-attr]
    assert camera[1] > start[1]  # the photographer stands below
    assert plan([Thing("1", moved())], None) == "" == plan([], UNITS)


def test_names_of_photos_do_not_lie_on_each_other() -> None:
    near = [(f"photo {i}", frame(f"{i}", 0.05 * i)) for i in range(1, 5)]
    drawing = plan([Thing("1", moved())], UNITS, near)
    found = re.findall(r'<text x="([\d.]+)" y="([\d.]+)">photo', drawing)
    places = [(float(x), float(y)) for x, y in found]
    assert len(places) == 4
    for i, (x, y) in enumerate(places):
        assert all(abs(x - a) >= 50 or abs(y - b) >= 12 for a, b in places[:i])


def test_visits_link_to_their_neighbours(tmp_path: Path) -> None:
    first = write_report(tmp_path / "001", visit_report(number=1))
    write_report(tmp_path / "002", visit_report(number=2))
    alone = first.read_bytes()
    links = [a["href"] for a in Page(alone.decode()).all("a", "nav")]
    assert links == ["change.json", "report.json"]
    link_next(first, 2)
    link_next(first, 2)
    links = [a["href"] for a in Page(first.read_text()).all("a", "nav")]
    assert links == ["../002/report.html", "change.json", "report.json"]
    assert (first.parent / links[0]).resolve() == (tmp_path / "002" / PAGE).resolve()
    link_next(first, None)
    assert first.read_bytes() == alone
    link_next(tmp_path / "none.html", 3)
    assert not (tmp_path / "none.html").exists()
    elsewhere = Page(html_page(visit_report(number=None)))
    assert [a["href"] for a in elsewhere.all("a", "nav")] == ["report.json"]


def test_things_are_known_again_at_later_visits() -> None:
    first = SceneChange((moved(-2.0, 1.0), ObjectChange("added", box(3.0))))
    second = SceneChange((moved(0.8, 0.5), moved(-1.0, 3.0)))  # something else, and what the first visit moved
    third = SceneChange((ObjectChange("removed", box(3.0)), ObjectChange("added", box(-1.0))))
    fourth = SceneChange((ObjectChange("removed", box(3.0)),))
    assert earlier_numbers([first, second, third, fourth]) == {(2, 2): (1, 1), (3, 1): (1, 2)}


def test_the_history_tells_every_visit() -> None:
    report = visit_report()
    again = SceneChange((moved(-1.0, 0.5),), report.change.photos)
    visits = [
        PastVisit(1, report.change, report.photos[:2], report.made, "visits/001/report.html"),
        PastVisit(2, SceneChange(photos=report.change.photos[:1], why="it all looks as before"), made=report.made),
        PastVisit(3, again, report.photos[:2], None, "visits/003/report.html"),
    ]
    page = Page(history_page("kitchen", visits, WORLD))
    rows = [r["text"] for r in page.all("tr", "tbody")]
    assert len(rows) == 3 and "Nothing changed" in rows[1] and "not known" in rows[2]
    assert [h["text"] for h in page.all("h2", "section.visit")] == [
        "Visit 1: One object moved, one is gone, one is new", "Visit 2: Nothing changed", "Visit 3: One object moved",
    ]  # fmt: skip
    body = page.all("main")[0]["text"]
    assert "it all looks as before" in body and "object 1 of visit 1" in body
    assert "Three visits on 7 March 2026; two visits found" in body
    assert [a["href"] for a in page.all("a", "p.over")] == ["visits/001/report.html", "visits/003/report.html"]
    targets = {a["href"] for a in page.all("a", "table")}
    assert targets == {f"#{s['id']}" for s in page.all("section")}
    assert [e["text"] for e in page.all("text", "svg.plan") if e.get("class") == "no"] == ["1.1", "1.2", "1.3", "3.1"]
