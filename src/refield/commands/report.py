"""``refield report WORK``: the scene's history, all visits on one page."""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.artefacts import writable
from refield.commands.answer import Answer
from refield.commands.options import PLAIN, Output
from refield.report import PAGE, PastVisit, history_page, is_our_page
from refield.scene.errors import InputError
from refield.scene.files import read_json, write_bytes
from refield.visits.page import marked_photos
from refield.workspace import Workspace, refuse_inside

EXAMPLES = ("refield report work", "refield report work --out history.html")


@dataclass(frozen=True)
class Report:
    """Write the scene's history as one page: what changed at each visit, in words, a plan and photos."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    out: Path | None = None
    """the page; WORK/report.html if nothing is said"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Report) -> Answer:
    workspace = Workspace.open(options.work)
    out = options.work / PAGE if options.out is None else options.out
    _refuse_unless_free(out)
    if workspace.visits == 0:
        raise InputError(options.work, "has had no visit yet", f"make one with: refield update {options.work} PHOTOS")
    visits = [_visit(workspace, number, out) for number in range(1, workspace.visits + 1)]
    title = f"{options.work.resolve().name}: history"
    with writable(out):
        write_bytes(out, history_page(title, visits, workspace.world()).encode())
    return Answer({"workspace": options.work, "visits": len(visits), "report": out}, [f"report: {out}"])


def _refuse_unless_free(out: Path) -> None:
    """Raises InputError: the page would replace something else, or lie in what a workspace keeps."""
    refuse_inside(out)
    if out.is_dir():
        raise InputError(out, "is a folder, not a file", "choose another --out")
    if out.exists() and not is_our_page(out):
        raise InputError(out, "is there and was not made by refield", "choose another --out")


def _visit(workspace: Workspace, number: int, out: Path) -> PastVisit:
    folder = workspace.visit(number)
    change = workspace.change(number, old_masks=False)
    page, link = folder / PAGE, None
    if page.is_file():
        link = quote(Path(os.path.relpath(page.resolve(), out.resolve().parent)).as_posix())
    return PastVisit(number, change, marked_photos(change) if change.objects else (), _made(folder), link)


def _made(folder: Path) -> datetime | None:
    """When a visit's report was written; None if that is not known."""
    try:
        moment = datetime.fromisoformat(str(read_json(folder / "report.json").get("made")))
    except (InputError, ValueError):
        return None
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
