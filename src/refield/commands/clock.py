"""What the user sees while waiting: stages with their seconds, a progress line, warnings; all on stderr."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from refield.field.fit import FitProgress

_QUIET_SECONDS = 5.0  # without a terminal a progress line appears this often


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


class TrainingLine:
    """Shows each `FitProgress` it is called with, and remembers the last."""

    def __init__(self, console: Console, progress: Progress, task: TaskID, name: str) -> None:
        self._console, self._progress, self._task, self._name = console, progress, task, name
        self._shown = 0.0
        self.last: FitProgress | None = None

    def __call__(self, p: FitProgress) -> None:
        self.last = p
        psnr = "-" if math.isnan(p.psnr) else f"{p.psnr:.2f} dB"
        facts = f"step {p.step}/{p.steps}  held-out {psnr}  {p.rays_per_second / 1e3:.0f}k rays/s"
        facts += f"  {p.seconds_left:.0f} s left"
        self._progress.update(self._task, completed=p.step / p.steps, facts=facts)
        if self._progress.disable and time.perf_counter() - self._shown > _QUIET_SECONDS:
            self._shown = time.perf_counter()
            self._console.print(f"           {self._name}: {facts}", markup=False)
