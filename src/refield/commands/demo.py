"""``refield demo [OUT]``: the whole way on a small sample that comes with the package."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from rich.table import Table
from tyro.conf import Positional, arg

from refield.commands.clock import Clock, results
from refield.commands.evaluate import table
from refield.commands.train import Sources, train
from refield.commands.update import Update, update
from refield.evaluate import pose_error
from refield.field.fit import FitConfig
from refield.report import summary
from refield.scene.change import SceneChange
from refield.scene.change_files import load_change
from refield.synthetic import sample_folder
from refield.visits.visit import Visit
from refield.workspace import Workspace


@dataclass(frozen=True)
class Demo:
    """Sample capture → field → update → report; no downloads, on a CPU."""

    out: Annotated[Path, arg(metavar="OUT"), Positional] = Path("refield-demo")
    """the workspace to make; one that an earlier demo made is replaced"""
    fit: FitConfig = field(default_factory=FitConfig)


def run(options: Demo) -> None:
    clock = Clock()
    sample = sample_folder()
    again = Workspace.made_by(options.out) == "demo"
    Workspace.refuse_unless_free(options.out, overwrite=again, option=None)
    task = Sources(sample / "before", options.out)
    psnr = train(task, clock, options.fit, overwrite=again, made_by="demo")
    facts = {} if math.isnan(psnr) else {"held-out PSNR of the field (dB)": round(psnr, 2)}
    visit = update(Update(options.out, sample / "after", evaluation=sample / "eval"), clock, facts)
    _show(visit, load_change(sample / "truth"), psnr, clock)
    print(f"report: {visit.html}")
    if visit.sheet.exists():
        print(f"before and after: {visit.sheet}")


def _show(visit: Visit, truth: SceneChange, psnr: float, clock: Clock) -> None:
    console = results()
    console.print(summary(visit.change))
    if visit.evaluation is not None:
        console.print(table(visit.evaluation, "views that nothing was fitted to"))
    numbers = Table("", "", title="numbers", show_header=False)
    numbers.add_row("held-out PSNR of the first field", f"{psnr:.2f} dB")
    for name, value in pose_errors(visit.change, truth):
        numbers.add_row(name, value)
    for stage, seconds in clock.seconds.items():
        numbers.add_row(stage, f"{seconds:.1f} s")
    numbers.add_row("whole demo", f"{clock.total:.1f} s")
    console.print(numbers)


def pose_errors(change: SceneChange, truth: SceneChange) -> list[tuple[str, str]]:
    """Each moved object's pose change against the nearest true one's."""
    out = []
    true = [o for o in truth.objects if o.new_from_old is not None]
    for found in change.objects:
        if found.new_from_old is None or not true:
            continue
        centre = found.grid.tight_aabb().mean(0)
        match = min(true, key=lambda o: float((o.grid.tight_aabb().mean(0) - centre).norm()))
        assert match.new_from_old is not None
        shift, turn = pose_error(found.new_from_old, match.new_from_old, match.grid.tight_aabb().mean(0))
        out.append(("error of the pose change", f"{shift * 100:.2f} cm, {turn:.2f}°"))
    return out
