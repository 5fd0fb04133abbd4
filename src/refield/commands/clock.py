"""What the user sees while waiting: stages with their seconds, a progress line, warnings; all on stderr."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from refield.field.fit import FitProgress

_WIDE = 120
_QUIET_SECONDS = 5.0  # without a terminal a progress line appears this often


def results() -> Console:
    """Where tables of results go: stdout, wide enough for them even where it is no terminal."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else _WIDE)


class Clock:
    """Keeps the time of each stage, and what the user was warned of."""

    def __init__(self) -> None:
        self.console = Console(stderr=True, highlight=False, soft_wrap=True)
        self.seconds: dict[str, float] = {}
        self.warnings: list[str] = []
        self._stage: str | None = None
        self._since = self._began = time.perf_counter()

    @property
    def total(self) -> float:
        """Seconds since the clock was made."""
        return time.perf_counter() - self._began

    def stage(self, name: str) -> None:
        """A stage begins; the one before it ends. The ``on_stage`` of every recipe."""
        self._close()
        self._stage = name
        self.console.print(f"[{self.total:6.1f} s] {name}", markup=False)

    def stop(self) -> None:
        """The last stage ends."""
        self._close()
        self._stage = None

    def warn(self, message: str) -> None:
        """The ``warn`` of every loader."""
        self.warnings.append(message)
        self.console.print(f"warning: {message}", markup=False)

    def _close(self) -> None:
        now = time.perf_counter()
        if self._stage is not None:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
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
            disable=not self.console.is_terminal,
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
                if self.console.is_terminal:
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
            disable=not self.console.is_terminal,
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

    def __call__(self, look: Look) -> None:
        self.psnr = look.psnr
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
