"""One object moved again and again: what each visit costs beside the first, and how well its state is shown.

    python benchmarks/visits.py                            # cube at 256²; photos and field kept in build/estimate-work
    python benchmarks/visits.py --worlds cube cone --size 128

The object is moved, moved on to a place that nothing has stood on, and put back where it was at first; four new photos
each, by the command line's `update`, on a copy of the workspace. A run before the timed one compiles the kernels.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path

from estimate import Bench, Scene
from own_photos import conditions
from record import Row, markdown

from refield.cli import main as refield
from refield.evaluate import evaluate, pose_error
from refield.history import state
from refield.scene.change import SceneChange
from refield.synthetic.cameras import ring, square_camera
from refield.synthetic.state import State, World
from refield.synthetic.write import shoot_state
from refield.workspace import Workspace

ON = (20.0, (-0.53, -0.18, 0.0))
"""degrees and metres of the second move: to where nothing has stood"""
SHOWN = ("load the field", "detect", "hull", "pose", "segment", "train", "judge the update", "report")
"""stages with a column of their own"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=["cube"], help="in which one object moves")
    parser.add_argument("--size", type=int, default=256, help="pixels a side")
    parser.add_argument("--cameras", type=int, default=70, help="old photos")
    parser.add_argument(
        "--work", type=Path, default=Path("build/estimate-work"), help="photos and fields are kept here"
    )
    options = parser.parse_args()
    print(conditions())
    bench = Bench(options.work, options.work / "results", options.size, options.cameras, 1)
    for name in options.worlds:
        scene = bench.scene(name)
        _visits(scene)  # compiles what is compiled
        print(f"### {name}\n\n{markdown(_visits(scene))}\n", flush=True)
    return 0


def _states(world: World) -> dict[str, State]:
    """After each visit."""
    (change,) = world.changes
    assert change.new is not None  # it moved
    on = change.new.turned(*ON)
    items = tuple(on if item.name == on.name else item for item in world.after.items)
    return {"moved": world.after, "moved on": replace(world.after, items=items), "put back": world.before}


def _visits(scene: Scene) -> list[Row]:
    """All visits on a copy of the workspace, a row each."""
    work = scene.folder / "visits-work"
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(scene.folder / "work", work)
    rows: list[Row] = []
    stood = scene.world.before
    for number, (what, now) in enumerate(_states(scene.world).items(), start=1):
        photos = _photographed(scene, now, scene.folder / "visits" / what.replace(" ", "-"))
        began = time.perf_counter()
        if refield(["update", str(work), str(photos / "after")]) != 0:
            raise RuntimeError(f"{what}: the update failed")
        seconds = time.perf_counter() - began
        workspace = Workspace.open(work)
        row: Row = {"visit": f"{number}: {what}", "off by": _off(workspace.change(number), World("", stood, now))}
        for title, visit in (("PSNR before", number - 1), ("after", number)):
            row[title] = evaluate(state(workspace, visit), photos / "eval").pooled.psnr
        row |= {"s in all": seconds, "of the first": seconds / (rows[0]["s in all"] if rows else seconds)}
        told = json.loads((workspace.visit(number) / "report.json").read_text())["seconds"]
        row |= {f"{stage}, s": told.get(stage, 0.0) for stage in SHOWN}
        rows.append(row | {"other, s": seconds - sum(told.get(stage, 0.0) for stage in SHOWN)})
        stood = now
    return rows


def _photographed(scene: Scene, now: State, folder: Path) -> Path:
    """Four new photos of a state and four to evaluate by, unless they are there."""
    camera, poses = scene.new[0].camera, ring(scene.world.target)
    for name, half in (("after", poses[0::2]), ("eval", poses[1::2])):
        if not (folder / name / "transforms.json").exists():
            shoot_state(now, folder / name, (square_camera(camera.width), half), (64, 7 * len(name)))
    return folder


def _off(change: SceneChange, true: World) -> str:
    """How far the one moved object is from the truth, or what was found in its place."""
    (expected,) = true.changes
    assert expected.new_from_old is not None  # it moved
    moved = [o for o in change.objects if o.new_from_old is not None]
    if len(change.objects) != 1 or not moved or moved[0].new_from_old is None:
        return ", ".join(o.kind for o in change.objects) or "nothing found"
    centre = moved[0].grid.tight_aabb().mean(0).double()
    distance, angle = pose_error(moved[0].new_from_old, expected.new_from_old, centre)
    return f"{100 * distance:.2f} cm, {angle:.2f}°"


if __name__ == "__main__":
    sys.exit(main())
