"""One fit by the product's own command, in a process of its own: how long, how much memory, how good on the way."""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from record import Row

from refield.scene.files import read_json

_WATCH = Path(__file__).with_name("watch.py")
_STAGE = re.compile(r"^\[ *([0-9.]+) s\] (.*)$")
_POSES, _FIT = "find where", "fit a field"


def train(data: Path, folder: Path, options: Sequence[str]) -> Row:
    """``refield train`` into ``folder``/work; what it said is in ``folder``/train.txt.

    ``failed`` is its last line if it failed. ``poses`` are the seconds in which these were found, None if they were
    given; ``whole`` those of the process, which loads and compiles as well; ``peak`` is in GB, of all of that.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    log, told = folder / "train.txt", folder / "looks.json"
    command = [sys.executable, str(_WATCH), str(told), "train", str(data), str(folder / "work"), *options]
    began = time.perf_counter()
    with log.open("w") as out:
        code = subprocess.run(command, stdout=out, stderr=out, check=False).returncode
    row: Row = {"options": list(options), "whole": time.perf_counter() - began}
    lines = log.read_text(errors="replace").splitlines()
    row |= stages(lines)
    if told.is_file():
        row |= read_json(told)
    if code != 0:
        row["failed"] = next((line.strip() for line in reversed(lines) if line.strip()), f"exit code {code}")[:240]
    return row


def stages(lines: Sequence[str]) -> Row:
    """Seconds of the stages that take long, by what the command says when they begin; None for one it had not."""
    marks = [(float(m[1]), m[2]) for line in lines if (m := _STAGE.match(line))]
    seconds = {name: after - at for (at, name), (after, _) in itertools.pairwise(marks)}

    def of(begins: str) -> float | None:
        return next((s for name, s in seconds.items() if name.startswith(begins)), None)

    return {"poses": of(_POSES), "fit": of(_FIT)}
