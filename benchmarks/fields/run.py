"""Fits of one capture, each judged: what was asked for, in which folders, and the rows."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from gauntlet.drive import code_key
from record import Row

from fields.contact import contact_sheet
from fields.exposures import put_off
from fields.judge import judged
from fields.trained import train
from refield.scene.files import write_json
from refield.scene.load import is_posed
from refield.workspace import MARKER

_COMMON = ("images", "capture", "work", "before", "photos", "data")
"""names of folders that say nothing of what is in them"""


@dataclass(frozen=True)
class Asked:
    """What to do with each capture."""

    out: Path
    qualities: tuple[str | None, ...] = (None,)
    train: tuple[str, ...] = ()
    """options of `refield train`"""
    exposure: int | None = None
    """seed of exposures to put on"""
    against: str | None = None
    """an architecture to fit as well, for as long"""
    longest: int = 1600


def rows_of(data: Path, asked: Asked) -> Iterator[Row]:
    """A row for each fit of a capture. A workspace is judged as it is.

    Raises:
        InputError: nothing can be done with it at all.
    """
    name = name_of(data)
    if (data / MARKER).is_file():
        yield _judged({"name": name, "how": "as it is"}, data, asked.out / name, asked)
        return
    if asked.exposure is not None:
        name = f"{name}-exposure{asked.exposure}"
        gains = put_off(data, asked.out / name / "data", asked.exposure)
        write_json(asked.out / name / "gains.json", gains)
        data = asked.out / name / "data"
    seconds = None
    for quality in asked.qualities:
        options = (*(("--quality", quality) if quality else ()), *asked.train)
        folder = asked.out / name / (quality or "default")
        row = _fitted({"name": name, "how": " ".join(options) or "defaults"}, data, folder, options, asked)
        yield row
        if "failed" not in row:
            seconds = row["looks"][-1]["seconds"] if row["looks"] else row["fit"]
            data = folder / "work" / "capture"  # its poses are found once
    if asked.against is not None and seconds is not None:
        folder, limit = asked.out / name / asked.against, f"{seconds:.1f}"
        options = ("--architecture", asked.against, "--nerfacto.max-seconds", limit, "--nerfacto.check-every", "10")
        head = {"name": name, "how": f"{asked.against}, {seconds:.0f} s"}
        yield _fitted(head, data, folder, options, asked)


def _fitted(head: Row, data: Path, folder: Path, options: Sequence[str], asked: Asked) -> Row:
    row = head | {"data": str(data), "given poses": is_posed(data)} | train(data, folder, options)
    return row if "failed" in row else _judged(row, folder / "work", folder, asked)


def _judged(row: Row, work: Path, folder: Path, asked: Asked) -> Row:
    """The row with the judgement, which is also left in ``folder`` with a sheet."""
    figures, views = judged(work, asked.longest)
    whole = row | figures | {"code": code_key()}
    folder.mkdir(parents=True, exist_ok=True)
    contact_sheet(views, folder / "sheet.png")
    (folder / "row.json").write_text(json.dumps(whole, indent=1), encoding="utf-8")
    return whole


def name_of(data: Path) -> str:
    """How a capture is called: its folder's name, or the first above it that says something."""
    path = data.resolve()
    path = path.parent if path.is_file() else path
    return next((p.name for p in (path, *path.parents) if p.name and p.name not in _COMMON), "capture")
