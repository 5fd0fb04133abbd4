"""Objects set down in a place, and what happens to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from refield.synthetic import random_changes as change
from refield.synthetic.random_objects import drawn_item, round_about_z
from refield.synthetic.random_places import Place
from refield.synthetic.random_textures import Pattern
from refield.synthetic.state import Item

_SPOTS = 25  # places tried for one object
_NOTHING = 0.1  # of the worlds
_HOW_MANY = (0.55, 0.3, 0.15)  # of the others change 1, 2, 3 objects
_PLACED_TIPPED, _PLACED_STACKED = 0.12, 0.12  # of the objects
_KINDS = {"moved": 0.24, "slid": 0.1, "turned": 0.14, "tipped": 0.14, "stacked": 0.12, "swapped": 0.08,
          "removed": 0.1, "added": 0.08}  # fmt: skip


@dataclass(frozen=True)
class Thing:
    """An object and how it was drawn."""

    item: Item
    family: str
    pattern: Pattern


@dataclass(frozen=True)
class Drawn:
    """Both states' objects, and what happened to each, by name."""

    things: tuple[Thing, ...]
    before: tuple[Item, ...]
    after: tuple[Item, ...]
    kinds: dict[str, str]

    @property
    def changed(self) -> list[str]:
        """Names of the objects that something happened to."""
        return [name for name, kind in self.kinds.items() if kind != "none"]


def draw_kinds(rng: np.random.Generator) -> tuple[str, ...]:
    """What is to happen, to an object each (swapped: to two); drawn once, so that what is hard is not rarer."""
    if rng.random() < _NOTHING:
        return ()
    count = 1 + int(rng.choice(len(_HOW_MANY), p=_HOW_MANY))
    return tuple(str(kind) for kind in rng.choice(list(_KINDS), count, p=list(_KINDS.values())))


def draw_things(rng: np.random.Generator, place: Place, kinds: Sequence[str]) -> tuple[Thing, ...] | None:
    """1 to 6 objects, enough for the changes, clear of each other and of the place; None where none fitted."""
    things: list[Thing] = []
    least = len(kinds) + kinds.count("swapped") + ("stacked" in kinds)
    for k in range(int(rng.integers(max(least, 1), max(least, 6) + 1))):
        size = place.largest * float(rng.uniform(0.4, 1.0))
        item, family, pattern = drawn_item(rng, f"object {k}", size)
        turn = None
        if rng.random() < _PLACED_TIPPED:
            turn = change.other_face(rng, item)
        on_top = things and rng.random() < _PLACED_STACKED
        placed = None
        if on_top:
            placed = _onto(rng, item, [thing.item for thing in things], place, turn)
        if placed is None:
            placed = _somewhere(rng, item, [thing.item for thing in things], place, turn)
        if placed is not None:
            things.append(Thing(placed, family, pattern))
    return tuple(things) or None


def _somewhere(
    rng: np.random.Generator, item: Item, others: Sequence[Item], place: Place, turn: change.Matrix | None
) -> Item | None:
    for _ in range(_SPOTS):
        patch = place.patches[int(rng.integers(len(place.patches)))]
        placed = change.rested(rng, item, patch, turn)
        if placed is not None and change.apart(placed, [*others, *place.items[1:]]):
            return placed
    return None


def _onto(
    rng: np.random.Generator, item: Item, others: Sequence[Item], place: Place, turn: change.Matrix | None = None
) -> Item | None:
    for i in rng.permutation(len(others)):
        if turn is not None:
            item = replace(
                item, world_from_item=change.placed_on(item, place.patches[0], (0.0, 0.0), turn).world_from_item
            )
        placed = change.stacked(rng, item, others[int(i)])
        if placed is not None and change.apart(placed, [*others, *place.items[1:]]):
            return placed
    return None


def _bearing(items: Sequence[Item]) -> set[str]:
    """Names of the objects that others stand on: they are left alone."""
    out = set()
    for a in items:
        low, high = change.extent(a)
        for b in items:
            theirs = change.extent(b)
            over = (low[:2] < theirs[1, :2]).all() and (high[:2] > theirs[0, :2]).all()
            if a is not b and over and abs(low[2] - theirs[1, 2]) < 0.01:
                out.add(b.name)
    return out


