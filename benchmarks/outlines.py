"""How well the old objects are outlined before any pose is looked for: most of what is not found was never outlined.

    python benchmarks/outlines.py build/gauntlet/SCENE...

Each SCENE is a folder of the gauntlet, with ``data/`` and ``work/``. For every object that truly moved or left: of all
outlines the one whose pixels cover the object's best (IoU over the new photos' cameras, as the old field shows both),
the same among the outlines and their halves, which are offered where no whole outline is certain; and that of the best
outline, drawn anew as what went along by the object's true motion.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from gauntlet.match import true_objects
from numpy.typing import NDArray

from refield.estimate import recipe
from refield.estimate.associate import without
from refield.estimate.comoving import with_comoving
from refield.estimate.detect import Changed
from refield.estimate.objects import Old
from refield.estimate.outline import ObjectConfig
from refield.estimate.past import silhouette
from refield.estimate.split import halves
from refield.history import state
from refield.scene.change import ObjectChange, OccupancyGrid
from refield.scene.load import load_new_photos
from refield.workspace import Workspace

GOOD = 0.6


class _Outlined(Exception):
    """Raised where the search for poses would begin."""


def outlined(work: Path, photos: Path) -> tuple[recipe.Search, Sequence[Old]] | None:
    """What an estimate saw, and the outlines that it would look for elsewhere; None if nothing seems to change."""
    workspace = Workspace.open(work)
    capture, before = workspace.capture(), state(workspace, 0)
    kept: list[tuple[recipe.Search, Sequence[Old]]] = []

    def stop(search: recipe.Search, olds: Sequence[Old], _begun: Any = None) -> None:
        kept.append((search, olds))
        raise _Outlined

    with patch.object(recipe.Search, "settle", stop):
        try:
            recipe.estimate_change(capture, before, load_new_photos(photos, capture))
        except _Outlined:
            return kept[0]
    return None


def covered(olds: Sequence[Old], grid: OccupancyGrid, changed: Sequence[Changed]) -> float:
    """The best IoU of an outline's pixels and the object's, over all new photos."""
    truth = [_pixels_of(grid, c, 1.5 * float(olds[0].lattice.cell)) for c in changed] if olds else []
    best = 0.0
    for old in olds:
        mine = [silhouette(c.view, old) for c in changed]
        both = sum(int((a & b).sum()) for a, b in zip(mine, truth))
        either = sum(int((a | b).sum()) for a, b in zip(mine, truth))
        best = max(best, both / max(either, 1))
    return best


def along(search: recipe.Search, olds: Sequence[Old], true: ObjectChange) -> list[Old]:
    """The outline that covers a true object best, drawn anew as what went along with it."""
    best = max(olds, key=lambda old: covered([old], true.grid, search.changed), default=None)
    if best is None:
        return []
    views = without(search.ground, search.changed, [best])
    anew = with_comoving(search.ground, best, views, true.new_from_old)
    return [] if anew is None else [anew]


def _pixels_of(grid: OccupancyGrid, c: Changed, within: float) -> NDArray[np.bool_]:
    """Pixels (H, W) whose old surface is the object's, or lies so closely before it (world units)."""
    at = torch.from_numpy(np.nan_to_num(c.view.surface, posinf=1e9, neginf=-1e9))
    deeper = at + within * torch.from_numpy(c.view.directions)
    return np.asarray((grid.contains(at) | grid.contains(deeper)).numpy(), bool)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    found: dict[str, list[float]] = {"outlines": [], "with halves": [], "by their motion": []}
    for scene in parser.parse_args().scenes:
        seen = outlined(scene / "work", scene / "data" / "after")
        if seen is None:
            continue
        search, olds = seen
        wholes = [o for old in olds for o in (old, old.instead) if o is not None]
        both = wholes + [half for old in wholes for half, _ in halves(old, ObjectConfig())]
        told = []
        for true in (t for t in true_objects(scene / "data") or () if t.kind != "added"):
            values = [covered(some, true.grid, search.changed) for some in (wholes, both, along(search, wholes, true))]
            for kept, value in zip(found.values(), values):
                kept.append(value)
            told.append(f"{true.kind} " + ", ".join(f"{v:.2f}" for v in values))
        print(f"{scene.name}: " + "; ".join(told), flush=True)
    for name, values in found.items():
        if values:
            good = sum(v > GOOD for v in values)
            print(f"{name}: mean {np.mean(values):.2f}, over {GOOD}: {good} of {len(values)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
