"""Why a scene's change was told wrong: was the right answer not tried, or did it cost more than what was told?

    python benchmarks/gauntlet.py --seeds 300..309 --keep      # scenes whose truth is known, with their workspaces
    python benchmarks/diagnose.py build/gauntlet/0300          # one line for each, and a picture

The estimate is asked again (the workspace's field as it was fitted), and then the hypothesis that is true: each
object's true voxels, each pose refined from the true one. Where the true hypothesis costs less than the one told, the
search did not find it; where it costs more, the photos say something else than the likelihood makes of them.

Of a scene NAME, NAME.png in ``--out`` shows for each new photo, from left to right: the photo, the old field, what was
told and its costs, what is true and its costs (white: as wrong as nothing is), and what is not explained if nothing
changed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gauntlet.match import pose_row, true_objects
from PIL import Image

from refield.estimate import recipe
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
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.errors import InputError
from refield.scene.files import read_json
from refield.scene.load import load_new_photos
from refield.workspace import Workspace

SIDE = 240
"""pixels of a photo's longer side in the picture"""


@dataclass
class Watch:
    """What was searched while an estimate ran."""

    search: list[Search] = field(default_factory=list)
    settled: list[Settled] = field(default_factory=list)


@contextmanager
def watched() -> Iterator[Watch]:
    """Keep the search of whatever is estimated meanwhile, and the hypothesis that it ended with."""
    watch, real = Watch(), recipe.Search

    class Watched(real):  # type: ignore[misc, valid-type]
        def turned(self, told: Settled) -> Settled:
            settled = super().turned(told)
            watch.search.append(self)
            watch.settled.append(settled)
            return settled

    recipe.Search = Watched  # type: ignore[misc]
    try:
        yield watch
    finally:
        recipe.Search = real  # type: ignore[misc]


def diagnosed(folder: Path, out: Path) -> dict[str, Any]:
    """One scene's truth, what is told of it, and what both cost."""
    workspace, true = Workspace.open(folder / "work"), true_objects(folder / "data")
    if true is None:
        raise InputError(folder, "nothing is known of what is true there", "give a scene of the gauntlet")
    capture, began = workspace.capture(), time.perf_counter()
    frames = load_new_photos(folder / "data" / "after", capture)
    with watched() as watch:
        try:
            change = recipe.estimate_change(capture, workspace.field(), frames)
        except InputError as error:
            return {"scene": folder.name, "refused": str(error)}
    row: dict[str, Any] = {"scene": folder.name, "seconds": round(time.perf_counter() - began)}
    row |= _told(change, true, folder)
    if watch.search:
        search, told = watch.search[-1], watch.settled[-1]
        right = truly(search, true)
        told, costs = judged(search.ground, told)
        right, would = judged(search.ground, right)
        nothing = judged(search.ground, search._hypothesis(dict(enumerate(told.olds)), [], {}))
        row |= {"cost told": round(costs), "cost true": round(would), "cost of nothing": round(nothing[1])}
        row["true, as judged"] = _kinds(right)
        _picture(search, (told, right, nothing[0]), out / f"{folder.name}.png")
    return row


def _told(change: SceneChange, true: Sequence[ObjectChange], folder: Path) -> dict[str, Any]:
    facts = folder / "data" / "truth" / "world.json"
    of = [o for o in (read_json(facts) if facts.is_file() else {}).get("objects", []) if o["change"] != "none"]
    of.sort(key=lambda o: o["change"] == "added")
    pairs, lines = matched(change.objects, true).pairs, []
    for k, t in enumerate(true):
        found = change.objects[pairs[k]] if k in pairs else None
        line = " ".join([t.kind, *([of[k]["family"], of[k]["texture"]] if len(of) == len(true) else []), "->"])
        line += " nothing" if found is None else f" {found.kind} ({found.confidence:.2f})"
        off = {} if found is None else pose_row(found, t, centres(change.frames))
        line += f" {off['off, % of distance']:.2f} %, {off['off, °']:.1f}°" if off else ""
        lines.append(line)
    false = [o for i, o in enumerate(change.objects) if i not in pairs.values()]
    lines += [f"false {o.kind} ({o.confidence:.2f})" for o in false]
    return {"objects": lines, "not understood": bool(change.unexplained)}


def truly(search: Search, true: Sequence[ObjectChange]) -> Settled:
    """The hypothesis that is true: all that moved or left by its true voxels, at the refined true poses."""
    ground, olds, moved = search.ground, list[Old](), dict[int, PoseChange]()
    poses: dict[int, torch.Tensor] = {}
    for o in true:
        if o.kind == "added":
            continue
        old = remembered(ground.field, ground.photographed, Known(o.grid), ground.planes, ground.shape)
        if old is None:
            continue
        if o.new_from_old is not None:
            poses[len(olds)] = o.new_from_old.double()
        olds.append(replace(old, remembered=False))
    for k, pose in poses.items():
        views = ground.past(search.changed, olds)
        change = refine(Sight(ground.field, olds[k], views, olds), pose, ground.fine, FINER)
        if change is not None:
            moved[k] = change
    return search._hypothesis(dict(enumerate(olds)), list(range(len(olds))), moved)


def _kinds(settled: Settled) -> str:
    moved = [f"moved, {100 * c.explained:.0f} % shown (before {100 * c.before:.0f})" for c in settled.moved.values()]
    left = [f"left ({100 * share:.0f} %)" for share in settled.removed.values()]
    return "; ".join([*moved, *left, *(f"arrived ({came:.2f})" for came in settled.came)])


def _picture(search: Search, hypotheses: tuple[Settled, Settled, Settled], path: Path) -> None:
    """Photo, old field, the told and the true composite with their costs, and the costs if nothing changed."""
    told, right, nothing = hypotheses
    rows = []
    for i, changed in enumerate(search.changed):
        view = changed.view
        tiles = [view.photo, view.rgb]
        for one in (told, right):
            tiles += [_composite(search, one, i), _costs(search, one, i)]
        tiles.append(_costs(search, nothing, i))
        rows.append(np.concatenate([_tile(t) for t in tiles], 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(path)


def _composite(search: Search, one: Settled, i: int) -> Array:
    p = one.views[i]
    picture, depth = p.rgb, p.beyond
    for k, change in one.moved.items():
        picture, depth, _, _ = _before(search.ground, one.olds[k], change, p, picture, depth)
    return picture


def _costs(search: Search, one: Settled, i: int) -> Array:
    left, tells, _ = _left(search.ground, one, one.views[i])
    return np.stack([left / 2, left / 2, np.where(tells, left / 2, 1)], -1)


def _tile(picture: Array) -> Any:
    tile = Image.fromarray((np.clip(picture, 0, 1) * 255).astype(np.uint8))
    scale = SIDE / max(tile.size)
    return np.asarray(tile.resize((round(tile.width * scale), round(tile.height * scale)), Image.Resampling.NEAREST))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="scenes of the gauntlet, kept")
    parser.add_argument("--out", type=Path, default=Path("build/diagnosed"), help="pictures")
    arguments = parser.parse_args()
    for folder in arguments.folders:
        for name, value in diagnosed(folder, arguments.out).items():
            print(f"{name}: {value}", flush=True)
        print(flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
