"""``refield demo [OUT]``: the whole way on a small sample that comes with the package."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.evaluate import table
from refield.commands.options import PLAIN, Output
from refield.commands.train import Sources, train
from refield.commands.update import Update, facts_of, update
from refield.evaluate import pose_error
from refield.field.fit import FitConfig
from refield.report import summary
from refield.scene.change import SceneChange
from refield.scene.change_files import load_change
from refield.synthetic import sample_folder
from refield.visits.visit import Visit
from refield.workspace import Workspace

EXAMPLES = ("refield demo",)


@dataclass(frozen=True)
class Demo:
    """Sample capture → field → update → report; no downloads, on a CPU."""

    out: Annotated[Path, arg(metavar="OUT"), Positional] = Path("refield-demo")
    """the workspace to make; one that an earlier demo made is replaced"""
    fit: FitConfig = field(default_factory=FitConfig, metadata={"usual": False})
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Demo) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    sample = sample_folder()
    again = Workspace.made_by(options.out) == "demo"
    Workspace.refuse_unless_free(options.out, overwrite=again, option=None)
    task = Sources(sample / "before", options.out)
    psnr = train(task, clock, options.fit, overwrite=again, made_by="demo")
    facts = {} if math.isnan(psnr) else {"held-out PSNR of the field (dB)": round(psnr, 2)}
    visit = update(Update(options.out, sample / "after", evaluation=sample / "eval"), clock, facts)
    errors = pose_errors(visit.change, load_change(sample / "truth"))
    words = [*_words(visit, psnr, errors, clock), f"report: {visit.html}"]
    if visit.sheet.exists():
        words.append(f"before and after: {visit.sheet}")
    about = {"held_out_psnr": psnr, "warnings": clock.warnings, "seconds_per_stage": clock.seconds}
    off = [{"shift_cm": shift, "turn_deg": turn} for shift, turn in errors]
    return Answer(facts_of(options.out, visit) | about | {"errors_of_pose_changes": off}, words)


def _words(visit: Visit, psnr: float, errors: Sequence[tuple[float, float]], clock: Clock) -> list[str | Table]:
    out: list[str | Table] = [summary(visit.change)]
    if visit.evaluation is not None:
        out.append(table(visit.evaluation, "views that nothing was fitted to"))
    numbers = Table("", "", title="numbers", show_header=False)
    numbers.add_row("held-out PSNR of the first field", f"{psnr:.2f} dB")
    for shift, turn in errors:
        numbers.add_row("error of the pose change", f"{shift:.2f} cm, {turn:.2f}°")
    for stage, seconds in clock.seconds.items():
        numbers.add_row(stage, f"{seconds:.1f} s")
    numbers.add_row("whole demo", f"{clock.total:.1f} s")
    return [*out, numbers]


def pose_errors(change: SceneChange, truth: SceneChange) -> list[tuple[float, float]]:
    """Each moved object's pose change against the nearest true one's, cm and degrees."""
    out = []
    true = [o for o in truth.objects if o.new_from_old is not None]
    for found in change.objects:
        if found.new_from_old is None or not true:
            continue
        centre = found.grid.tight_aabb().mean(0)
        match = min(true, key=lambda o: float((o.grid.tight_aabb().mean(0) - centre).norm()))
        assert match.new_from_old is not None
        shift, turn = pose_error(found.new_from_old, match.new_from_old, match.grid.tight_aabb().mean(0))
        out.append((shift * 100, turn))
    return out
