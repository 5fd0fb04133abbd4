"""Which fits are given up early, and what is tried in their place: photos that are left out say so."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

# Some fits of a scene with a repeating texture, seen from all around, end in foam before the cameras: a few in a
# hundred, of some captures most. Another seed does not. Foam is photos learnt by heart: those that are left out gain
# nothing by it. From the first of these steps to the next, left-out photos gained -0.5 to 0.04 of what those that
# teach did (in dB) in four foamed fits of one world, 0.27 to 0.67 in six sound ones of three real scenes, 0.7 and more
# in nine others.
# Others fall later: left-out photos of one of 36 random worlds gained 0.15 to step 500 and 0.04 to step 750, and were
# shown 8 dB worse in the end than by other seeds.
FIRST_STEP, LATER_STEPS = 100, (500, 750)
LATE = 0.3  # of its time; so late a fit does not begin anew
_TRIES = 5
_BY_HEART = 0.1
# Plain walls and floors that end up before the cameras are learnt by heart as well, but not all that stands on them is:
# to this step left-out photos gained 0.08 to 0.32 of what those that teach did in six random worlds, of three of which
# the weight below made fits 2 to 7 dB better, and 0.36 and more in all others that were asked, of two of which it made
# fits 1 to 9 dB worse (0.61 and 0.66). So where they gained less than half, a fit with it is asked as well, and the one
# that shows them better goes on.
DOUBT_STEP = 400
ASKED = (FIRST_STEP, DOUBT_STEP, *LATER_STEPS)
_DOUBTFUL = 0.5
_NEARNESS = 0.3


class StuckError(RuntimeError):
    """What the fit has built before the cameras hides the scene, or may hide it, and something else is tried."""

    def __init__(self, left_out: float, step: int) -> None:
        super().__init__()
        self.left_out, self.step = left_out, step
        """PSNR of photos that are left out, dB, at the step of `ASKED` at which it was given up"""


@dataclass(frozen=True)
class Patience:
    """What a fit may be given up for."""

    stuck: bool = False
    """at one of `LATER_STEPS`: what it learns is no use to the photos that are left out"""
    doubt: bool = False
    """at `DOUBT_STEP`: less than half of it is"""
    rival: float = -math.inf
    """at `DOUBT_STEP`: it shows them no better than another fit did, dB"""

    def is_late(self, step: int, progress: Callable[[float], float]) -> bool:
        """Whether it is too late to begin anew at a step; ``progress``: of the fit's time, once it took so many times
        as long as now."""
        if step in LATER_STEPS:
            return progress(1) >= LATE
        # the second fit is judged whatever the time: it may be the worse one; so it begins only if that is in time
        return step == DOUBT_STEP and self.doubt and progress(2) >= LATE

    def ends(self, step: int, left_out: float, gained: tuple[float, float]) -> bool:
        """Whether a fit ends at a step at which it was asked; ``left_out``: how it shows the photos that are left out,
        dB, NaN if there are none; ``gained``: what they and those that teach gained since `FIRST_STEP`, dB."""
        useful, taught = gained
        if step == DOUBT_STEP:
            return left_out <= self.rival or (self.doubt and taught > 0 and useful < _DOUBTFUL * taught)
        return self.stuck and taught > 0 and useful < _BY_HEART * taught


ENDLESS = Patience()


class Attempts:
    """What the next fit of the same photos begins with."""

    def __init__(self, nearness: float | None, steps: int, may_give_up: bool) -> None:
        """``nearness``: as `FitConfig` has it; None: it is found out, if fits of so many ``steps`` may be given up and
        are long enough for a second opinion."""
        self.seed, self.nearness = 0, nearness or 0.0
        """the first is added to the config's"""
        self.patience = Patience(may_give_up, doubt=nearness is None and may_give_up and LATE * steps > DOUBT_STEP)
        self._begun = self.nearness, self.patience
        self._ended: list[tuple[float, int, float]] = []  # left-out PSNR, seed and nearness of each that was stuck

    def give_up(self, error: StuckError) -> None:
        """The last one ended so."""
        if error.step == DOUBT_STEP:  # in the second fit, of the first: there is no third opinion
            first = self.patience.doubt
            self.nearness = _NEARNESS if first else 0.0
            self.patience = Patience(True, rival=error.left_out if first else -math.inf)
            return
        self._ended.append((error.left_out, self.seed, self.nearness))
        if len(self._ended) < _TRIES - 1:
            self.seed, (self.nearness, self.patience) = len(self._ended), self._begun
        else:  # the best of those before, to its end
            _, self.seed, self.nearness = max(self._ended, key=lambda one: one[0])
            self.patience = ENDLESS
