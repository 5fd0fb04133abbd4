"""Why a scene's change was told wrong: was the right answer not tried, or did it cost more than what was told?

    python benchmarks/gauntlet.py --seeds 300..309 --keep      # scenes whose truth is known, with their workspaces
    python benchmarks/diagnose.py build/gauntlet/0300          # a row of a table for each, and a picture

The estimate is asked again (the workspace's field as it was fitted), and then the hypothesis that is true: each thing
by its true voxels, each pose refined from the true one. Where the true hypothesis costs less than the one told, the
search did not find it; where it costs more, the photos say something else than the likelihood makes of them. What of
the truth the likelihood does not take (a thing that left or arrived and explains less than it costs, a move that cannot
be seen) is named as missing: the cost is then that of the rest.

Of a scene NAME, NAME.png in ``--out`` shows for each new photo, from left to right: the photo, the old field, what was
told without its newcomers and its costs, the same of what is true, and the costs if nothing changed. Costs are black
where the photo is as it should be and white where it is twice as wrong as a pose may be, or more; blue where anything
may be.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from gauntlet.match import pose_row, true_objects
from gauntlet.row import facts_of, symmetric
from PIL import Image

from refield.estimate import recipe
from refield.estimate.arrive import shadow_of
from refield.estimate.associate import without
from refield.estimate.cost import CAME
from refield.estimate.lattice import Body, Lattice
from refield.estimate.layers import Sight
from refield.estimate.likelihood import Settled, _before, _left, judged
from refield.estimate.look import Array
from refield.estimate.objects import Old
from refield.estimate.outline import remembered
from refield.estimate.pose_change import FINER, PoseChange, refine
from refield.estimate.settle import Search
from refield.field.source import Known
from refield.rehearse.matching import matched
from refield.scene.capture import centres
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.errors import InputError
from refield.scene.files import read_json
from refield.scene.load import load_new_photos
from refield.workspace import Workspace

COLUMNS = ("scene", "seconds", "true and told", "cost: nothing", "told", "true", "of the truth", "missing of it")
SIDE = 240
"""pixels of a photo's longer side in the picture"""

Row = dict[str, Any]


def diagnosed(folder: Path, out: Path) -> Row:
    """One scene's truth, what is told of it, and what both cost."""
    workspace, true = Workspace.open(folder / "work"), true_objects(folder / "data")
    if true is None:
        raise InputError(folder, "nothing is known of what is true there", "give a scene of the gauntlet")
    capture, began, kept = workspace.capture(), time.perf_counter(), list[tuple[Search, Settled]]()
    frames, really = load_new_photos(folder / "data" / "after", capture), recipe.Search.likely

    def likely(search: Search, told: Settled) -> Settled:
        kept.append((search, really(search, told)))
        return kept[-1][1]

    with patch.object(recipe.Search, "likely", likely):
        try:
            change = recipe.estimate_change(capture, workspace.field(), frames)
        except InputError as error:
            return {"scene": folder.name, "true and told": f"refused: {error}"}
    world = folder / "data" / "truth" / "world.json"
    facts = read_json(world) if world.is_file() else {}
    row: Row = {"scene": folder.name, "seconds": round(time.perf_counter() - began)}
    row["true and told"] = "; ".join(_told(change, true, facts))
    if not kept:
        return row
    search, told = kept[-1]
    nothing = Settled(views=tuple(without(search.ground, search.changed, [])))
    asked = {"cost: nothing": nothing, "told": told, "true": truly(search, true)}
    found = {name: judged(search.ground, one) for name, one in asked.items()}
    row |= {name: round(cost) for name, (_, cost) in found.items()}
    right = found["true"][0]
    row["of the truth"] = "; ".join(_shown(right))
    lacks = Counter(t.kind for t in true) - Counter(_kinds(right))
    row["missing of it"] = ", ".join(lacks.elements())
    _picture(search, [one for one, _ in found.values()], out / f"{folder.name}.png")
    return row


