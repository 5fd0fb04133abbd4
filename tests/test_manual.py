"""The manual: its pages of options are the commands' own, what it shows can be typed, and it builds without a warning
into pages that fetch nothing."""

from __future__ import annotations

import functools
import importlib.util
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import ModuleType

import pytest

from refield.cli import COMMANDS
from refield.commands.options import kind_of, parsed
from tests.browser import CHROMIUM, needs_chromium
from tests.conftest import HERE
from tests.test_command_line import OPTION, help_of, options_in

ROOT = Path(__file__).parent.parent
WORDS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
OURS = [p for p in WORDS if p.name != "results.md"]  # it tells of the benchmarks' options, too


@functools.cache
def options() -> ModuleType:
    spec = importlib.util.spec_from_file_location("manual_options", ROOT / "docs" / "options.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@functools.cache
def accepted(command: str) -> frozenset[str]:
    """What a command takes, by its own help; `tests/test_command_line.py` holds that against what is parsed."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("COLUMNS", "80")
        return frozenset(options_in(help_of(command, "--help-all")))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_page_holds_every_option_of_its_command(command: str) -> None:
    first = re.findall(r"^\| `(-[^`]*)`", options().page(command), re.MULTILINE)
    assert {name for line in first for name in OPTION.findall(line)} == accepted(command)


def test_what_is_told_of_an_option_is_on_its_page() -> None:
    page = options().page("train")
    assert "| `--fit.max-seconds {None}|FLOAT` | stop after so long. The learning rate" in page and "| `None` |" in page
    assert "| `DATA` | a folder of photos or videos" in page and "refield train work --more" in page
    assert "[`refield undo`](undo.md)" in options().contents()


def typed(page: Path) -> list[str]:
    """The lines of ours that a page shows to be typed."""
    blocks = re.findall(r"```sh\n(.*?)\n *```", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line.strip() for block in blocks for line in re.sub(r"\\\n\s*", "", block).splitlines()]
    parts = [part.strip() for line in lines for part in line.split("&&")]
    return [part.removeprefix(".venv/bin/") for part in parts if re.match(r"(\.venv/bin/)?refield ", part)]


@pytest.mark.parametrize("page", [p for p in WORDS if typed(p)], ids=lambda p: p.name)
def test_what_is_shown_to_be_typed_is_understood(page: Path) -> None:
    for line in typed(page):
        _, command, *arguments = shlex.split(line, comments=True)
        parsed(kind_of(command), arguments, command)


@pytest.mark.parametrize("page", OURS, ids=lambda p: p.name)
def test_options_that_are_spoken_of_are_there(page: Path) -> None:
    known = {"--help", "--help-all"}.union(*map(accepted, COMMANDS))
    known |= {"--dry-run", "--lama", "--local-dir", "--index-url", "--data", "--pipeline.model.implementation"}
    code = re.findall(r"```.*?```|`[^`\n]+`", page.read_text(encoding="utf-8"), re.DOTALL)
    ours = [c for c in code if "benchmarks/" not in c]
    spoken = {name for c in ours for name in re.findall(r"(?<![\w-])--[a-z][\w.-]*[\w]", c)}
    assert not {name for name in spoken - known if not any(k.startswith(f"{name}.") for k in known)}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manual, built as continuous integration builds it."""
    folder = tmp_path_factory.mktemp("manual") / "site"
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(build, cwd=ROOT, env={**HERE, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    return folder


def test_no_page_asks_for_anything_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(COMMANDS) + len(OURS)
    fetched = r"<(?:script|img|iframe|source|link)\b[^>]*?\b(?:src|href)=[\"']?(?:https?:)?//[^\s\"'>]+"
    for page in pages:
        assert not re.findall(fetched, page.read_text(encoding="utf-8")), page
    for style in site.rglob("*.css"):
        assert not re.findall(r"url\([\"']?(?:https?:)?//", style.read_text(encoding="utf-8")), style


@pytest.fixture(scope="module")
def served(site: Path) -> Iterator[str]:
    """Its address on this machine."""
    handler = functools.partial(Quiet, directory=str(site))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


@needs_chromium
def test_a_browser_finds_an_option_and_asks_nobody_else(served: str) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright (pip install 'refield[dev]')")
    asked: list[str] = []
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1200, "height": 900})
        page.on("request", lambda request: asked.append(request.url))
        faults: list[object] = []
        page.on("pageerror", lambda fault: faults.append(fault))
        page.goto(f"{served}/index.html")
        page.locator(".md-search__input").click()
        page.keyboard.type("photo-memory GB pixels")
        found = page.locator(".md-search-result__link[href*='options/train.html']").first
        sync_api.expect(found).to_be_attached()
        page.goto(str(found.get_attribute("href")))
        sync_api.expect(page.locator("td code", has_text="--fit.photo-memory").first).to_be_visible()
        browser.close()
    assert not faults
    assert asked and not [url for url in asked if not url.startswith((served, "data:", "blob:"))]
