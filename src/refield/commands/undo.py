"""``refield undo WORK``: take the last visit back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from refield.report import PAGE, link_next
from refield.scene.errors import InputError
from refield.workspace import Workspace


@dataclass(frozen=True)
class Undo:
    """Take the last visit back, as if its photos had never been given. What was before it is as it was."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""


def run(options: Undo) -> None:
    workspace = Workspace.open(options.work)
    with workspace.writing():
        number = workspace.visits
        if number == 0:
            what = "has had no visit, so there is nothing to take back"
            raise InputError(options.work, what, f"make one with: refield update {options.work} PHOTOS")
        workspace.drop_last_visit()
        link_next(workspace.visit(number - 1) / PAGE, None)
    print(f"visit {number} is taken back; {options.work} is as it was after visit {number - 1}")
