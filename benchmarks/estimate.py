"""What the change estimate finds, on worlds that are known: poses, masks, shapes, kinds, false alarms, time.

    python benchmarks/estimate.py                       # everything; photos and fields are kept in build/estimate-work
    python benchmarks/estimate.py --only poses views    # some sections
    python benchmarks/estimate.py --seeds 1 --size 128  # quicker

One set of defaults is used throughout. Each section prints a table in Markdown and keeps its rows in ``--out``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import cast

import torch
from change_score import Found, Score, score
from record import Row, markdown

from refield.estimate.recipe import estimate_change
from refield.field.fit import FitConfig, fit_field
from refield.field.radiance import HashField
from refield.scene.capture import Capture, Frame
from refield.scene.change import SceneChange
from refield.scene.errors import InputError
from refield.scene.load import load_capture, load_new_photos
from refield.synthetic.cameras import ring, square_camera
from refield.synthetic.disturb import Disturbance, disturbed
from refield.synthetic.grounds import Ground, on_ground
from refield.synthetic.worlds import WORLDS, World
from refield.synthetic.write import shoot_state, true_change, write_world
from refield.workspace import Workspace

PAPER = ("cube", "cylinder", "sphere", "cone")
HARD = (
    "two_moved", "removed", "added", "tipped", "shadow", "plain", "cluttered", "thin", "pole", "nudged", "turned",
    "spun", "edge", "touching", "docked", "stacked", "swapped", "five", "mixed", "mirror", "shiny", "deformed",
)  # fmt: skip
REFUSED = ("lights_off", "elsewhere")
USUAL = Disturbance(exposure=0.3, white_balance=0.05, noise=0.01, pose_px=1.0)
"""what a phone's photos differ by"""


@dataclass(frozen=True)
class Scene:
    """A world, its old photos and the field that was fitted to them."""

    folder: Path
    world: World
    capture: Capture
    field: HashField

    def truth(self, frames: Sequence[Frame]) -> SceneChange:
        return true_change(self.world, self.capture, frames)

    @property
    def new(self) -> list[Frame]:
        return load_new_photos(self.folder / "data" / "after", self.capture)

    def disturbed(self, how: Disturbance) -> list[Frame]:
        """The new photos as they would come from a phone, poses included."""
        out = self.folder / f"disturbed-{abs(hash(how)) % 10**8}"
        if not out.exists():
            disturbed(self.folder / "data" / "after", out, how, self.world.target)
        return load_new_photos(out, self.capture)


def ground_of(name: str) -> tuple[str, Ground]:
    """The world and the ground of ``cube-wavy``."""
    world, _, ground = name.partition("-")
    return world, cast(Ground, ground or "flat")


class Bench:
    """Makes scenes once, and keeps what was found."""

    def __init__(self, work: Path, out: Path, size: int, cameras: int, seeds: int, spp: int = 64) -> None:
        """``spp``: light paths a pixel of the worlds that are made."""
        self.work, self.out, self.size, self.cameras, self.seeds, self.spp = work, out, size, cameras, seeds, spp
        self.worlds: Sequence[str] = (*PAPER, *HARD)
        """of the section ``kinds``"""

    def scene(self, name: str, seed: int = 0, size: int | None = None) -> Scene:
        """Photographed and fitted by the defaults, unless that was done before. ``cube-wavy`` is the cube on wavy
        ground."""
        size = size or self.size
        folder = self.work / f"{name}_{seed}_{size}"
        world, ground = ground_of(name)
        if not (folder / "data" / "truth").exists():
            paths, cameras = self.spp, self.cameras
            write_world(world, folder / "data", size=size, spp=paths, cameras=cameras, ground=ground, seed=seed)
        if not (folder / "work").exists():
            capture = load_capture(folder / "data" / "before")
            with Workspace.building(folder / "work") as workspace:
                workspace.keep_field(fit_field(workspace.keep_capture(capture), FitConfig()))
        workspace = Workspace.open(folder / "work")
        known = on_ground(WORLDS[world](seed), ground, seed)
        return Scene(folder, known, workspace.capture(), workspace.field())

    def report(self, section: str, note: str, rows: list[Row]) -> None:
        """Print a table and keep it."""
        print(f"\n### {section}\n\n{note}\n\n{markdown(rows)}\n", flush=True)
        self.keep(section, rows, note)

    def keep(self, section: str, rows: list[Row], note: str = "not finished") -> None:
        """Write what was found so far."""
        self.out.mkdir(parents=True, exist_ok=True)
        (self.out / f"{section}.json").write_text(json.dumps({"note": note, "rows": rows}, indent=1))


def estimated(scene: Scene, frames: Sequence[Frame]) -> tuple[Score | None, Row]:
    """The score, None if the photos were refused, and seconds per stage."""
    marks: list[tuple[str, float]] = []
    try:
        change = estimate_change(scene.capture, scene.field, frames, on_stage=lambda s: marks.append((s, time.time())))
    except InputError as error:
        return None, {"_why": str(error)}
    marks.append(("", time.time()))
    seconds: Row = {name: b - a for (name, a), (_, b) in itertools.pairwise(marks)}
    truth = scene.truth(change.frames)
    return score(change, scene.world, truth), seconds | {"all": marks[-1][1] - marks[0][1], "_why": change.why}


def poses(bench: Bench) -> None:
    """Table 6: the paper's worlds, 4 views."""
    rows: list[Row] = []
    for name in PAPER:
        found: list[Found] = []
        scores: list[Score] = []
        for seed in range(bench.seeds):
            scene = bench.scene(name, seed)
            result, _ = estimated(scene, scene.new)
            if result is not None:
                scores.append(result)
                found += result.objects
        rows.append(_pose_row(name, found, scores))
    bench.report("poses", f"{bench.size}² pixels, {bench.cameras} old photos, 4 new, {bench.seeds} seeds", rows)


