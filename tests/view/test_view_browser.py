"""The viewer in a real browser: Chromium, headless, which draws without a graphics card."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import refield
from refield.cli import main
from refield.scene.pose import exp, transform
from refield.workspace import Workspace
from tests.browser import needs_chromium
from tests.export.solid import make_workspace

pytest.importorskip("playwright.sync_api", reason="needs playwright (pip install 'refield[dev]')")
pytest.importorskip("viser", reason="needs viser (pip install 'refield[view]')")
pytestmark = [
    needs_chromium,
    pytest.mark.chain,
]

AWAY = exp(torch.tensor([0.8, 0.1, 0.0, 0.0, 0.0, 0.3], dtype=torch.float64))
SIZE = {"width": 900, "height": 420}
FREE = {"x": 0, "y": 190, "width": 560, "height": 230}  # pixels that no control and no notification covers
PATIENCE = 240.0  # seconds, on a machine that has other things to do


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The box on its slab, which somebody moved: visit 2."""
    folder = tmp_path_factory.mktemp("viewed")
    make_workspace(folder)
    scene = refield.open(folder / "work")
    thing = scene.thing_at(torch.tensor([0.1, 0.1, 0.25]))
    assert thing is not None
    scene.move(thing, AWAY)
    return folder / "work"


def picture(page: Any) -> np.ndarray:
    """What the part of the page shows that no control covers."""
    shot = page.screenshot(clip=FREE, timeout=1000 * PATIENCE)
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def settled(page: Any) -> np.ndarray:
    """The picture once it stays as it is."""
    before = picture(page)
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        page.wait_for_timeout(500)
        now = picture(page)
        if differ(now, before) == 0:
            return now
        before = now
    raise AssertionError("the picture does not come to rest")


