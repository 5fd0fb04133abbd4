"""How long kernels were compiled: once on a machine, and no part of what a fit may take."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event

_KIND = "numba:compile"


class Compiling(event.Listener):
    """Adds up the time in which something is compiled, one within the other counted once."""

    def __init__(self) -> None:
        self._depth, self._since = 0, 0.0
        self.seconds = 0.0
        """so far"""

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._since = time.perf_counter()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._since


@contextmanager
def compiling() -> Iterator[Compiling]:
    """Listen while the block runs."""
    listener = Compiling()
    event.register(_KIND, listener)
    try:
        yield listener
    finally:
        event.unregister(_KIND, listener)
