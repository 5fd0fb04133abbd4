"""The product by its commands, each watched: exit code, seconds, what it said, what it raised.

What a command prints goes into ``logs/`` of the scene's folder; ``commands.json`` there is written before and after
each command, so that it tells what was running when the process had to be stopped.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from record import one_line

from refield.cli import INPUT
from refield.cli import main as refield
from refield.scene.files import read_json, write_json

COMMANDS = "commands.json"

Ran = dict[str, Any]
"""``name``, ``command``; and once it ended: ``code``, ``seconds``, ``how`` (None, "refused" or "crashed"), ``why``"""


class Chain:
    """The commands of one scene, in turn."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ran: list[Ran] = []

    def run(self, name: str, *command: str | Path) -> bool:
        """Whether a command of refield ended well; whatever it does is kept, nothing is raised."""
        arguments = [str(c) for c in command]
        log = self.folder / "logs" / f"{len(self.ran)}_{name}.txt".replace(" ", "_")
        log.parent.mkdir(parents=True, exist_ok=True)
        self.ran.append({"name": name, "command": " ".join(["refield", *arguments])})
        self._keep()
        self.ran[-1] |= _watched(arguments, log)
        self._keep()
        return self.ran[-1]["code"] == 0

    def _keep(self) -> None:
        write_json(self.folder / COMMANDS, {"commands": self.ran})


def commands_of(folder: Path) -> list[Ran]:
    """What ran in a scene's folder, also where its process was stopped."""
    return read_json(folder / COMMANDS)["commands"] if (folder / COMMANDS).is_file() else []


def failure(ran: Sequence[Ran]) -> Ran | None:
    """The first command that did not end well: ``command`` (its name), ``how`` and ``why``; None if all did."""
    for one in ran:
        if "code" not in one:
            return {"command": one["name"], "how": "stopped", "why": "did not end"}
        if one["how"] is not None:
            return {"command": one["name"], "how": one["how"], "why": one["why"]}
    return None


def _watched(arguments: list[str], log: Path) -> Ran:
    began, raised = time.perf_counter(), None
    with log.open("w", encoding="utf-8") as out, redirect_stdout(out), redirect_stderr(out):
        try:
            code = refield(arguments)
        except SystemExit as end:  # a command line that tyro does not take
            code = end.code if isinstance(end.code, int) else 1
        except BaseException as error:
            traceback.print_exc()
            code, raised = 1, one_line(error)
    seconds = time.perf_counter() - began
    if code == 0:
        return {"code": code, "seconds": seconds, "how": None, "why": ""}
    how = "refused" if code == INPUT and raised is None else "crashed"
    return {"code": code, "seconds": seconds, "how": how, "why": raised or _last_line(log)}


def _last_line(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(encoding="utf-8").splitlines() if line.strip()]
    return lines[-1].removeprefix("refield: ")[:240] if lines else ""
