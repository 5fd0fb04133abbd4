"""``refield view WORK``: the scene in the browser, its visits, what changed, and things to be moved by hand."""

from __future__ import annotations

import time
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.view.cast import SPLATS
from refield.workspace import Workspace

EXAMPLES = ("refield view work", "refield view work --static scene.html")
_LOOK = 1.0  # seconds between two looks at whether there are other visits


@dataclass(frozen=True)
class View:
    """Show a workspace in the browser, on this machine alone: its visits by a slider, before and after to wipe between,
    what changed as numbered boxes, photos where they were taken. Things can be dragged, and the move kept as a visit.
    Ctrl-C ends it."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    static: Path | None = None
    """in place of a server, write one HTML file that shows the same without any, to be sent to somebody"""
    port: int = 8080
    """where to listen, or the next one that is free; 0 for any"""
    splats: int = SPLATS
    """that a state is drawn with, at most"""
    browser: bool = True
    """open the page in the browser"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: View) -> Answer:
    from refield.view.server import Viewer

    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    workspace = Workspace.open(options.work)
    clock.stage("load the field")
    with Viewer(workspace, clock.warn, port=options.port, splats=options.splats) as viewer:
        viewer.prepare()
        clock.stop()
        print(f"{viewer.url} shows {options.work}; Ctrl-C ends it", flush=True)
        if options.browser:
            webbrowser.open(viewer.url)
        while True:
            time.sleep(_LOOK)
            viewer.look_again()
