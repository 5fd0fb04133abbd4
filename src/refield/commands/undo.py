"""``refield undo WORK``: take the last visit back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from refield.visits.make import take_back
from refield.workspace import Workspace


@dataclass(frozen=True)
class Undo:
    """Take the last visit back, as if its photos had never been given. What was before it is as it was."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""


def run(options: Undo) -> None:
    number = take_back(Workspace.open(options.work))
    print(f"visit {number} is taken back; {options.work} is as it was after visit {number - 1}")
