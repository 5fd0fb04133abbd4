"""``python watch.py FILE ARGUMENTS…``: a command of refield in this process, its looks and memory into ``FILE``.

The command is the user's own, by `refield.cli`; what its progress line is told is written down as well.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterator
from pathlib import Path

from refield.cli import main as refield
from refield.commands.clock import Look, TrainingLine
from refield.scene.files import write_json

Looks = list[dict[str, float]]


@contextlib.contextmanager
def watching() -> Iterator[Looks]:
    """What progress lines in the block are told: step, seconds of training, PSNR of left-out pixels in dB."""
    looks: Looks = []
    usual = TrainingLine.__call__

    def heard(self: TrainingLine, look: Look) -> None:
        if math.isfinite(look.psnr):
            looks.append({"step": look.step, "seconds": look.seconds, "psnr": look.psnr})
        usual(self, look)

    TrainingLine.__call__ = heard  # type: ignore[method-assign]
    try:
        yield looks
    finally:
        TrainingLine.__call__ = usual  # type: ignore[method-assign]


def peak() -> float | None:
    """GB that this process held at most; None where the system does not tell. A parent's do not count, unlike in
    ``getrusage``."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) * 1024 / 1e9 for line in lines if line.startswith("VmHWM")), None)


if __name__ == "__main__":
    with watching() as told:
        code = refield(sys.argv[2:])
    write_json(Path(sys.argv[1]), {"looks": told, "peak": peak()})
    sys.exit(code)
