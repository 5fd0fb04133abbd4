"""Results that are asked for again, by the identity of what they are of."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Kept(Generic[T]):
    """The latest results, and what they are of, so that it is nothing else meanwhile."""

    def __init__(self, most: int = 64) -> None:
        self._most = most
        self._found: OrderedDict[tuple[int, ...], tuple[tuple[object, ...], T]] = OrderedDict()

    def get(self, of: tuple[object, ...], make: Callable[[], T]) -> T:
        """What was made of the same objects before, else what ``make`` makes."""
        key = tuple(map(id, of))
        if key not in self._found:
            self._found[key] = of, make()
            if len(self._found) > self._most:
                self._found.popitem(last=False)
        self._found.move_to_end(key)
        return self._found[key][1]
