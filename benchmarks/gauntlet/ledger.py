"""How often each seed was run: what a seed has shown cannot be unseen, so figures are reported on others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from refield.scene.errors import InputError
from refield.scene.files import read_json, write_json

_PURPOSES = {
    "developing": (range(0, 1000), range(2000, 3000)),
    "reporting": (range(1000, 2000), range(3000, 4000)),
}
"""From 2000 on random worlds are of every kind of capture."""


def is_for(purpose: str, seed: int) -> bool:
    """Whether a seed is for ``developing`` or for ``reporting``."""
    return any(seed in part for part in _PURPOSES[purpose])


class Ledger:
    """Runs per seed, in a file that is committed; of random worlds, or of changes in real photographs."""

    def __init__(self, path: Path, of: Literal["worlds", "rehearsals"] = "worlds") -> None:
        self.path, self._of = path, of
        self._all = read_json(path) if path.is_file() else {}
        self.runs: dict[int, int] = {int(seed): int(count) for seed, count in self._all.get(of, {}).items()}

    def claim(self, seeds: Sequence[int], *, again: bool) -> None:
        """Count a run of each seed, before it is run.

        Raises:
            InputError: a seed belongs to neither range, or was reported on before and not ``again``.
        """
        outside = [s for s in seeds if not any(is_for(purpose, s) for purpose in _PURPOSES)]
        if outside:
            what = f"{outside[0]} is neither for developing (0 to 999, from 2000) nor for reporting (from 1000, 3000)"
            raise InputError("--seeds", what, "choose others")
        used = [s for s in seeds if is_for("reporting", s) and self.runs.get(s)]
        if used and not again:
            what = f"{len(used)} of them were reported on before ({used[0]} {self.runs[used[0]]} times)"
            raise InputError("--seeds", what, "choose fresh ones, or pass --again, which the table will tell")
        for seed in seeds:
            self.runs[seed] = self.runs.get(seed, 0) + 1
        if seeds:
            write_json(self.path, self._all | {self._of: {str(s): self.runs[s] for s in sorted(self.runs)}})

    def told(self, seeds: Sequence[int]) -> str:
        """One line for a table: what the seeds are for, and how often they ran."""
        parts = []
        for purpose in _PURPOSES:
            mine = [self.runs.get(s, 0) for s in seeds if is_for(purpose, s)]
            if mine:
                often = f"{min(mine)}" if min(mine) == max(mine) else f"{min(mine)} to {max(mine)}"
                parts.append(f"{len(mine)} seeds for {purpose}, each run {often} time{'s' if max(mine) != 1 else ''}")
        return "; ".join(parts)
