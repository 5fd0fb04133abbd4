"""The report in a real browser: Chromium, headless, without a network."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from refield.report import PastVisit, history_page, write_report
from tests.browser import needs_chromium
from tests.visit_pages import WORLD, visit_report

pytest.importorskip("playwright.sync_api", reason="needs playwright (pip install 'refield[dev]')")
pytestmark = needs_chromium

CONTRASTS = """() => {
  const parse = (text) => {
    const v = text.match(/[\\d.]+/g).map(Number);
    return { rgb: v.slice(0, 3), a: v.length > 3 ? v[3] : 1 };
  };
  const over = (top, below) => top.rgb.map((c, i) => c * top.a + below[i] * (1 - top.a));
  const light = (rgb) => {
    const [r, g, b] = rgb.map((c) => c / 255).map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ratio = (a, b) => (Math.max(light(a), light(b)) + 0.05) / (Math.min(light(a), light(b)) + 0.05);
  const behind = (element) => {  // what may lie behind a text: pictures may hold anything
    const layers = [];
    let at = element;
    for (; at; at = at.parentElement) {
      const layer = parse(getComputedStyle(at).backgroundColor);
      layers.unshift(layer);
      if (layer.a === 1) break;
      if (at.classList.contains("stage")) break;
    }
    const floor = at && at.classList.contains("stage") ? [[0, 0, 0], [255, 255, 255]] : [[255, 255, 255]];
    return floor.map((rgb) => layers.reduce((below, layer) => over(layer, below), rgb));
  };
  const out = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const element = node.parentElement;
    const shown = element.checkVisibility() && element.getClientRects().length;
    if (!node.data.trim() || !shown || element.tagName === "SCRIPT") continue;
    const style = getComputedStyle(element);
    const svg = element instanceof SVGElement;
    const ink = parse(svg ? style.fill : style.color);
    const badge = svg && element.classList.contains("no");
    const grounds = badge ? [parse(getComputedStyle(element.previousElementSibling).fill).rgb] : behind(element);
    const worst = Math.min(...grounds.map((ground) => ratio(over(ink, ground), ground)));
    out.push([worst, node.data.trim().slice(0, 30), element.className.baseVal ?? element.className]);
  }
  return out.sort((a, b) => a[0] - b[0]);
}"""


@dataclass
class Opened:
    """A page in the browser, and what it complained of or asked for."""

    page: Any
    said: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, report = tmp_path_factory.mktemp("pages"), visit_report()
    past = PastVisit(2, report.change, report.photos[:2], report.made, "visits/002/report.html")
    (folder / "history.html").write_text(history_page("kitchen", [past, past], WORLD), encoding="utf-8")
    return {"visit": write_report(folder / "visits/002", report), "history": folder / "history.html"}


@pytest.fixture
def opened(browser: Any, pages: dict[str, Path]) -> Iterator[Any]:
    contexts = []

    def open_page(name: str, width: int = 1280, **more: Any) -> Opened:
        context = browser.new_context(viewport={"width": width, "height": 800}, offline=True, **more)
        contexts.append(context)
        out = Opened(context.new_page())
        out.page.on("console", lambda message: out.said.append(message.text))
        out.page.on("pageerror", lambda error: out.said.append(str(error)))
        out.page.on("request", lambda request: out.asked.append(request.url))
        out.page.goto(pages[name].as_uri())
        return out

    yield open_page
    for context in contexts:
        context.close()


def colour(page: Any, selector: str, left: float, top: float) -> list[int]:
    """The pixel at a part of an element, as the screen shows it."""
    shot = np.asarray(Image.open(io.BytesIO(page.locator(selector).first.screenshot())).convert("RGB"))
    return [int(v) for v in shot[int(shot.shape[0] * top), int(shot.shape[1] * left)]]


def main_channel(rgb: list[int]) -> str:
    return ("red", "green", "blue")[int(np.argmax(rgb))]


@pytest.mark.parametrize("name", ["visit", "history"])
def test_it_loads_in_silence_and_asks_for_nothing(opened: Any, name: str) -> None:
    it = opened(name)
    it.page.wait_for_load_state("networkidle")
    assert it.said == []
    assert [u for u in it.asked if not u.startswith("data:")] == [it.page.url]
    pictures = it.page.evaluate("[...document.images].map((i) => i.complete && i.naturalWidth)")
    assert len(pictures) > 3 and all(pictures)


def test_the_scene_in_3d_is_turned_and_shows_both_states(opened: Any) -> None:
    page = opened("visit").page
    canvas = page.locator(".space canvas")
    canvas.scroll_into_view_if_needed()
    at = (".space canvas", 0.5, 0.3)
    assert main_channel(colour(page, *at)) == "green"
    page.locator(".space input").uncheck()
    assert main_channel(colour(page, *at)) == "red"
    badges = page.locator(".space .stage .no:visible")
    assert badges.all_inner_texts() == ["1", "1", "2", "3"]
    there = badges.first.bounding_box()["x"]
    place = canvas.bounding_box()
    middle = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 60, middle[1], steps=3)
    page.mouse.up()
    page.wait_for_function(f"document.querySelector('.space .no').getBoundingClientRect().x != {there}")
    turned = colour(page, *at)
    canvas.press("ArrowLeft")
    canvas.press("-")
    page.wait_for_timeout(100)  # a picture
    assert badges.first.bounding_box()["x"] != there and main_channel(turned) == "red"


@pytest.mark.parametrize("width", [1280, 400, 320])
@pytest.mark.parametrize("name", ["visit", "history"])
def test_no_page_scrolls_sideways(opened: Any, name: str, width: int) -> None:
    page = opened(name, width).page
    page.evaluate("document.querySelectorAll('details').forEach((d) => (d.open = true))")
    assert page.evaluate("document.documentElement.scrollWidth") == width
    # and nothing is cut off but what scrolls on its own
    cut = """[...document.querySelectorAll("main *")].filter((e) => !e.closest(".scroll, .stage, svg")
      && e.getBoundingClientRect().right > innerWidth + 1).map((e) => e.outerHTML.slice(0, 80))"""
    assert page.evaluate(cut) == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["visit", "history"])
def test_every_text_can_be_read(opened: Any, name: str, scheme: str) -> None:
    page = opened(name, color_scheme=scheme).page
    page.evaluate("document.querySelectorAll('details').forEach((d) => (d.open = true))")
    contrasts = page.evaluate(CONTRASTS)
    assert len(contrasts) > 40
    assert [c for c in contrasts if c[0] < 4.5] == []
    told = {text for _, text, _ in contrasts}
    assert {"before", "moved"} <= told if name == "visit" else "moved" in told
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (paper == "rgb(250, 250, 249)") == (scheme == "light")


def test_the_slider_wipes_from_before_to_after(opened: Any) -> None:
    page = opened("visit").page
    wipe = page.locator("input[type=range]").first
    assert main_channel(colour(page, ".pair .stage", 0.25, 0.7)) == "red"
    assert main_channel(colour(page, ".pair .stage", 0.75, 0.7)) == "green"
    wipe.focus()
    page.keyboard.press("End")
    assert main_channel(colour(page, ".pair .stage", 0.75, 0.7)) == "red"
    page.keyboard.press("Home")
    assert main_channel(colour(page, ".pair .stage", 0.25, 0.7)) == "green"
    area = wipe.bounding_box()
    page.mouse.click(area["x"] + 0.9 * area["width"], area["y"] + 0.5 * area["height"])
    assert main_channel(colour(page, ".pair .stage", 0.75, 0.7)) == "red"
    assert main_channel(colour(page, ".pair .stage", 0.97, 0.7)) == "green"


def test_marks_come_and_go(opened: Any) -> None:
    page = opened("visit").page
    # in the masked part of the photo, between the badges
    marked = colour(page, ".photo .stage", 0.38, 0.6)
    assert page.locator(".photo .no").first.is_visible()
    page.locator(".switch").first.focus()
    page.keyboard.press("Space")
    bare = colour(page, ".photo .stage", 0.38, 0.6)
    assert main_channel(bare) == "blue" and abs(bare[1] - bare[0]) < 10
    assert marked[1] - marked[0] > 25  # blue-green over grey
    assert not page.locator(".photo .no").first.is_visible()


def wait_until_put_back(page: Any) -> None:
    """A dialog says that it is closed in a task of its own, after the key or the click has returned."""
    page.locator("dialog figure").wait_for(state="detached")


def test_pictures_are_enlarged_by_keyboard(opened: Any) -> None:
    page = opened("visit").page
    small = page.locator(".pair .stage").first.bounding_box()["width"]
    for _ in range(40):
        page.keyboard.press("Tab")
        if "Photo 1" in page.evaluate("document.activeElement.getAttribute('aria-label') ?? ''"):
            break
    name = page.evaluate("document.activeElement.getAttribute('aria-label')")
    assert name == "Enlarge Photo 1 (a.png): before and after"
    page.keyboard.press("Enter")
    large = page.locator("dialog[open] .pair .stage")
    assert large.bounding_box()["width"] > 1.5 * small
    page.keyboard.press("Tab")
    page.keyboard.press("End")  # the slider is there too
    assert main_channel(colour(page, "dialog .pair .stage", 0.75, 0.7)) == "red"
    page.keyboard.press("Escape")
    wait_until_put_back(page)
    assert page.locator("dialog[open]").count() == 0
    assert page.evaluate("document.activeElement.getAttribute('aria-label')") == name
    assert page.locator("main .pair .stage").first.bounding_box()["width"] == small


def test_a_click_on_a_photo_enlarges_it(opened: Any) -> None:
    it = opened("visit", 400)
    it.page.locator(".photo .stage").first.click()
    assert it.page.locator("dialog[open] figure.photo").count() == 1
    assert it.page.evaluate("document.documentElement.scrollWidth") == 400
    it.page.locator(".close").click()
    wait_until_put_back(it.page)
    assert it.page.locator("main figure.photo").count() == 3 and it.said == []


def test_without_script_both_pictures_lie_side_by_side(opened: Any) -> None:
    page = opened("visit", java_script_enabled=False).page
    before, after = (page.locator(".pair .half").nth(i).bounding_box() for i in (0, 1))
    assert before["x"] + before["width"] <= after["x"] and before["width"] == after["width"] > 100
    assert page.locator("button").count() == 0 and page.locator("input[type=range]").count() == 0
    assert page.locator("details table").first.is_hidden()
    page.locator("summary").click()
    assert page.locator("details table").first.is_visible()
