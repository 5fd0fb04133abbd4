"""How much a browser is given to draw while the view moves: as much as it draws ten times a second, and no more.

Nothing tells what a browser runs on. But it sends a message with each picture that it draws while its camera moves, so
their times tell how long a picture takes there. What takes too long is left at once; more is tried only while the view
stands, where a picture of ours hides it, and only where there is much time to spare. What turned out to be too much is
not tried again soon, and later each time: so nothing flickers.
"""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

PICTURE = 0.1
"""seconds that a picture may take while the view moves"""
_FIRST = 2  # pictures after a change tell nothing of the others: programs are compiled for them
_FEW, _ENOUGH = 3, 5  # times between messages that tell something, and of which the median is taken
_STANDS, _STANDS_AT_FIRST = (0.25, 1.5), 1.0  # seconds without a picture after which a view stands
_STILL = 4.0  # so many times as long as a picture takes it has to be
_LATER = 30.0  # seconds until what was too much is tried again, at first
_LATER_YET = 4.0  # times as long after each time that it was too much once more


@dataclass(frozen=True)
class Detail:
    """What is drawn of a state."""

    kind: Literal["points", "splats"]
    part: float
    """of all that there are"""
    spare: float = 1.0
    """so many times quicker than it may be a picture of the detail before has to be, for this one to be tried"""


DETAILS = (
    Detail("points", 1 / 16),
    Detail("points", 1 / 4, 1.6),
    Detail("points", 1.0, 2.0),
    Detail("splats", 1.0, 4.0),
)
"""from what is quickly drawn to what takes longest: where a processor draws, that goes with the points' area more than
with their number, and a splat takes as long as 14 points"""


@dataclass
class Pace:
    """Follows one browser. Times are seconds of any one clock."""

    _step: int = 0
    _moves: bool = False
    _last: float | None = None
    _count: int = 0
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=_ENOUGH))
    _not_before: dict[int, float] = field(default_factory=dict)
    _wait: dict[int, float] = field(default_factory=dict)

    @property
    def detail(self) -> Detail:
        """What is to be drawn now."""
        return DETAILS[self._step]

    @property
    def rest(self) -> float:
        """Seconds without a picture after which the view stands. A browser that is slow is given time, else it would
        have to share the processor with our own picture while it moves."""
        if not self._moves:
            return _STANDS[0]
        if len(self._times) < _FEW:
            return _STANDS_AT_FIRST
        return min(max(_STILL * statistics.median(self._times), _STANDS[0]), _STANDS[1])

    def set_out(self) -> None:
        """The view stood, and begins to move."""
        self._last, self._count, self._moves = None, 0, True
        self._times.clear()

    def picture(self, now: float) -> bool:
        """Another picture was drawn while the view moves; whether less is to be drawn from here on."""
        if now == self._last:  # the same one is told twice
            return False
        if self._last is not None and self._count > _FIRST:
            self._times.append(now - self._last)
        self._last, self._count = now, self._count + 1
        if self._step == 0 or len(self._times) < _FEW or statistics.median(self._times) <= PICTURE:
            return False
        wait = self._wait.get(self._step, _LATER)
        self._not_before[self._step], self._wait[self._step] = now + wait, wait * _LATER_YET
        self._step -= 1
        self.set_out()
        return True

    def rests(self, now: float) -> bool:
        """The view stands; whether more is to be drawn the next time."""
        self._moves = False
        if len(self._times) < _ENOUGH:
            return False
        before, expected = self._step, statistics.median(self._times)
        while self._step + 1 < len(DETAILS) and now >= self._not_before.get(self._step + 1, now):
            expected *= DETAILS[self._step + 1].spare
            if expected > PICTURE:
                break
            self._step += 1
        return self._step > before
