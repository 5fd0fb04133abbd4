"""Results → the paper's tables in Markdown, with the paper's own figures beside ours."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from record import markdown

from refield.baselines.curve import Point, settled, time_to
from tables import paper
from tables.cases import Case
from tables.kept import Kept, Record, spread
from tables.methods import VIEWS

Row = dict[str, Any]
NAMES = {
    "old": "before the update",
    "ours": "**ours**",
    "retrained": "re-trained",
    "finetuned": "fine-tuned",
    "inpainted": "in-painted render",
    "inpainted_photo": "in-painted photo",
    "lama_photo": "in-painted photo, LaMa",
}
WINDOW = 8
"""of so many parts of a training: the paper's 2500 steps are about an eighth of its re-training"""
IN, OUT = paper.MEASURES[:3], paper.MEASURES[3:]


@dataclass(frozen=True)
class Found:
    """All results of some cases; the seeds of a world are taken together."""

    kept: Kept
    cases: Sequence[Case]

    def worlds(self) -> list[str]:
        return list(dict.fromkeys(c.name for c in self.cases))

    def of(self, world: str, method: str) -> list[Record]:
        """One for each seed that has one."""
        mine = [self.kept.get(c.key, method) for c in self.cases if c.name == world]
        return [r for r in mine if r is not None]

    def score(self, world: str, method: str, name: str, how: str = "as rendered") -> str:
        values = [r.get("scores", {}).get(how, {}).get(name) for r in self.of(world, method)]
        return spread(values, 2 if name.startswith("psnr") else 3)

    def seconds(self, world: str, method: str, key: str) -> list[float | None]:
        return [r.get(key) for r in self.of(world, method)]


def _title(name: str) -> str:
    return name.upper().replace("_IN", "-in").replace("_OUT", "-out").replace("_UNTOUCHED", ", untouched")


def _measured(found: Found, world: str, method: str, how: str, names: Sequence[str]) -> Row:
    return {_title(n): found.score(world, method, n, how) for n in names}


def _printed(row: paper.Row | None, names: Sequence[str]) -> Row:
    values = row or (None,) * len(names)
    return {f"paper: {_title(n)}": v for n, v in zip(names, values)}


# --- Tables 1 and 3 ---


def table_3(found: Found, how: str) -> str:
    """One row for each world and method."""
    rows: list[Row] = []
    for world in found.worlds():
        printed = paper.TABLE_3.get(world, {})
        theirs = {"ours": "ours", "retrained": "retrain", "inpainted_photo": "lama", "lama_photo": "lama"}
        for method, title in NAMES.items():
            if not found.of(world, method):
                continue
            names = OUT if method.startswith(("inpainted", "lama")) else paper.MEASURES
            row: Row = {"world": world, "method": title} | dict.fromkeys(map(_title, paper.MEASURES))
            row |= _measured(found, world, method, how, names)
            row["train s"] = spread(found.seconds(world, method, "train"), 1) if "inpaint" not in method else None
            row["total s"] = spread(_totals(found, world, method), 1)
            told = dict(zip((*paper.MEASURES, "minutes"), printed.get(theirs.get(method, ""), ())))
            row |= {f"paper: {_title(n)}": told.get(n) for n in paper.MEASURES}
            rows.append(row | {"paper: total min": told.get("minutes")})
    return markdown(_without_empty(rows))


def _totals(found: Found, world: str, method: str) -> list[float | None]:
    """The estimate and the training: what has to be waited for."""
    out: list[float | None] = []
    for case in found.cases:
        if case.name != world:
            continue
        first, then = found.kept.get(case.key, "estimate"), found.kept.get(case.key, method)
        known = first is not None and then is not None and "total" in first and "train" in then
        out.append(first["total"] + then["train"] if known and first and then else None)
    return out


def _without_empty(rows: list[Row]) -> list[Row]:
    """Without columns in which nothing is known, and the paper's beside them."""
    columns = list(dict.fromkeys(k for row in rows for k in row))
    empty = {c for c in columns if all(row.get(c) in (None, "–") for row in rows)}
    empty |= {f"paper: {c}" for c in empty}
    return [{k: row.get(k) for k in columns if k not in empty} for row in rows]


# --- derived ---


def _curve(record: Record) -> list[Point]:
    return [Point(p["step"], p["seconds"], p["scores"]) for p in record["curve"]]


