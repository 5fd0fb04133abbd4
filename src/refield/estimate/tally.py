"""How far a search is that finds out as it goes how much there is to ask."""

from __future__ import annotations

from collections.abc import Callable

OnCount = Callable[[int, int], None]
"""Called with how many were made, and how many there are in all as far as is known."""


class Tally:
    """Attempts that were made, and those that are known to come."""

    def __init__(self, tell: OnCount | None = None) -> None:
        self._tell = tell or (lambda done, total: None)
        self._made = 0
        self._coming = 0

    def expect(self, coming: int) -> None:
        """So many are to come now, whatever was expected before."""
        self._coming = coming

    def count(self) -> None:
        """One more was made."""
        self._made += 1
        self._coming = max(self._coming - 1, 0)
        self._tell(self._made, self._made + self._coming)