def _pose_row(name: str, found: Sequence[Found], scores: Sequence[Score]) -> Row:
    cm = [100 * f.distance for f in found if f.distance is not None]
    degrees = [f.angle for f in found if f.angle is not None and not (f.symmetric and f.flagged)]
    return {
        "world": name,
        "found": f"{sum(f.right for f in found)}/{len(found)}",
        "cm": _mean(cm),
        "cm, worst": max(cm, default=None),
        "degrees": _mean(degrees),
        "degrees, worst": max(degrees, default=None),
        "3-D IoU": _mean([f.iou for f in found]),
        "mask in": _mean([s.mask_in for s in scores]),
        "mask out": _mean([s.mask_out for s in scores]),
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return statistics.mean(known) if known else None


def views(bench: Bench) -> None:
    """Table 7: from 1 to 16 new views."""
    rows: list[Row] = []
    for name in ("cube", "cone"):
        scene = bench.scene(name)
        many = sixteen(bench, scene)
        for count in (1, 2, 3, 4, 8, 12, 16):
            result, info = estimated(scene, spread(many, count))
            first = result.objects[0] if result is not None and result.objects else None
            rows.append(
                {
                    "world": name,
                    "views": count,
                    "found": "refused" if result is None else (first.said or "not found" if first else "nothing"),
                    "cm": None if first is None or first.distance is None else 100 * first.distance,
                    "degrees": None if first is None else first.angle,
                    "3-D IoU": None if first is None else first.iou,
                    "_why": info["_why"],
                }
            )
        bench.keep("views", rows)  # each world takes a while
    bench.report("views", f"{bench.size}² pixels, one seed; the views are evenly spread on one circle", rows)


def sixteen(bench: Bench, scene: Scene) -> list[Frame]:
    """New photos from all round, at one height."""
    folder = scene.folder / "after16"
    if not (folder / "transforms.json").exists():
        shoot_state(scene.world.after, folder, (square_camera(bench.size), ring(scene.world.target, 16)))
    return load_new_photos(folder, scene.capture)


def spread(many: Sequence[Frame], count: int) -> Sequence[Frame]:
    """So many of the photos, as evenly spread as it goes."""
    return [many[k * len(many) // count] for k in range(count)]


def kinds(bench: Bench) -> None:
    """Every world, as photographed and as a phone would have it: what was found, and what was not there."""
    rows: list[Row] = []
    right = asked = alarms = 0
    for name in bench.worlds:
        scene = bench.scene(name, size=128)
        for how, frames in (("as given", scene.new), ("disturbed", scene.disturbed(USUAL))):
            result, info = estimated(scene, frames)
            objects = result.objects if result is not None else ()
            right += sum(f.right for f in objects)
            asked += len(scene.world.changes)
            alarms += result.false_alarms if result is not None else 0
            rows.append(
                _pose_row(name, objects, [result] if result is not None else [])
                | {
                    "photos": how,
                    "said": ", ".join(f"{f.name}: {f.said or '–'}" for f in objects) or "refused",
                    "false alarms": result.false_alarms if result is not None else 0,
                    "_why": info["_why"],
                }
            )
        bench.keep("kinds", rows)  # it takes long
    for name in REFUSED:
        scene = bench.scene(name, size=128)
        result, info = estimated(scene, scene.new)
        said = "refused" if result is None else f"{len(result.objects)} objects"
        rows.append({"world": name, "photos": "as given", "said": said, "_why": info["_why"]})
    note = f"128² pixels, one seed: {right} of {asked} objects with the right kind, {alarms} false alarms"
    bench.report("kinds", note, rows)


def nochange(bench: Bench) -> None:
    """50 trials in which nothing changed, with noise, exposure and a pose error of a pixel."""
    rows: list[Row] = []
    wrong = trials = 0
    for world_seed in range(2):
        scene = bench.scene("nothing", world_seed, size=128)
        for seed in range(25):
            result, info = estimated(scene, scene.disturbed(replace(USUAL, seed=seed)))
            trials += 1
            if result is None or result.false_alarms:
                wrong += 1
                rows.append({"world seed": world_seed, "trial": seed, "said": info["_why"]})
    note = f"{wrong} false alarms in {trials} trials; exposure 0.3 stops, white balance 5 %, noise 0.01, pose 1 px"
    bench.report("nochange", note, rows)


def seconds(bench: Bench) -> None:
    """The time of the estimate alone, each stage's, the median of five runs."""
    scene = bench.scene("cube", size=128)
    estimated(scene, scene.new)  # compiles
    runs = [estimated(scene, scene.new)[1] for _ in range(5)]
    row: Row = {k: statistics.median(r[k] for r in runs) for k in runs[0] if not k.startswith("_")}
    bench.report("seconds", f"cube, 128² pixels, {bench.cameras} old photos; {platform.processor()}", [row])


SECTIONS: dict[str, Callable[[Bench], None]] = {f.__name__: f for f in (poses, views, kinds, nochange, seconds)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--work", type=Path, default=Path("build/estimate-work"))
    parser.add_argument("--out", type=Path, default=Path("build/estimate"))
    parser.add_argument("--size", type=int, default=256, help="pixels a side, for poses and views")
    parser.add_argument("--cameras", type=int, default=70, help="old photos")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--worlds", nargs="+", choices=[*PAPER, *HARD], help="for kinds, in place of all")
    options = parser.parse_args()
    print(f"{date.today()}, {platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    bench = Bench(options.work, options.out, options.size, options.cameras, options.seeds)
    bench.worlds = options.worlds or bench.worlds
    for name in options.only:
        SECTIONS[name](bench)


if __name__ == "__main__":
    main()