def _told(change: SceneChange, true: Sequence[ObjectChange], facts: Row) -> list[str]:
    """Of each true object what was told, and what was told beside them."""
    match, things, unseen = matched(change.objects, true), facts_of(facts, len(true)), symmetric(facts, len(true))
    lines = []
    for k, t in enumerate(true):
        name = f"{things[k]['texture']} {things[k]['family']} " if things else ""
        found = change.objects[match.pairs[k]] if k in match.pairs else None
        line = f"{name}{t.kind}: nothing" if found is None else f"{name}{t.kind}: {found.kind}, {found.confidence:.2f}"
        off = {} if found is None else pose_row(found, t, centres(change.frames))
        line += f", {off['off, % of distance']:.2f} %" if off else ""
        line += f", {off['off, °']:.1f}°" if off and k not in unseen else ""
        lines.append(line)
    beside = [("false", match.false), ("a piece", match.pieces)]
    lines += [f"{how}: {change.objects[i].kind}, {change.objects[i].confidence:.2f}" for how, of in beside for i in of]
    return lines + ["not understood"] * bool(change.unexplained)


def truly(search: Search, true: Sequence[ObjectChange]) -> Settled:
    """The hypothesis that is true, as far as the estimate tells of moves and departures by themselves."""
    ground, olds, poses = search.ground, list[Old](), dict[int, torch.Tensor]()
    for o in true:
        known = None if o.kind == "added" else Known(o.grid)
        old = known and remembered(ground.field, ground.photographed, known, ground.planes, ground.shape)
        if old:
            if o.new_from_old is not None:
                poses[len(olds)] = o.new_from_old.double()
            olds.append(old)
    moved = dict[int, PoseChange]()
    for k, pose in poses.items():
        views = without(ground, search.changed, olds, [(olds[j], change) for j, change in moved.items()])
        change = refine(Sight(ground.field, olds[k], views, olds), pose, ground.fine, FINER)
        if change is not None:
            moved[k] = change
    told = search._hypothesis(dict(enumerate(olds)), range(len(olds)), moved)
    came = tuple(_body(o.grid, ground.carving.longest) for o in true if o.kind == "added")
    return replace(told, arrived=came)


def _body(grid: OccupancyGrid, longest: int) -> Body:
    lattice = Lattice.over(*grid.tight_aabb().numpy(), longest)
    return Body(lattice, grid.contains(torch.from_numpy(lattice.centres)).numpy())


def _kinds(settled: Settled) -> list[str]:
    return ["moved"] * len(settled.moved) + ["removed"] * len(settled.removed) + ["added"] * len(settled.arrived)


def _shown(settled: Settled) -> list[str]:
    moved = [f"moved, shown {c.explained:.2f} (before {c.before:.2f})" for c in settled.moved.values()]
    left = [f"removed, {share:.2f} show what was behind" for share in settled.removed.values()]
    return [*moved, *left, *(f"added, {came:.2f}" for came in settled.came)]


def _picture(search: Search, hypotheses: Sequence[Settled], path: Path) -> None:
    nothing, told, right = hypotheses
    rows = []
    for i, changed in enumerate(search.changed):
        tiles = [changed.view.photo, changed.view.rgb]
        for one in (told, right):
            tiles += [_composite(search, one, i), _costs(search, one, i)]
        rows.append(np.concatenate([_tile(t) for t in (*tiles, _costs(search, nothing, i))], 1))
    width = max(row.shape[1] for row in rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0))) for r in rows])).save(path)


def _composite(search: Search, one: Settled, i: int) -> Array:
    p = one.views[i]
    picture, depth = p.rgb, p.beyond
    for k, change in one.moved.items():
        picture, depth, _, _ = _before(search.ground, one.olds[k], change, p, picture, depth)
    return picture


def _costs(search: Search, one: Settled, i: int) -> Array:
    p = one.views[i]
    left, tells, _ = _left(search.ground, one, p)
    for body in one.arrived:
        here = shadow_of(p.view, body, p.depth)
        left, tells = np.where(here, CAME, left), tells & ~here
    return np.stack([left / 2, left / 2, np.where(tells, left / 2, 1)], -1)


def _tile(picture: Array) -> Array:
    tile = Image.fromarray((np.clip(picture, 0, 1) * 255).astype(np.uint8))
    scale = SIDE / max(tile.size)
    return np.asarray(tile.resize((round(tile.width * scale), round(tile.height * scale)), Image.Resampling.NEAREST))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="scenes of the gauntlet, kept")
    parser.add_argument("--out", type=Path, default=Path("build/diagnosed"), help="pictures")
    arguments = parser.parse_args()
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for folder in arguments.folders:
        try:
            row = diagnosed(folder, arguments.out)
        except InputError as error:
            print(f"diagnose: {error}", file=sys.stderr)
            return 2
        print(f"| {' | '.join(str(row.get(name, '')) for name in COLUMNS)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
