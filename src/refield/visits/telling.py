"""Who hears how an update goes on: the command line's clock, or whoever asked from Python."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Protocol

from refield.photos.motion import Counting, silent
from refield.scene.files import log_warning
from refield.scene.left_out import Warn
from refield.update.fit_helper import UpdateProgress

OnStage = Callable[[str], None]
OnProgress = Callable[[UpdateProgress], None]


class Telling(Protocol):
    """What the making of a visit has to say, and what its report asks for afterwards."""

    @property
    def seconds(self) -> dict[str, float]:
        """Per stage, in the order in which they ran."""

    @property
    def warnings(self) -> list[str]:
        """Everything that was warned of."""

    def stage(self, name: str) -> None:
        """A stage begins; the one before it ends."""

    def stop(self) -> None:
        """The last stage ends."""

    def warn(self, message: str) -> None:
        """Something that the user should know."""

    def counters(self) -> AbstractContextManager[Counting]:
        """For things that are counted, such as photos."""

    def training(self, name: str) -> AbstractContextManager[OnProgress]:
        """For the looks at a training."""


class Hearer:
    """Tells those who asked to hear, and prints nothing itself."""

    def __init__(
        self, on_stage: OnStage | None = None, on_progress: OnProgress | None = None, warn: Warn = log_warning
    ) -> None:
        self.seconds: dict[str, float] = {}
        self.warnings: list[str] = []
        self._on_stage, self._on_progress, self._warn = on_stage, on_progress, warn
        self._running: tuple[str, float] | None = None

    def stage(self, name: str) -> None:
        """See `Telling`."""
        self.stop()
        self._running = name, time.perf_counter()
        if self._on_stage is not None:
            self._on_stage(name)

    def stop(self) -> None:
        """See `Telling`."""
        if self._running is not None:
            name, since = self._running
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - since
        self._running = None

    def warn(self, message: str) -> None:
        """See `Telling`."""
        self.warnings.append(message)
        self._warn(message)

    @contextlib.contextmanager
    def counters(self) -> Iterator[Counting]:
        """See `Telling`."""
        yield silent

    @contextlib.contextmanager
    def training(self, name: str) -> Iterator[OnProgress]:
        """See `Telling`."""
        yield self._on_progress or (lambda look: None)
