"""How good a field in training is after so many seconds, without the seconds that it takes to find out (Fig. 15)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from refield.field.radiance import Field, HashField

Scores = dict[str, float | None]
"""name -> value; None where there is none"""
Score = Callable[[Field], Scores]


@dataclass(frozen=True)
class Point:
    """One look."""

    step: int
    seconds: float
    """of training until then; looks are not counted"""
    scores: Scores


class Curve:
    """Scores a running fit at chosen steps: hand it to ``fit_field`` as ``on_step``, from its making on the clock runs.

    The field is scored as a new one would be: only where it looks, not in training. Of a fit that began anew the last
    attempt's looks are kept; its seconds hold those of the attempts before.
    """

    def __init__(self, score: Score, steps: Sequence[int]) -> None:
        self.points: list[Point] = []
        self._score, self._steps = score, frozenset(steps)
        self._began, self._looking = time.perf_counter(), 0.0

    @property
    def seconds(self) -> float:
        """Since the beginning, without the looks."""
        return time.perf_counter() - self._began - self._looking

    def __call__(self, step: int, field: HashField) -> None:
        if self.points and step < self.points[-1].step:  # the fit has begun anew; what it had is no part of it
            self.points.clear()
        if step in self._steps:
            training = field.training
            self.look(step, field.eval())
            field.train(training)

    def look(self, step: int, field: Field) -> None:
        """Note a field's scores, while the clock stands."""
        seconds = self.seconds
        stopped = time.perf_counter()
        with torch.no_grad():
            self.points.append(Point(step, seconds, self._score(field)))
        self._looking += time.perf_counter() - stopped


def looks_until(steps: int, count: int = 16) -> list[int]:
    """``count`` steps before the last to look at, closer together at the beginning, where most is learnt."""
    return sorted({max(1, round(steps * (k / (count + 1)) ** 2)) for k in range(1, count + 1)})


def time_to(points: Sequence[Point], name: str, value: float) -> float | None:
    """Seconds of training until a score was first reached; None if it never was."""
    return next((p.seconds for p in points if (s := p.scores.get(name)) is not None and s >= value), None)


def settled(points: Sequence[Point], window: int, gain: float = 5e-4) -> Point | None:
    """The first look from which SSIM of whole views rises by less than ``gain`` until ``window`` steps have been taken.

    The paper's rule of convergence (§11.3.2; its window is 2500 steps). None if the looks end before that is seen.
    """
    known = [(p, v) for p in points if (v := p.scores.get("ssim")) is not None]
    for i, (point, value) in enumerate(known):
        end = next((j for j, (p, _) in enumerate(known) if p.step >= point.step + window), None)
        if end is not None and max(v for _, v in known[i + 1 : end + 1]) < value + gain:
            return point
    return None
