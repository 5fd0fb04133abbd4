"""One field is asked at a time: the compiled loops take all cores, and some schedulers of theirs cannot be shared.

Who waits for a picture goes before who prepares splats.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator


class Turns:
    """Take turns in asking fields, from several threads."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._busy, self._urgent = False, 0

    @contextlib.contextmanager
    def first(self) -> Iterator[None]:
        """The next turn, for something short."""
        with self._changed:
            self._urgent += 1
            self._changed.wait_for(lambda: not self._busy)
            self._urgent -= 1
            self._busy = True
        try:
            yield
        finally:
            self._end()

    @contextlib.contextmanager
    def later(self) -> Iterator[None]:
        """A turn when nobody waits for a picture; let others in by `give_way` meanwhile."""
        self._wait()
        try:
            yield
        finally:
            self._end()

    def give_way(self) -> None:
        """End a turn that was taken by `later` for as long as somebody waits for a picture."""
        if self._urgent:
            self._end()
            self._wait()

    def _wait(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: not self._busy and not self._urgent)
            self._busy = True

    def _end(self) -> None:
        with self._changed:
            self._busy = False
            self._changed.notify_all()
