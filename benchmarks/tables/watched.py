"""The update with its helper looked at while it trains, for curves (Fig. 15)."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from refield.baselines.curve import Point, Score
from refield.field.radiance import HashField
from refield.scene.capture import Capture
from refield.scene.change import SceneChange
from refield.update import train
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.fit_helper import HelperTraining, UpdateProgress


@dataclass(frozen=True)
class Snapshot:
    """The helper at one look."""

    step: int
    at: float
    """of the process' clock"""
    helper: HashField
    frozen: UpdatedField

    def field(self) -> UpdatedField:
        """What the update would have given had it ended here."""
        f = self.frozen
        return f.but(learnt=replace(f.learnt, helper=self.helper))


@contextmanager
def watching() -> Iterator[list[Snapshot]]:
    """Updates in the block leave a copy of their helper at each look at the held-out pixels (some ms each)."""
    seen: list[Snapshot] = []

    class Watched(HelperTraining):
        def run(self, on_progress: Callable[[UpdateProgress], None] | None = None) -> list[float]:
            def look(progress: UpdateProgress) -> None:
                tensors, facts = self.helper.state()
                helper = HashField.from_state({k: v.clone() for k, v in tensors.items()}, facts)
                seen.append(Snapshot(progress.step, time.perf_counter(), helper, self.frozen))
                if on_progress is not None:
                    on_progress(progress)

            return super().run(look)

    usual, train.HelperTraining = train.HelperTraining, Watched  # type: ignore[misc]
    try:
        yield seen
    finally:
        train.HelperTraining = usual  # type: ignore[misc]


@dataclass(frozen=True)
class Updated:
    """An update, how long its parts took, and how good it was on the way."""

    field: UpdatedField
    seconds: dict[str, float]
    """per stage"""
    curve: list[Point]
    """scored afterwards; seconds since the update began"""


def updated(
    capture: Capture, field: HashField, change: SceneChange, config: UpdateConfig, score: Score | None = None
) -> Updated:
    """`update_field` with a clock. ``score``: of the curve's points; without it there is no curve."""
    marks: list[tuple[str, float]] = []
    began = time.perf_counter()
    with watching() as seen:
        new = train.update_field(capture, field, change, config, lambda s: marks.append((s, time.perf_counter())))
    ended = time.perf_counter()
    seconds = stage_seconds(marks, ended)
    curve: list[Point] = []
    if score is not None:
        curve = [Point(s.step, s.at - began, score(s.field())) for s in seen]
        curve.append(Point(max((s.step for s in seen), default=0), ended - began, score(new)))
    return Updated(new, seconds, curve)


def stage_seconds(marks: list[tuple[str, float]], ended: float) -> dict[str, float]:
    """From when each stage began to seconds of each; a stage that comes twice is summed."""
    total: dict[str, float] = {}
    for (name, a), (_, b) in itertools.pairwise([*marks, ("", ended)]):
        total[name] = total.get(name, 0.0) + b - a
    return total