def draw_change(rng: np.random.Generator, place: Place, things: Sequence[Thing], kinds: Sequence[str]) -> Drawn | None:
    """Objects changed in these ways; None where what was drawn is not possible."""
    items = {thing.item.name: thing.item for thing in things}
    before, after, told = dict(items), dict(items), dict.fromkeys(items, "none")
    for kind in kinds:
        bearing = _bearing(list(before.values())) | _bearing(list(after.values()))
        free = [name for name in items if told[name] == "none" and name not in bearing]
        if len(free) < 1 + (kind == "swapped"):
            return None
        name, *others = [free[int(i)] for i in rng.permutation(len(free))]
        told[name] = kind
        if kind == "added":
            del before[name]
        elif kind == "removed":
            del after[name]
        elif kind == "swapped":
            told[others[0]] = kind
            if not _swap(rng, place, after, name, others[0]):
                return None
        else:
            rest = [item for other, item in after.items() if other != name]
            new = _MOVES[kind](rng, after[name], rest, place)
            if new is None or not change.moved_enough(before[name], new):
                return None
            after[name] = new
    return Drawn(tuple(things), tuple(before.values()), tuple(after.values()), told)


def _moved(rng: np.random.Generator, item: Item, others: Sequence[Item], place: Place) -> Item | None:
    return _somewhere(rng, item, others, place, change.upright(item))


def _slid(rng: np.random.Generator, item: Item, others: Sequence[Item], place: Place) -> Item | None:
    """A little, by a third of its size up to all of it."""
    size = 2 * float(np.sqrt(np.mean(np.square(item.solid.half))))
    patch = _under(item, place)
    if patch is None:
        return None
    for _ in range(_SPOTS):
        way, far = float(rng.uniform(0, 2 * np.pi)), size * float(rng.uniform(0.35, 1.0))
        x, y = item.world_from_item[:2, 3].tolist()
        x, y = x + far * float(np.cos(way)), y + far * float(np.sin(way))
        turn = change.about_z(float(rng.uniform(-0.5, 0.5))) @ change.upright(item)
        new = change.placed_on(item, patch, (x, y), turn)
        inside = patch.low[0] < x < patch.high[0] and patch.low[1] < y < patch.high[1]
        if inside and change.apart(new, [*others, *place.items[1:]]):
            return new
    return None


def _under(item: Item, place: Place) -> change.Support | None:
    """The patch that it stands on; None where it stands on another object."""
    x, y = item.world_from_item[:2, 3].tolist()
    lowest = float(change.extent(item)[0, 2])
    for patch in place.patches:
        inside = patch.low[0] <= x <= patch.high[0] and patch.low[1] <= y <= patch.high[1]
        if inside and abs(float(patch.heights(np.array(x), np.array(y))) - lowest) < 0.35 * max(item.solid.half):
            return patch
    return None


def _turned(rng: np.random.Generator, item: Item, others: Sequence[Item], place: Place) -> Item | None:
    """About the upright where it stands, by 25 to 65 degrees: a square looks the same again at 90."""
    patch = _under(item, place)
    if patch is None or round_about_z(item.solid):
        return None
    angle = float(np.deg2rad(rng.uniform(25, 65))) * (1 if rng.random() < 0.5 else -1)
    x, y = item.world_from_item[:2, 3].tolist()
    new = change.placed_on(item, patch, (x, y), change.about_z(angle) @ change.upright(item))
    return new if change.apart(new, [*others, *place.items[1:]]) else None


def _tipped(rng: np.random.Generator, item: Item, others: Sequence[Item], place: Place) -> Item | None:
    turn = change.other_face(rng, item)
    return None if turn is None else _somewhere(rng, item, others, place, turn)


def _stacked(rng: np.random.Generator, item: Item, others: Sequence[Item], place: Place) -> Item | None:
    return _onto(rng, item, others, place)


def _swap(rng: np.random.Generator, place: Place, after: dict[str, Item], one: str, two: str) -> bool:
    """Two objects exchange their places; each turns a little."""
    a, b = after[one], after[two]
    patches = _under(a, place), _under(b, place)
    if patches[0] is None or patches[1] is None:
        return False
    spots = [tuple(item.world_from_item[:2, 3].tolist()) for item in (a, b)]
    turns = [change.about_z(float(rng.uniform(-0.6, 0.6))) @ change.upright(item) for item in (a, b)]
    after[one] = change.placed_on(a, patches[1], spots[1], turns[0])
    after[two] = change.placed_on(b, patches[0], spots[0], turns[1])
    rest = [item for name, item in after.items() if name not in (one, two)]
    return change.all_apart([after[one], after[two]], [*rest, *place.items[1:]])


_Move = Callable[[np.random.Generator, Item, Sequence[Item], Place], Item | None]
_MOVES: dict[str, _Move] = {
    "moved": _moved, "slid": _slid, "turned": _turned, "tipped": _tipped, "stacked": _stacked,
}  # fmt: skip
