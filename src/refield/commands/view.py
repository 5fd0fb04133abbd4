"""``refield view WORK``: the scene in the browser, its visits, what changed, and things to be moved by hand."""

from __future__ import annotations

import contextlib
import time
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.artefacts import writable
from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.report import is_our_page
from refield.scene.errors import InputError
from refield.scene.files import write_bytes
from refield.view.cast import SPLATS
from refield.workspace import Workspace, refuse_inside

EXAMPLES = ("refield view work", "refield view work --static scene.html")
_LOOK = 1.0  # seconds between two looks at whether there are other visits
_FEWEST = 1000


@dataclass(frozen=True)
class View:
    """Show a workspace in the browser, on this machine alone: its visits by a slider, before and after to wipe between,
    what changed as numbered boxes, photos where they were taken. Things can be dragged, and the move kept as a visit.
    Ctrl-C ends it."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    static: Path | None = None
    """in place of a server, one HTML file that shows it without any, to be sent to somebody"""
    port: int = 8080
    """where to listen, or the next one that is free; 0 for any"""
    splats: int = SPLATS
    """that a state is drawn with, at most"""
    no_browser: bool = False
    """open no page, only tell where it is"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: View) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    workspace = Workspace.open(options.work)
    if options.splats < _FEWEST:
        raise InputError("--splats", f"{options.splats} is too few", f"give {_FEWEST} or more")
    return _static(options, workspace, clock) if options.static is not None else _served(options, workspace, clock)


def _served(options: View, workspace: Workspace, clock: Clock) -> Answer:
    from refield.view.server import Viewer

    clock.stage("load the field")
    with Viewer(workspace, clock.warn, port=options.port, splats=options.splats) as viewer:
        viewer.prepare()
        clock.stop()
        print(f"{viewer.url} shows {options.work}; Ctrl-C ends it", flush=True)
        if not options.no_browser:
            webbrowser.open(viewer.url)
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                time.sleep(_LOOK)
                viewer.look_again()
        document = {"workspace": options.work, "url": viewer.url, "visits": workspace.visits}
        return Answer(document | {"warnings": clock.warnings})


def _static(options: View, workspace: Workspace, clock: Clock) -> Answer:
    from refield.view.scenery import Scenery
    from refield.view.server import need_viser
    from refield.view.static import splats_of_a_page, static_page

    out = options.static
    assert out is not None
    _refuse_unless_free(out)
    need_viser()
    most = splats_of_a_page(workspace.visits + 1, options.splats)
    page = static_page(Scenery(workspace, most, clock.warn), clock.stage).encode()
    with writable(out):
        write_bytes(out, page)
    clock.stop()
    document = {"workspace": options.work, "visits": workspace.visits, "static": out, "bytes": len(page)}
    document |= {"seconds_per_stage": clock.seconds, "warnings": clock.warnings}
    return Answer(document, [f"{out}: {workspace.visits + 1} states, {len(page) / 1e6:.1f} MB"])


def _refuse_unless_free(out: Path) -> None:
    """Raises InputError: the page would replace something else, or lie in what a workspace keeps."""
    refuse_inside(out)
    if out.is_dir():
        raise InputError(out, "is a folder, not a file", "choose another --static")
    if out.exists() and not is_our_page(out):
        raise InputError(out, "is there and was not made by refield", "choose another --static")