def catching_up(found: Found) -> str:
    """When re-training is first as good as the finished update, on the same photos."""
    rows: list[Row] = []
    for case in found.cases:
        ours = found.kept.get(case.key, "ours")
        longer = found.kept.get(case.key, "retrained_long")
        again = longer or found.kept.get(case.key, "retrained")
        first = found.kept.get(case.key, "estimate")
        if ours is None or again is None or first is None or "scores" not in ours or "curve" not in again:
            continue
        total, train = first["total"] + ours["train"], ours["train"]
        for name in ("psnr_out", "psnr_in"):
            goal = ours["scores"]["as rendered"][name]
            curve = _curve(again)
            reached = None if goal is None else time_to(curve, name, goal)
            seconds, least = (reached, "") if reached is not None else (again["train"], "≥ ")
            rows.append(
                {
                    "world": case.key,
                    "measure": _title(name),
                    "ours": goal,
                    "re-trained": again["scores"]["as rendered"][name],
                    "after s": again["train"],
                    "steps": f"{again['steps']}, longer" if longer else again["steps"],
                    "s until as good": f"{least}{seconds:.1f}",
                    "our total s": total,
                    "ratio to our total": f"{least}{seconds / total:.2g}",
                    "our training s": train,
                    "ratio to our training": f"{least}{seconds / train:.2g}",
                }
            )
    return markdown(rows)


