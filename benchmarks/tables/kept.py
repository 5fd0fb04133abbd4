"""Results on disk, one file for each case and method, so that a rerun does only what is missing."""

from __future__ import annotations

import os
import platform
import statistics
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from refield.scene.errors import InputError
from refield.scene.files import read_json, write_json

Record = dict[str, Any]
"""What one method found on one case; JSON"""


class Kept:
    """The folder of all results."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, case: str, method: str) -> Path:
        return self.folder / "results" / case / f"{method}.json"

    def pictures(self, case: str, method: str) -> Path:
        """Where a method's renders of the evaluation views are."""
        return self.folder / "pictures" / case / method

    def get(self, case: str, method: str) -> Record | None:
        """None if that was not run, or if its file is no use."""
        path = self.path(case, method)
        try:
            return read_json(path) if path.is_file() else None
        except InputError as error:
            print(f"{error}; it is run again", flush=True)
            return None

    def once(self, case: str, method: str, run: Callable[[], Record]) -> Record:
        """The result, from before or from a run now, which is kept as soon as it is there."""
        found = self.get(case, method)
        if found is None:
            print(f"  {case}: {method} ...", flush=True)
            load = os.getloadavg()[0]
            found = run() | {"made": made(), "load": load}
            write_json(self.path(case, method), found)
        return found

    def cases(self) -> list[str]:
        return sorted(p.name for p in (self.folder / "results").glob("*") if p.is_dir())


def made() -> Record:
    """Date, machine and versions, for the record."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").is_file() else []
    cpu = next((x.split(":")[1].strip() for x in lines if "model name" in x), platform.processor())
    return {
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "machine": f"{os.cpu_count()} cores ({cpu or platform.machine()})",
        "threads": torch.get_num_threads(),
        "versions": f"Python {platform.python_version()}, torch {torch.__version__}",
    }


def spread(values: list[float | None], digits: int = 2) -> str:
    """Mean and, of several, standard deviation; a dash if nothing is known."""
    known = [v for v in values if v is not None]
    if not known:
        return "–"
    mean = f"{statistics.mean(known):.{digits}f}"
    return mean if len(known) == 1 else f"{mean} ± {statistics.stdev(known):.{digits}f}"
