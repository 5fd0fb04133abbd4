"""What a section of the GPU benchmark found: tables of rows and what failed, on disk after every row."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

Row = dict[str, Any]
"""Column → value; a key that starts with an underscore is for the JSON alone."""


class Report:
    """Tables of one section. Every change is written at once: the process may be stopped at any time."""

    def __init__(self, path: Path, seconds: float) -> None:
        """``seconds``: left for the section."""
        self._path, self._until = path, time.monotonic() + seconds
        self.tables: dict[str, list[Row]] = {}
        self.failed: list[str] = []
        self._write()

    def add(self, table: str, row: Row) -> None:
        self.tables.setdefault(table, []).append(row)
        self._write()

    @property
    def left(self) -> float:
        """Seconds."""
        return self._until - time.monotonic()

    @contextmanager
    def trial(self, what: str) -> Iterator[None]:
        """Go on after whatever goes wrong in the block, which is noted in one line."""
        try:
            yield
        except Exception as error:
            self.note(f"{what}: {one_line(error)}")

    def note(self, failed: str) -> None:
        """One line about what did not work."""
        self.failed.append(failed)
        self._write()

    def _write(self) -> None:
        self._path.write_text(json.dumps({"tables": self.tables, "failed": self.failed}))


def one_line(error: BaseException) -> str:
    """The kind of error and the first line of what it says."""
    said = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {said}"[:240]


def cell(value: Any) -> str:
    """A value in a Markdown table: four digits, a dash for what is not known."""
    if value is None or (isinstance(value, float) and value != value):
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value).replace("|", "/").replace("\n", " ")


def markdown(rows: list[Row]) -> str:
    """Rows as a table; columns in the order in which they first appear."""
    columns = list(dict.fromkeys(k for row in rows for k in row if not k.startswith("_")))
    lines = [columns, ["---"] * len(columns), *([cell(row.get(c)) for c in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def median(values: list[float | None]) -> float | None:
    """Of those that are known; None unless more than half are."""
    known = [v for v in values if v is not None]
    return statistics.median(known) if 2 * len(known) > len(values) else None


def timed(work: Callable[[], object], device: torch.device, calls: int = 10, repeats: int = 5) -> tuple[float, str]:
    """Milliseconds of one call, the median of ``repeats``, and how they were taken.

    On a GPU ``calls`` of them are held in a CUDA graph and replayed between two events, so that no launch is waited
    for; what cannot be held in one runs call by call between the same events.
    """
    if device.type != "cuda":
        work()
        return _host_clock(work, repeats), "host clock"
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            work()
    torch.cuda.current_stream().wait_stream(side)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    try:
        with torch.cuda.graph(graph):
            for _ in range(calls):
                work()
        return _between_events(graph.replay, repeats) / calls, "graph"
    except Exception:
        torch.cuda.synchronize()
        return _between_events(lambda: [work() for _ in range(calls)], repeats) / calls, "eager"


def _host_clock(work: Callable[[], object], repeats: int) -> float:
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        taken.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(taken)


def _between_events(work: Callable[[], object], repeats: int) -> float:
    work()
    taken = []
    for _ in range(repeats):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        work()
        end.record()
        end.synchronize()
        taken.append(begin.elapsed_time(end))
    return statistics.median(taken)


def peak_memory(device: torch.device) -> Row:
    """GiB since the last :func:`forget_peaks`; nothing without a GPU."""
    if device.type != "cuda":
        return {"peak GiB": None, "reserved GiB": None}
    peaks = torch.cuda.max_memory_allocated(), torch.cuda.max_memory_reserved()
    return {"peak GiB": peaks[0] / 2**30, "reserved GiB": peaks[1] / 2**30}


def forget_peaks(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
