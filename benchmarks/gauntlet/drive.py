"""All scenes: a process for each, its row whatever becomes of it, and then the tables and the sheet."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from own_photos import conditions
from record import Row

from gauntlet.chain import COMMANDS, commands_of, failure
from gauntlet.ledger import Ledger
from gauntlet.row import RESULT, SCORES, STRIP, forget, keep, run_trial
from gauntlet.sheet import sheet
from gauntlet.summary import groups_table, quantiles_table, rows_table, shares_table
from gauntlet.trials import Trial
from refield.scene.files import read_json, write_bytes

SCRIPT = Path(__file__).parents[1] / "gauntlet.py"
_ONE_THREAD = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_SAID = "process.txt"
"""what a scene's process said that no command did"""


@dataclass(frozen=True)
class Options:
    """How scenes are run."""

    out: Path
    jobs: int = 1
    """at once; of several each has one core and one thread, since threads of two side by side slow each other"""
    limit: float = 1200.0
    """seconds for a scene"""
    keep: bool = False
    """each scene's photos and workspace as well"""

    def folder(self, trial: Trial) -> Path:
        return self.out / trial.key

    def finished(self, trial: Trial) -> bool:
        return (self.folder(trial) / RESULT).is_file()


def fresh_seeds(trials: Sequence[Trial], options: Options) -> list[int]:
    """Seeds of which nothing was run yet in this output folder."""
    return sorted({t.seed for t in trials if t.seed is not None and not options.folder(t).is_dir()})


def run_all(trials: Sequence[Trial], options: Options) -> None:
    """Those that are not finished."""
    cores: SimpleQueue[int | None] = SimpleQueue()
    here = sorted(os.sched_getaffinity(0))
    for k in range(options.jobs):
        cores.put(None if options.jobs == 1 else here[k % len(here)])

    def run(trial: Trial) -> None:
        core = cores.get()
        try:
            _in_process(trial, core, options)
        finally:
            cores.put(core)

    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(run, [t for t in trials if not options.finished(t)]))


def _in_process(trial: Trial, core: int | None, options: Options) -> None:
    folder = options.folder(trial)
    folder.mkdir(parents=True, exist_ok=True)
    forget(folder)  # of a scene that was interrupted
    for name in (COMMANDS, SCORES, STRIP):
        (folder / name).unlink(missing_ok=True)
    command = [sys.executable, str(SCRIPT), "--scene", trial.to_json(), "--out", str(options.out)]
    command += ["--keep"] * options.keep + ([] if core is None else ["--core", str(core)])
    environment = os.environ | ({} if core is None else dict.fromkeys(_ONE_THREAD, "1"))
    with (folder / _SAID).open("w") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)
        how, why = _ended(process, options.limit)
    if not options.finished(trial):
        ran = commands_of(folder)
        where = failure(ran) or {"command": "scoring"}
        seconds = {r["name"]: r["seconds"] for r in ran if "seconds" in r}
        failed = where | {"how": how, "why": why or _last_line(folder / _SAID)}
        keep(folder, head(trial, core) | {"failed": failed, "seconds": seconds})
        if not options.keep:
            forget(folder)
    print(f"{trial.name}: done", file=sys.stderr, flush=True)


def _ended(process: subprocess.Popen[bytes], limit: float) -> tuple[str, str]:
    """How a process ended that left no row, and why; it is not left running."""
    try:
        code = process.wait(limit)
        return "died", f"signal {-code}" if code < 0 else ""
    except subprocess.TimeoutExpired:
        return "stopped", f"not done after {limit:.0f} s"
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _last_line(path: Path) -> str:
    lines = [line.strip() for line in path.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1][:240] if lines else "no word"


def one_scene(trial: Trial, core: int | None, options: Options) -> None:
    """In its own process: the scene's row, on disk."""
    folder = options.folder(trial)
    row = run_trial(trial, folder)
    if not options.keep:
        forget(folder)
    keep(folder, head(trial, core) | row)


def head(trial: Trial, core: int | None) -> Row:
    """What every row begins with."""
    cores = len(os.sched_getaffinity(0)) if core is None else 1
    return {"name": trial.name, "seed": trial.seed, "real": trial.real, "cores": cores, "code": code_key()}


def code_key() -> str:
    """The commit of this checkout, and whether the package differs from it."""

    def git(*arguments: str) -> str:
        told = subprocess.run(["git", *arguments], cwd=SCRIPT.parents[1], capture_output=True, text=True, check=False)
        return told.stdout.strip()

    return f"{git('rev-parse', '--short', 'HEAD') or 'unknown'}{' (changed)' if git('status', '-s', 'src') else ''}"


def tell(trials: Sequence[Trial], skipped: Sequence[str], options: Options, ledger: Ledger) -> str:
    """The tables, which are also written beside the sheet."""
    rows = [read_json(options.folder(t) / RESULT) for t in trials]
    cores = sorted({row["cores"] for row in rows})
    facts = [f"Code: {', '.join(sorted({row['code'] for row in rows}))}"]
    facts.append(f"seconds are of {' or '.join(map(str, cores))} core{'' if cores == [1] else 's'}")
    facts.append(ledger.told([t.seed for t in trials if t.seed is not None]))
    told = [conditions().strip(), "; ".join(f for f in facts if f) + "."]
    told += [f"Left out: {line}." for line in skipped]
    for title, real in (("Worlds", False), ("Real photographs", True)):
        mine = [row for row in rows if row["real"] == real]
        if mine:
            told += [f"### {title}: {len(mine)} scenes", shares_table(mine), quantiles_table(mine)]
            told += [t for by in ("change", "path", "place") if (t := groups_table(mine, by)) is not None]
            told.append(rows_table(mine))
    picture = options.out / "worst.png"
    sheet(rows, {t.name: options.folder(t) for t in trials}, picture)
    text = "\n\n".join([*told, f"The worst are in {picture}.\n"])
    write_bytes(options.out / "gauntlet.md", text.encode())
    return text