def converged(found: Found) -> str:
    """When each training ended by its own rule, and when it had converged by the paper's."""
    rows: list[Row] = []
    for case in found.cases:
        for method in ("ours", "retrained", "finetuned"):
            record = found.kept.get(case.key, method)
            if record is None or len(record.get("curve", [])) < 2:
                continue
            curve = _curve(record)
            theirs = settled(curve, max(curve[-1].step // WINDOW, 1))
            rows.append(
                {
                    "world": case.key,
                    "method": NAMES[method],
                    "ended after steps": curve[-1].step,
                    "s": curve[-1].seconds,
                    "converged by the paper's rule after steps": None if theirs is None else theirs.step,
                    "s ": None if theirs is None else theirs.seconds,
                }
            )
    return markdown(rows)


# --- Table 4 ---


def table_4(found: Found) -> str:
    """Mean over all cases; the paper's modules beside the stages that do their work."""
    groups = {
        "change detection (detect, hull)": ("estimate", ("detect", "hull"), ("change det.",)),
        "pose change": ("estimate", ("pose",), ("pose change est.",)),
        "segmentation": ("estimate", ("segment",), ("object segment.",)),
        "update: before training (move, light, supervise, freeze)": (
            "ours", ("move", "light", "supervise", "freeze"), (),
        ),
        "update: training": ("ours", ("train", "show"), ("update training",)),
    }  # fmt: skip
    rows: list[Row] = []
    for title, (method, stages, theirs) in groups.items():
        each = [r["seconds"] for c in found.cases if (r := found.kept.get(c.key, method)) and "seconds" in r]
        values: list[float | None] = [sum(s.get(stage, 0.0) for stage in stages) for s in each]
        printed = sum(paper.TABLE_4_SECONDS[t] for t in theirs) if theirs else None
        rows.append({"stage": title, "s": spread(values, 1), "paper: s": printed})
    return markdown(rows)


# --- Table 5 ---


def table_5(found: Found, how: str) -> str:
    rows: list[Row] = []
    for world in found.worlds():
        if not found.of(world, "no_refine") and not found.of(world, "no_adjacent"):
            continue
        full = paper.TABLE_3.get(world, {}).get("ours")
        for method, title, names, printed in (
            ("ours", "full, in", IN, full[:3] if full else None),
            ("no_refine", "without pose refinement, in", IN, paper.TABLE_5_NO_REFINE.get(world)),
            ("ours", "full, out", OUT, full[3:6] if full else None),
            ("no_adjacent", "without adjacent areas, out", OUT, paper.TABLE_5_NO_ADJACENT.get(world)),
            ("no_old", "helper as usual, but no old photos, out", OUT, None),
        ):
            short = [n.rpartition("_")[0] for n in names]
            row: Row = {"world": world, "": title}
            row |= {s.upper(): found.score(world, method, n, how) for s, n in zip(short, names)}
            row["pose error, cm"] = spread(_poses(found, world, _source(method))[0], 3) if names is IN else None
            refused = [r["refused"] for r in found.of(world, method) if "refused" in r]
            row["refused"] = len(refused) or None
            rows.append(row | {f"paper: {s.upper()}": v for s, v in zip(short, printed or (None,) * 3)})
    return markdown(_without_empty(rows))


def _source(method: str) -> str:
    return "estimate_unrefined" if method == "no_refine" else "estimate"


# --- Tables 6 and 7 ---


def _poses(found: Found, world: str, method: str) -> tuple[list[float | None], list[float | None]]:
    """cm and degrees of the objects that moved; no degrees where it was said that photos do not show the turn."""
    each = [o for r in found.of(world, method) for o in r.get("truth", {}).get("objects", []) if o["kind"] == "moved"]
    cm = [None if o["distance"] is None else 100 * o["distance"] for o in each]
    return cm, [None if o["symmetric"] and o["flagged"] else o["angle"] for o in each]


def table_6(found: Found) -> str:
    rows: list[Row] = []
    for world in found.worlds():
        records = [r for r in found.of(world, "estimate") if "truth" in r]
        if not records:
            continue
        cm, degrees = _poses(found, world, "estimate")
        objects = [o for r in records for o in r["truth"]["objects"]]
        printed = paper.TABLE_6.get(world, (None, None))
        rows.append(
            {
                "world": world,
                "found": f"{sum(o['said'] == o['kind'] for o in objects)}/{len(objects)}",
                "cm": spread(cm, 3),
                "degrees": spread(degrees, 3),
                "3-D IoU": spread([o["iou"] for o in objects]),
                "paper: cm": printed[0],
                "paper: degrees": printed[1],
            }
        )
    return markdown(rows)


def table_7(found: Found) -> str:
    rows: list[Row] = []
    for world in found.worlds():
        for count in VIEWS:
            records = found.of(world, f"estimate_{count}_views")
            if not records:
                continue
            cm, degrees = _poses(found, world, f"estimate_{count}_views")
            printed = paper.TABLE_7.get(world, {}).get(count)
            fails = printed is not None and printed[0] is None
            rows.append(
                {
                    "world": world,
                    "views": count,
                    "found": f"{sum(c is not None for c in cm)}/{len(records)}",
                    "cm": spread(cm, 3),
                    "degrees": spread(degrees, 3),
                    "paper: cm": "fail" if fails else (printed or (None,))[0],
                    "paper: degrees": "fail" if fails else (printed or (None, None))[1],
                }
            )
    return markdown(rows)


# --- Table 8 ---


def table_8(found: Found, how: str) -> str:
    rows: list[Row] = []
    for world in found.worlds():
        if not found.of(world, "top_views"):
            continue
        for title, method, below in (
            ("same views, same evaluation", "ours", False),
            ("top views, same evaluation", "top_views", False),
            ("top views, bottom evaluation", "top_views", True),
            ("same views, bottom evaluation", "usual_views_below", False),
            ("re-trained", "retrained", False),
        ):
            row: Row = {"world": world, "": title}
            for name in paper.MEASURES:
                records = found.of(world, method)
                each = [r.get("below" if below else "scores", {}).get(how, {}).get(name) for r in records]
                row[_title(name)] = spread(each, 2 if name.startswith("psnr") else 3)
            printed = paper.TABLE_8.get(title) if world == "cube" else None
            rows.append(row | _printed(printed, paper.MEASURES))
    return markdown(_without_empty(rows))


# --- Figs. 17 and 18 ---


def figures_17_18(found: Found, how: str) -> str:
    rows: list[Row] = []
    for world in found.worlds():
        for count in VIEWS:
            if found.of(world, f"true_{count}_views"):
                names = (*OUT, "psnr_in", "psnr_untouched")
                rows.append(
                    {"world": world, "views": count} | _measured(found, world, f"true_{count}_views", how, names)
                )
    return markdown(_without_empty(rows))


def conditions(found: Found, methods: Callable[[str], bool] = lambda _: True) -> str:
    """Machine, dates and load of everything shown, so that no figure stands without them."""
    records = [
        record
        for case in found.cases
        for path in sorted((found.kept.folder / "results" / case.key).glob("*.json"))
        if methods(path.stem) and (record := found.kept.get(case.key, path.stem)) is not None and "made" in record
    ]
    if not records:
        return "nothing was run"
    dates = sorted({r["made"]["date"] for r in records})
    machines = sorted({f"{r['made']['machine']}, {r['made']['threads']} threads" for r in records})
    versions = sorted({r["made"]["versions"] for r in records})
    load = statistics.median(r["load"] for r in records)
    when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    return (
        f"{when}; {'; '.join(machines)}; {'; '.join(versions)}; load of the machine before each run {load:.1f} (median)"
    )
