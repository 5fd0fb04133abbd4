"""What the user sees while waiting: stages with their seconds, a progress line, warnings; all on stderr."""

from __future__ import annotations

import contextlib
import math
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from refield.field.fit import FitProgress

_WIDE = 120
_TELLING = 0.1  # of all that is expected: the stages before tell how fast it goes
_QUIET_SECONDS = 5.0  # without a terminal a progress line appears this often


def results() -> Console:
    """Where tables of results go: stdout, wide enough for them even where it is no terminal."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else _WIDE)


class Clock:
    """Keeps the time of each stage, and what the user was warned of.

    Of the two streams that it writes, warnings are heard even where the rest is ``quiet``.
    """

    def __init__(self, *, quiet: bool = False, verbose: bool = False) -> None:
        self.console = Console(stderr=True, highlight=False, soft_wrap=True, quiet=quiet)
        self._warnings = Console(stderr=True, highlight=False, soft_wrap=True)
        self._verbose = verbose
        self.seconds: dict[str, float] = {}
        self.warnings: list[str] = []
        self._stage: str | None = None
        self._expected: dict[str, float] = {}
        self._sure = 0.0
        self._since = self._began = time.perf_counter()

    @property
    def _animated(self) -> bool:
        return self.console.is_terminal and not self.console.quiet

    @property
    def total(self) -> float:
        """Seconds since the clock was made."""
        return time.perf_counter() - self._began

    def stage(self, name: str) -> None:
        """A stage begins; the one before it ends. The ``on_stage`` of every recipe."""
        self._close()
        self._stage = name
        left = self._left(name)
        more = "" if left is None else f" (about {duration(left)} left)"
        self.console.print(f"[{self.total:6.1f} s] {name}{more}", markup=False)

    def expect(self, seconds: Mapping[str, float], *, sure: float = 0.0) -> None:
        """How long the stages to come took another time, in their order: each then tells how long is left in all.

        ``sure``: seconds of this command that count as much as what was expected of it; 0 where the other time was
        another scene's, and only the stages' shares are alike.
        """
        self._expected, self._sure = dict(seconds), sure

    def _left(self, stage: str) -> float | None:
        """Seconds, about; None where nobody knows."""
        if stage not in self._expected:
            return None
        names = list(self._expected)
        done = [name for name in names[: names.index(stage)] if name in self.seconds]
        expected = sum(self._expected[name] for name in done) + self._sure
        taken = sum(self.seconds[name] for name in done) + self._sure
        left = sum(self._expected[name] for name in names[names.index(stage) :])
        return left * taken / expected if expected >= _TELLING * (left + expected) else None

    def stop(self) -> None:
        """The last stage ends."""
        self._close()
        self._stage = None

    def warn(self, message: str) -> None:
        """The ``warn`` of every loader."""
        self.warnings.append(message)
        self._warnings.print(f"warning: {message}", markup=False)

    def _close(self) -> None:
        now = time.perf_counter()
        if self._stage is not None:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
            if self._verbose:
                told = f"{now - self._since:.1f} s, {_peak_memory() / 1e6:.0f} MB at most so far"
                self.console.print(f"           {told}", markup=False)
        self._since = now

    @contextlib.contextmanager
    def counting(self, what: str) -> Iterator[Callable[[int, int], None]]:
        """A bar for a known number of things; call it with how many are done and how many there are."""
        progress = Progress(
            TextColumn("         {task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=self.console,
            transient=True,
            disable=not self._animated,
        )
        with progress:
            task = progress.add_task(what, total=None)
            yield lambda done, total: progress.update(task, completed=done, total=total)

    @contextlib.contextmanager
    def counters(self) -> Iterator[Callable[[str], Callable[[int, int], None]]]:
        """Bars for several things that are counted one after the other, each by its name; off a terminal a line
        every few seconds."""
        with contextlib.ExitStack() as stack:

            def count(what: str) -> Callable[[int, int], None]:
                if self._animated:
                    stack.close()  # the one before it is done
                    return stack.enter_context(self.counting(what))
                return self._lines(what)

            yield count

    def _lines(self, what: str) -> Callable[[int, int], None]:
        began = shown = time.perf_counter()

        def tell(done: int, total: int) -> None:
            nonlocal shown
            if time.perf_counter() - shown > _QUIET_SECONDS:
                shown = time.perf_counter()
                left = (shown - began) * (total / max(done, 1) - 1)
                self.console.print(f"           {what}: {done} of {total}, {left:.0f} s left", markup=False)

        return tell

    @contextlib.contextmanager
    def training(self, name: str) -> Iterator[TrainingLine]:
        """A progress line for a fit: a bar on a terminal, else a line every few seconds."""
        progress = Progress(
            TextColumn("         {task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[facts]}"),
            console=self.console,
            transient=True,
            disable=not self._animated,
        )
        with progress:
            task = progress.add_task(name, total=1, facts="starting")
            yield TrainingLine(self.console, progress, task, name)


class Look(Protocol):
    """What both the fit and the update tell of a running training."""

    @property
    def step(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def psnr(self) -> float: ...
    @property
    def seconds(self) -> float: ...


class TrainingLine:
    """Shows each look at the training that it is called with, and remembers the last PSNR (dB)."""

    def __init__(self, console: Console, progress: Progress, task: TaskID, name: str) -> None:
        self._console, self._progress, self._task, self._name = console, progress, task, name
        self._shown = time.perf_counter()
        self.psnr = math.nan
        self.cut_short: float | None = None
        """part of its steps that a fit had done when its time was over, if that is less than half"""

    def __call__(self, look: Look) -> None:
        self.psnr, done = look.psnr, look.step / look.steps
        over = isinstance(look, FitProgress) and look.seconds_left <= 0
        self.cut_short = done if over and done < 0.5 else None
        self._progress.update(self._task, completed=look.step / look.steps, facts=_facts(look))
        if self._progress.disable and time.perf_counter() - self._shown > _QUIET_SECONDS:
            self._shown = time.perf_counter()
            self._console.print(f"           {self._name}: {_facts(look)}", markup=False)


def _facts(look: Look) -> str:
    parts = [f"step {look.step}/{look.steps}"]
    if not math.isnan(look.psnr):
        parts.append(f"held-out {look.psnr:.2f} dB")
    if isinstance(look, FitProgress):
        parts.append(f"{look.rays_per_second / 1e3:.0f}k rays/s")
        left = look.seconds_left
    else:
        left = look.seconds * (look.steps / max(look.step, 1) - 1)
    return "  ".join([*parts, f"{left:.0f} s left"])


def _peak_memory() -> float:
    """Bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def duration(seconds: float) -> str:
    """About so long, in words."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
