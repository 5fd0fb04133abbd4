"""How far a search is that finds out as it goes how much there is to ask."""

from __future__ import annotations

from collections.abc import Callable

OnCount = Callable[[int, int], None]
"""Called with how many were made, and how many there are in all as far as is known: that grows with what is found, and
shrinks where less is asked beside it."""


class Tally:
    """Attempts that were made."""

    def __init__(self, tell: OnCount | None = None) -> None:
        self._tell = tell or (lambda done, total: None)
        self._made = 0

    def begin(self, coming: int) -> None:
        """So many are known to come."""
        self._tell(self._made, self._made + coming)

    def count(self, coming: int) -> None:
        """One more was made, and so many are known to come."""
        self._made += 1
        self.begin(coming)
