"""One object, hard to see or to place: thin, hardly moved, turned on the spot, or out at the edge."""

from __future__ import annotations

import numpy as np

from refield.synthetic.placing import box_item, lit, round_item, standing, stood, with_moved, world_rng, wrapped
from refield.synthetic.shapes import Cylinder, Sphere
from refield.synthetic.state import Item, World


def _sticks(rng: np.random.Generator) -> tuple[Item, Item]:
    """A pole of 5 cm and a board of 4 cm that stands on its long edge."""
    solid = Cylinder(0.025, 0.5)
    paint = wrapped(rng, solid, 0.03, cells=30)
    pole = Item("pole", solid, paint, standing(solid, -0.1, 0.35), glossy=True)
    return pole, box_item(rng, "board", (0.28, 0.02, 0.16), 0.6, (-0.25, -0.25, 20))


def thin(seed: int = 0) -> World:
    """A thin board on its edge moves and turns; a thin pole stays."""
    rng = world_rng(seed, "thin")
    pole, board = _sticks(rng)
    return with_moved("thin", lit(rng, (pole, board), "tiles"), stood(board, 0.35, 0.1, 75))


def pole(seed: int = 0) -> World:
    """The thin pole moves; the board stays."""
    rng = world_rng(seed, "pole")
    stick, board = _sticks(rng)
    return with_moved("pole", lit(rng, (stick, board), "bricks"), stood(stick, 0.4, 0.0, 130))


def nudged(seed: int = 0) -> World:
    """A box moved by a fifth of its size and turned by 8 degrees: old and new place overlap."""
    rng = world_rng(seed, "nudged")
    item = box_item(rng, "box", (0.2, 0.18, 0.19), 0.6, (-0.04, -0.03, 20))
    return with_moved("nudged", lit(rng, (item,), "tiles"), item.turned(8, (0.064, 0.048, 0)))


def turned(seed: int = 0) -> World:
    """A box turned half round and shifted a little: the same shape in nearly the same place."""
    rng = world_rng(seed, "turned")
    item = box_item(rng, "box", (0.22, 0.16, 0.18), 0.35, (-0.03, -0.02, 30))
    return with_moved("turned", lit(rng, (item,), "bricks"), item.turned(180, (0.05, 0.03, 0)))


def spun(seed: int = 0) -> World:
    """A long box turned by 90 degrees about its own middle, not shifted."""
    rng = world_rng(seed, "spun")
    item = box_item(rng, "box", (0.27, 0.14, 0.17), 0.75, (0, 0, 10))
    return with_moved("spun", lit(rng, (item,), "wood"), item.turned(90, (0, 0, 0)))


def edge(seed: int = 0) -> World:
    """A box moves far to the side, where some views no longer show it; a ball stays in the middle."""
    rng = world_rng(seed, "edge")
    box = box_item(rng, "box", (0.17, 0.15, 0.16), 0.6, (-0.3, -0.25, 20))
    ball = round_item(rng, "ball", Sphere(0.15), 0.1, (0.15, 0.2, 0))
    return with_moved("edge", lit(rng, (box, ball), "tiles"), stood(box, 0.85, 0.75, 65))
