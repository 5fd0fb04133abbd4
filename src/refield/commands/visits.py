"""``refield visits WORK``: every visit of a workspace, and what changed at it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table
from tyro.conf import Positional, arg

from refield.commands.clock import results
from refield.history import changed_visits
from refield.report import object_shift, turn
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.files import read_json
from refield.workspace import Workspace


@dataclass(frozen=True)
class Visits:
    """List the visits of a workspace with what changed at each; 0 is the state before any."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    json: bool = False
    """print JSON in place of a table"""


def run(options: Visits) -> None:
    workspace = Workspace.open(options.work)
    visits = [_visit(workspace, number) for number in range(1, workspace.visits + 1)]
    if options.json:
        print(json.dumps({"workspace": str(options.work), "visits": visits}, indent=1))
    elif not visits:
        print(f"{options.work} has had no visit; make one with: refield update {options.work} PHOTOS")
    else:
        results().print(_table(visits))


def _visit(workspace: Workspace, number: int) -> dict[str, Any]:
    change, report = workspace.change(number, masks=False), workspace.visit(number) / "report.json"
    facts = read_json(report) if report.is_file() else {}
    return {
        "visit": number,
        "made": facts.get("made"),
        "objects": [_told(o) for o in change.objects],
        "photos_used": len(change.frames),
        "photos_rejected": len(change.photos) - len(change.frames),
        "seconds": round(sum(s for s in facts.get("seconds", {}).values() if s), 1),
        "changed": bool(changed_visits(workspace, number)[-1:] == [number]),
        "why": _why(change),
        "report": str(workspace.visit(number) / "report.html"),
    }


def _told(o: ObjectChange) -> dict[str, Any]:
    shift = object_shift(o)
    return {
        "kind": o.kind,
        "at": [round(v, 4) for v in o.centre.tolist()],
        "moved_by": None if shift is None else math.hypot(*shift),
        "turned_by_deg": None if o.new_from_old is None else turn(o.new_from_old)[0],
        "confidence": o.confidence,
        "note": o.note,
    }


def _why(change: SceneChange) -> str:
    if change.objects:
        return ""
    return change.why or ("something changed that is not understood" if change.unexplained else "nothing changed")


def _table(visits: list[dict[str, Any]]) -> Table:
    out = Table(caption="lengths in the capture's units; take the last one back with: refield undo WORK")
    for name in ("visit", "made", "what changed", "photos", "seconds"):
        out.add_column(name, justify="right" if name in ("visit", "seconds") else "left")
    for v in visits:
        what = "\n".join(_line(o) for o in v["objects"]) or v["why"]
        rejected = f" ({v['photos_rejected']} rejected)" if v["photos_rejected"] else ""
        out.add_row(str(v["visit"]), v["made"] or "-", what, f"{v['photos_used']}{rejected}", f"{v['seconds']:.1f}")
    return out


def _line(o: dict[str, Any]) -> str:
    at = ", ".join(f"{v:.4g}" for v in o["at"])
    if o["moved_by"] is None:
        return f"{o['kind']} at ({at})"
    return f"moved from ({at}) by {o['moved_by']:.4g}, turned {o['turned_by_deg']:.1f}°"
