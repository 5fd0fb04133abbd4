"""``refield visits WORK``: every visit of a workspace, and what changed at it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer
from refield.commands.options import PLAIN, Output
from refield.history import changed_visits
from refield.report import PAGE, object_shift
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.change_files import NAME as CHANGE
from refield.scene.files import read_json
from refield.workspace import Workspace

EXAMPLES = ("refield visits work", "refield visits work --json")


@dataclass(frozen=True)
class Visits:
    """List the visits of a workspace with what changed at each; 0 is the state before any."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Visits) -> Answer:
    workspace = Workspace.open(options.work)
    visits = [visit_facts(workspace, number) for number in range(1, workspace.visits + 1)]
    none = f"{options.work} has had no visit; make one with: refield update {options.work} PHOTOS"
    return Answer({"workspace": options.work, "visits": visits}, [_table(visits) if visits else none])


def visit_facts(workspace: Workspace, number: int) -> dict[str, Any]:
    """What a visit came to, as `refield visits --json` and `refield update --json` tell it."""
    folder = workspace.visit(number)
    change, report = workspace.change(number, masks=False), folder / "report.json"
    facts = read_json(report) if report.is_file() else {}
    unclear = not change.objects and bool(read_json(folder / CHANGE).get("unexplained"))
    return {
        "visit": number,
        "made": facts.get("made"),
        "objects": [_told(o) for o in change.objects],
        "by_hand": change.by_hand,
        "photos_used": len(change.frames),
        "photos_rejected": len(change.photos) - len(change.frames),
        "seconds": round(sum(s for s in facts.get("seconds", {}).values() if s), 1),
        "changed": bool(changed_visits(workspace, number)[-1:] == [number]),
        "not_understood": unclear,
        "why": _why(change, unclear),
        "report": str(folder / PAGE),
    }


def _told(o: ObjectChange) -> dict[str, Any]:
    shift = object_shift(o)
    return {
        "kind": o.kind,
        "at": [round(v, 4) for v in o.centre.tolist()],
        "moved_by": None if shift is None else math.hypot(*shift),
        "turned_by_deg": o.turn_deg,
        "confidence": o.confidence,
        "note": o.note,
    }


def _why(change: SceneChange, unclear: bool) -> str:
    if change.objects:
        return ""
    what = "something changed that is not understood" if unclear else "nothing changed"
    return f"{what}: {change.why}" if change.why else what


def _table(visits: list[dict[str, Any]]) -> Table:
    out = Table(caption="lengths in the capture's units; take the last one back with: refield undo WORK")
    for name in ("visit", "made", "what changed", "photos", "seconds"):
        out.add_column(name, justify="right" if name in ("visit", "seconds") else "left")
    for v in visits:
        what = "\n".join(_line(o) for o in v["objects"]) or v["why"]
        out.add_row(str(v["visit"]), v["made"] or "-", what, _photos(v), f"{v['seconds']:.1f}")
    return out


def _photos(v: dict[str, Any]) -> str:
    rejected = f" ({v['photos_rejected']} rejected)" if v["photos_rejected"] else ""
    return "by hand" if v["by_hand"] else f"{v['photos_used']}{rejected}"


def _line(o: dict[str, Any]) -> str:
    at = ", ".join(f"{v:.4g}" for v in o["at"])
    if o["moved_by"] is None:
        return f"{o['kind']} at ({at})"
    return f"moved from ({at}) by {o['moved_by']:.4g}, turned {o['turned_by_deg']:.1f}°"
