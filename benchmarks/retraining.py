"""Re-training at its best, against the update: fewer freedoms, more of the new photos, and what the update knows.

    python benchmarks/retraining.py                                 # cube and cone, three seeds of each training
    python benchmarks/retraining.py --worlds cube --seeds 1         # quicker
    python benchmarks/retraining.py --only update retrained longer  # some rows

Fields and photos are made and kept as `estimate.py` does (``--work``); the change is the true one, for re-training as
for the update. Each result is kept in ``--out`` as soon as it is there: run again, the script goes on with what is
missing, and prints the tables.
"""

from __future__ import annotations

import argparse
import time
from functools import partial

from estimate import Bench
from record import Row, markdown
from tables import paper
from tables.again import ANEW, ROWS, Case, seen, seen_new
from tables.asked import bench_of, parser
from tables.kept import Kept, Record, spread

from refield.baselines.curve import Point

MEASURES = {
    "psnr_in": "in", "psnr_out": "out", "bare": "out, bare", "psnr_untouched": "untouched", "new": "new photos",
    "new_in": "new photos, in", "new_out": "new photos, out",
}  # fmt: skip
"""dB: name -> heading. ``bare``: the out-mask's pixels that do not show where the object is now"""


def main() -> None:
    options = _options()
    bench = bench_of(options)
    kept = Kept(options.out)
    for seed in range(options.seeds):
        for world in options.worlds:
            for name in options.only:
                kept.once(f"{world}_{seed}", name, partial(_run, bench, world, seed, name))
    for world in options.worlds:
        print(f"\n{world}\n\n{markdown(_rows(kept, options, world))}")
    print(f"\n{markdown(_caught_up(kept, options))}")


def _options() -> argparse.Namespace:
    asked = parser(__doc__, ["cube", "cone"], list(ROWS), "build/retraining")
    asked.add_argument("--seeds", type=int, default=3, help="of each training; photos and old fields are the same")
    return asked.parse_args()


def _run(bench: Bench, world: str, seed: int, name: str) -> Record:
    scene = bench.scene(world)
    case = Case(scene, seed, scene.truth(scene.new))
    if name in ANEW:
        case.take_anew(bench.spp)
    began = time.process_time()
    field, more = ROWS[name][1](case)
    seconds = time.process_time() - began
    data = case.scene.folder / "data"
    return more | {"scores": seen(data / "eval", field) | seen_new(data / "after", field), "cpu": seconds}


def _of(kept: Kept, options: argparse.Namespace, world: str, name: str) -> list[Record]:
    found = (kept.get(f"{world}_{seed}", name) for seed in range(options.seeds))
    return [r for r in found if r is not None]


def _rows(kept: Kept, options: argparse.Namespace, world: str) -> list[Row]:
    rows: list[Row] = []
    for name in options.only:
        if records := _of(kept, options, world, name):
            row: Row = {"": ROWS[name][0]}
            row |= {title: spread([r["scores"][key] for r in records], 1) for key, title in MEASURES.items()}
            rows.append(row | {"s": spread([r["cpu"] for r in records], 0)})
    theirs = paper.TABLE_3.get(world, {})
    for name, title in (("ours", "the paper's update"), ("retrain", "the paper's re-training")):
        if name in theirs:
            rows.append({"": title, "in": theirs[name][0], "out": theirs[name][3]})
    return [dict.fromkeys(rows[0]) | row for row in rows]


def _caught_up(kept: Kept, options: argparse.Namespace) -> list[Row]:
    """Seconds until the longest re-training is first as good as our finished update."""
    rows: list[Row] = []
    for world in options.worlds:
        for ours, longer in zip(_of(kept, options, world, "update"), _of(kept, options, world, "longer")):
            points = [Point(**p) for p in longer["curve"]]
            for key in ("psnr_in", "psnr_out"):
                goal, last = ours["scores"][key], points[-1].scores
                reached = next((p.scores["cpu"] for p in points if (p.scores[key] or 0) >= goal), None)
                row: Row = {"world": world, "measure": MEASURES[key], "our update": goal, "s": ours["cpu"]}
                row |= {"re-trained": last[key], "after s": last["cpu"]}
                rows.append(row | {"s until as good": f"≥ {last['cpu']:.0f}" if reached is None else f"{reached:.0f}"})
    return rows


if __name__ == "__main__":
    main()
