"""Scene after scene through the product by its commands, each in a process of its own, and a row for each.

    python benchmarks/gauntlet.py --seeds 0..39 --jobs 2            # random worlds (developing: 0 to 999)
    python benchmarks/gauntlet.py --seeds 1000..1199 --jobs 2       # to report on; a second time only with --again
    python benchmarks/gauntlet.py --seeds 2000..2039                # every kind of capture; to report on: 3000 to 3999
    python benchmarks/gauntlet.py --seeds 0..9 --synth "--path walk --mixed --photos 200" --out build/walk
    python benchmarks/gauntlet.py --worlds cube added --synth "--size 96 --cameras 40 --spp 16"
    python benchmarks/gauntlet.py --real --data ../shared/data      # real photographs; with --seeds, changes in them

Prints tables in Markdown, also in ``--out``/gauntlet.md, with a sheet of the ten worst scenes, worst.png. What is
finished is not run again. A scene that crashes, hangs or is refused is a row that says so; one whose update failed is
measured with the field that it leaves the user, the old one.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    arguments = _parser().parse_args()
    if arguments.core is not None:  # before anything counts the cores
        os.sched_setaffinity(0, {arguments.core})
    from gauntlet.drive import Options, fresh_seeds, one_scene, run_all, tell
    from gauntlet.ledger import Ledger
    from gauntlet.trials import Trial, chosen

    from refield.scene.errors import InputError

    options = Options(arguments.out.resolve(), arguments.jobs, arguments.limit, arguments.keep)
    if arguments.scene is not None:
        one_scene(Trial.from_json(arguments.scene), arguments.core, options)
        return 0
    synth, data = tuple(shlex.split(arguments.synth)), arguments.data if arguments.real else None
    trials, skipped = chosen(arguments.seeds, arguments.worlds, data, synth)
    trials = [replace(t, train=tuple(shlex.split(arguments.train))) for t in trials]
    ledger = Ledger(arguments.ledger, "rehearsals" if arguments.real else "worlds")
    try:
        if not trials:
            raise InputError("the gauntlet", "has nothing to run", "; ".join(skipped) or "give --seeds or --worlds")
        ledger.claim(fresh_seeds(trials, options), again=arguments.again)
    except InputError as error:
        print(f"gauntlet: {error}", file=sys.stderr)
        return 2
    run_all(trials, options)
    print(tell(trials, skipped, options, ledger))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seeds", type=_seeds, default="", help="A..B, both included, or one: random worlds; with --real, changes"
    )
    parser.add_argument("--worlds", nargs="*", default=[], help="worlds of `refield synth` by name")
    parser.add_argument("--real", action="store_true", help="real photographs")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="where these are")
    parser.add_argument("--synth", default="", help="further options of `refield synth`, in one string")
    parser.add_argument("--train", default="", help="and of `refield train`, such as --fit.seed")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "gauntlet", help="rows, logs, tables, sheet")
    parser.add_argument("--jobs", type=int, default=1, help="scenes at once; of several each has one core")
    parser.add_argument("--limit", type=float, default=1200.0, help="seconds for a scene")
    parser.add_argument("--keep", action="store_true", help="keep each scene's photos and workspace as well")
    parser.add_argument("--again", action="store_true", help="run seeds again that were reported on")
    parser.add_argument("--ledger", type=Path, default=ROOT / "benchmarks" / "gauntlet_use.json", help="runs of seeds")
    parser.add_argument("--scene", help=argparse.SUPPRESS)  # the process of one scene: the trial as JSON
    parser.add_argument("--core", type=int, help=argparse.SUPPRESS)
    return parser


def _seeds(text: str) -> list[int]:
    first, _, last = text.partition("..")
    try:
        return list(range(int(first), int(last or first) + 1)) if first else []
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number and no A..B") from None


if __name__ == "__main__":
    sys.exit(main())
