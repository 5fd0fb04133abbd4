"""What the scripts that compare on known worlds are asked alike."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from estimate import Bench

from refield.synthetic.worlds import WORLDS
from refield.update.fit_helper import HelperConfig

PATIENT = HelperConfig(max_seconds=600.0)
"""a busy machine must not change what is found"""


def parser(about: str | None, worlds: Sequence[str], rows: Sequence[str], out: str) -> argparse.ArgumentParser:
    """Of which worlds, which rows, and where everything is; ``out``: where results are kept by default."""
    made = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--worlds", nargs="+", choices=sorted(WORLDS), default=list(worlds))
    made.add_argument("--only", nargs="+", choices=list(rows), default=list(rows))
    made.add_argument("--size", type=int, default=128, help="pixels a side")
    made.add_argument("--cameras", type=int, default=70, help="old photos of a world")
    made.add_argument("--work", type=Path, default=Path("build/estimate-work"), help="worlds' photos and fields")
    made.add_argument("--out", type=Path, default=Path(out), help="results of every run")
    made.add_argument("--threads", type=int, default=1)
    return made


def bench_of(options: argparse.Namespace) -> Bench:
    """The worlds as they are asked for, in so many threads."""
    torch.set_num_threads(options.threads)
    return Bench(options.work, options.out, options.size, options.cameras, 1)
