"""Worlds we know exactly, by name: the paper's scenes (§11.1), usual ones and hard ones, before and after."""

from __future__ import annotations

from collections.abc import Callable

from refield.synthetic.crowded_worlds import docked, five, mixed, stacked, swapped, touching
from refield.synthetic.paper_worlds import cone, cube, cylinder, sphere
from refield.synthetic.state import Item, State, TrueChange, World
from refield.synthetic.subtle_worlds import edge, nudged, pole, spun, thin, turned
from refield.synthetic.unruly_worlds import deformed, elsewhere, lights_off, mirror, shiny
from refield.synthetic.usual_worlds import (
    added,
    cluttered,
    nothing,
    plain,
    removed,
    shadow,
    table,
    tipped,
    two_moved,
)

__all__ = ["WORLDS", "Item", "State", "TrueChange", "World"]

WORLDS: dict[str, Callable[[int], World]] = {
    f.__name__: f
    for f in (
        cube, cylinder, sphere, cone,
        two_moved, removed, added, tipped, shadow, plain, cluttered, table, nothing,
        thin, pole, nudged, turned, spun, edge,
        touching, docked, stacked, swapped, five, mixed,
        mirror, shiny, deformed, lights_off, elsewhere,
    )
}  # fmt: skip
"""Name → builder of a world from a seed."""
