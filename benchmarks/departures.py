"""What each departure of refield's update from the paper is worth: it is switched off, the others stay.

    python benchmarks/departures.py                           # the paper's worlds, three seeds of the update
    python benchmarks/departures.py --worlds cube --seeds 1   # quicker

Fields and photos are made and kept as `estimate.py` does (``--work``); the change is the true one. Each result is kept
in ``--out`` as soon as it is there: run again, the script goes on with what is missing, and prints the tables.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import asdict, replace
from functools import partial

from estimate import PAPER, Bench
from record import Row, markdown
from tables.asked import PATIENT, bench_of, parser
from tables.kept import Kept, Record, spread

from refield.evaluate import evaluate
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.cut import CutConfig
from refield.update.frozen import FreezeConfig
from refield.update.ground import GroundConfig
from refield.update.relight import RelightConfig
from refield.update.spared import ShowConfig
from refield.update.supervision import SuperviseConfig
from refield.update.train import update_field

DEFAULT = UpdateConfig(fit=PATIENT)
OFF: dict[str, UpdateConfig] = {
    "cut.sides": replace(DEFAULT, cut=CutConfig(sides=False)),
    "cut.bare": replace(DEFAULT, cut=CutConfig(bare=False)),
    "cut.dilation 2": replace(DEFAULT, cut=CutConfig(dilation=2.0)),
    "relight.still": replace(DEFAULT, relight=RelightConfig(still=False)),
    "relight.moved": replace(DEFAULT, relight=RelightConfig(moved=False)),
    "supervise.exposure": replace(DEFAULT, supervise=SuperviseConfig(exposure=False)),
    "ground.footholds": replace(DEFAULT, ground=GroundConfig(footholds=False)),
    "ground.textured": replace(DEFAULT, ground=GroundConfig(textured=False)),
    "ground.patterned": replace(DEFAULT, ground=GroundConfig(patterned=False)),
    "freeze.unseen": replace(DEFAULT, freeze=FreezeConfig(unseen=False)),
    "fit.emptiness 0": replace(DEFAULT, fit=replace(PATIENT, emptiness=0.0)),
    "fit.directions": replace(DEFAULT, fit=replace(PATIENT, directions=True)),
    "show.spared": replace(DEFAULT, show=ShowConfig(spared=False)),
    "all of these": UpdateConfig(
        cut=CutConfig(dilation=2.0, sides=False, bare=False),
        relight=RelightConfig(still=False, moved=False),
        supervise=SuperviseConfig(exposure=False),
        ground=GroundConfig(footholds=False, textured=False, patterned=False),
        freeze=FreezeConfig(unseen=False),
        fit=replace(PATIENT, emptiness=0.0, directions=True),
        show=ShowConfig(spared=False),
    ),
}
"""by what is switched off, or set as the paper has it. ``cut.recall`` acts from the second visit on"""
MEASURES = ("psnr_in", "psnr_out", "psnr_untouched")


def main() -> None:
    options = _options()
    bench = bench_of(options)
    kept = Kept(options.out)
    for seed in range(options.seeds):
        for name in options.only:
            for world in options.worlds:
                kept.once(_key(world, seed), name.replace(" ", "_"), partial(_run, bench, world, name, seed))
    for measure in MEASURES:
        print(f"\n{measure}\n\n{markdown(_rows(kept, options, measure))}")


def _options() -> argparse.Namespace:
    asked = parser(__doc__, PAPER, ["default", *OFF], "build/departures")
    asked.add_argument("--seeds", type=int, default=3, help="of the update; fields and photos are the same")
    return asked.parse_args()


def _key(world: str, seed: int) -> str:
    return f"{world}_{seed}"


def _run(bench: Bench, world: str, name: str, seed: int) -> Record:
    scene = bench.scene(world)
    config = replace(OFF.get(name, DEFAULT), seed=seed)
    began = time.process_time()
    field = update_field(scene.capture, scene.field, scene.truth(scene.new), config)
    seconds = time.process_time() - began
    assert isinstance(field, UpdatedField)
    scores = evaluate(field, scene.folder / "data" / "eval").pooled
    return {"scores": asdict(scores), "cpu": seconds, "why": field.why_stopped, "notes": list(field.notes)}


def _rows(kept: Kept, options: argparse.Namespace, measure: str) -> list[Row]:
    """dB of the default, and what it gains over each with something switched off: mean ± standard deviation over the
    seeds, of pairs by the same seed."""
    rows: list[Row] = []
    for name in options.only:
        row: Row = {"off": name}
        for world in options.worlds:
            row[world] = spread(_gains(kept, options, world, name, measure))
        each = [g for w in options.worlds for g in _gains(kept, options, w, name, measure)]
        row["mean"] = statistics.mean(each) if each else None
        rows.append(row)
    return rows


def _gains(kept: Kept, options: argparse.Namespace, world: str, name: str, measure: str) -> list[float | None]:
    out: list[float | None] = []
    for seed in range(options.seeds):
        usual, other = (kept.get(_key(world, seed), n.replace(" ", "_")) for n in ("default", name))
        if usual is not None and other is not None:
            shown = usual["scores"][measure]
            out.append(shown if name == "default" else shown - other["scores"][measure])
    return out


if __name__ == "__main__":
    main()