def eventually(happens: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not happens():
        assert time.monotonic() < end, "it has not happened"
        time.sleep(0.1)


def differ(a: np.ndarray, b: np.ndarray) -> float:
    """The part of two pictures that is not the same."""
    return float((np.abs(a - b).max(-1) > 12).mean())


def nearer(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> bool:
    """Whether a picture is much more like one than like another; the browser draws lines a little off now and then."""
    return differ(a, b) < 0.5 * differ(a, c)


def enter(box: Any, number: int) -> None:
    """Type a number beside its slider."""
    box.fill(str(number))
    box.press("Enter")
    box.blur()


def opened(browser: Any, address: str, **more: Any) -> tuple[Any, list[str]]:
    page = browser.new_context(viewport=SIZE, **more).new_page()
    page.set_default_timeout(1000 * PATIENCE)
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(address)
    page.wait_for_selector("canvas[data-engine]", state="attached")
    return page, faults


def test_it_is_looked_at_wiped_and_moved(browser: Any, work: Path, tmp_path: Path) -> None:
    from refield.view.server import Viewer

    shutil.copytree(work, tmp_path / "work")
    with Viewer(Workspace.open(tmp_path / "work"), pytest.fail, port=0, splats=2000) as viewer:
        viewer.prepare()
        page, faults = opened(browser, viewer.url)
        eventually(lambda: len(viewer._sessions) == 1)
        (session,) = viewer._sessions.values()
        eventually(lambda: session.finest)
        now = settled(page)
        assert len(np.unique(now.reshape(-1, 3), axis=0)) > 500
        assert page.get_by_text("One object moved, by hand").is_visible()

        # the wipe shows the visit before, where the box stood elsewhere; the slider all of it
        visit, wipe = (page.locator(".mantine-NumberInput-input").nth(i) for i in (0, 1))
        enter(wipe, 100)
        eventually(lambda: session.panel.wipe == 1 and session.finest and differ(picture(page), now) > 0.03)
        wiped = settled(page)
        enter(wipe, 0)
        eventually(lambda: session.panel.wipe == 0 and session.finest and nearer(picture(page), now, wiped))
        enter(visit, 1)
        page.get_by_text("One object moved, one is gone, one is new").wait_for()
        eventually(lambda: session.finest and differ(picture(page), now) > 0.03)
        earlier = settled(page)
        enter(visit, 2)
        page.get_by_text("One object moved, by hand").wait_for()
        eventually(lambda: session.finest and nearer(picture(page), now, earlier))

        # a click picks the box, an arrow drags it, and the move is kept
        page.get_by_text("Move a thing by hand").click()
        page.get_by_role("button", name="Pick one in the scene").click()
        page.get_by_text("Click on a thing in the scene.").wait_for()
        at = transform(AWAY, torch.tensor([0.0, 0.0, 0.2], dtype=torch.float64))
        page.mouse.click(*pixel(session, at))
        page.get_by_text("Drag it by the arrows").wait_for()
        eventually(lambda: session.mover.held is not None)
        held = session.mover.held.world_from_box
        page.wait_for_timeout(1000)
        drag(page, session, held)
        eventually(lambda: session.mover.moved_by > 0.05)
        page.get_by_role("button", name="Save as a visit").click()
        eventually(lambda: Workspace.open(tmp_path / "work").visits == 3)
        page.get_by_text("Kept as visit 3").wait_for()
        (o,) = Workspace.open(tmp_path / "work").change(3, masks=False).objects
        assert o.note == "moved by hand" and float(o.shift.norm()) > 0.05
        page.get_by_role("button", name="Take the last visit back").click()
        page.get_by_text("Visit 3 is taken back.").wait_for()
        assert Workspace.open(tmp_path / "work").visits == 2
        assert faults == []
        page.close()
        eventually(lambda: not viewer._sessions)


def pixel(session: Any, x: torch.Tensor) -> tuple[float, float]:
    """Where the page shows a world point."""
    camera, stage = session.client.camera, session.scenery.stage
    pose = stage.world_pose(camera.wxyz, camera.position)
    local = transform(torch.linalg.inv(pose), x)
    focal = camera.image_height / 2 / np.tan(camera.fov / 2)
    middle = (camera.image_width / 2, camera.image_height / 2)
    return tuple(float(m + focal * local[i] / local[2]) for i, m in enumerate(middle))


def drag(page: Any, session: Any, held: torch.Tensor) -> None:
    """Pull at the arrow of the gizmo that lies squarest to the line of sight."""
    reach = session.mover.reach / session.scenery.stage.scale
    origin = np.array(pixel(session, held[:3, 3]))
    ends = [np.array(pixel(session, held[:3, 3] + 0.85 * reach * held[:3, axis])) for axis in range(2)]
    end = max(ends, key=lambda e: np.linalg.norm(e - origin))
    page.mouse.move(*end)
    page.mouse.down()
    for part in np.linspace(0, 1, 12):
        page.mouse.move(*(end + part * (end - origin)))
        page.wait_for_timeout(50)
    page.mouse.up()


def test_the_page_that_is_sent_needs_nothing(browser: Any, work: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene.html"
    assert main(["view", str(work), "--static", str(out), "--splats", "2000", "--quiet"]) == 0
    page, faults = opened(browser, out.as_uri(), offline=True)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    clock = page.locator(".mantine-NumberInput-input")
    clock.wait_for(state="attached")
    eventually(lambda: clock.input_value() == "18.5")
    page.get_by_text("One object moved, by hand").wait_for()
    now = settled(page)
    assert len(np.unique(now.reshape(-1, 3), axis=0)) > 500
    wiped = page.locator("aside .wipe:visible")
    assert wiped.count() == 1
    slider = wiped.locator("input")
    ends = []
    for value in ("0", "100"):  # all of it after, all of it before
        slider.fill(value)
        shot = wiped.locator("div").screenshot(timeout=1000 * PATIENCE)
        ends.append(np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int))
    assert differ(*ends) > 0.01
    page.locator("#visit").press("ArrowLeft")
    eventually(lambda: clock.input_value() == "10.5")
    page.get_by_text("One object moved, one is gone, one is new").wait_for()
    eventually(lambda: differ(picture(page), now) > 0.02)
    page.locator("#marks").uncheck()
    eventually(lambda: clock.input_value() == "8.5")
    for width in (1280, 400):
        page.set_viewport_size({"width": width, "height": 500})
        assert page.evaluate("document.documentElement.scrollWidth") == width
        area = page.locator("#root").bounding_box()
        assert area["width"] > 0.6 * width and area["height"] > 200
    assert faults == [] and [u for u in asked if not u.startswith(("data:", "blob:"))] == []
    page.close()
