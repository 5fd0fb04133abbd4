"""How long a fit works: not while kernels are compiled, which happens once on a machine."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from numba.core import event

_KIND = "numba:compile"


class Compiling(event.Listener):
    """Adds up the time in which something is compiled, one within the other counted once."""

    def __init__(self) -> None:
        self._depth, self._since, self._began = 0, 0.0, time.perf_counter()
        self.seconds = 0.0
        """so far"""

    @property
    def worked(self) -> float:
        """Seconds since this listens, without those."""
        return time.perf_counter() - self._began - self.seconds

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._since = time.perf_counter()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._since


@contextmanager
def compiling(triton: bool = False) -> Iterator[Compiling]:
    """Listen while the block runs, to Triton as well where kernels run on a GPU."""
    listener = Compiling()
    with ExitStack() as stack:
        event.register(_KIND, listener)
        stack.callback(event.unregister, _KIND, listener)
        if triton:
            stack.enter_context(_hearing_triton(listener))
        yield listener


@contextmanager
def _hearing_triton(listener: Compiling) -> Iterator[None]:
    """Let a listener know what Triton compiles, and whoever listened before."""
    from triton import knobs

    before = knobs.compilation.listener

    def hear(*, times: Any, **what: Any) -> None:
        listener.seconds += times.total / 1e6
        if before is not None:
            before(times=times, **what)

    knobs.compilation.listener = hear
    try:
        yield
    finally:
        knobs.compilation.listener = before
