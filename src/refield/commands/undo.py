"""``refield undo WORK``: take the last visit back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer
from refield.commands.options import PLAIN, Output
from refield.visits.make import take_back
from refield.workspace import Workspace

EXAMPLES = ("refield undo work",)


@dataclass(frozen=True)
class Undo:
    """Take the last visit back, as if its photos had never been given. What was before it is as it was."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Undo) -> Answer:
    number = take_back(Workspace.open(options.work))
    words = f"visit {number} is taken back; {options.work} is as it was after visit {number - 1}"
    return Answer({"workspace": options.work, "undone": number, "visits": number - 1}, [words])
