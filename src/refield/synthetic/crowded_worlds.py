"""Objects that touch, stand on each other, change places, or change many at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from refield.synthetic.placing import box_item, lit, round_item, stood, with_moved, world_rng
from refield.synthetic.shapes import Cone, Cylinder, Sphere
from refield.synthetic.state import Item, World

_GAP = 0.001  # metres between objects that touch: a mesh needs some


def _beside(item: Item, sideways: float) -> tuple[float, float]:
    """(x, y) in the world, so far along the item's own x axis from its middle."""
    at = item.world_from_item[:3, 3] + sideways * item.world_from_item[:3, 0]
    return float(at[0]), float(at[1])


def touching(seed: int = 0) -> World:
    """Three boxes side by side in contact; the middle one is pulled out and set down elsewhere."""
    rng = world_rng(seed, "touching")
    middle = box_item(rng, "middle", (0.15, 0.17, 0.2), 0.6, (-0.2, -0.25, 25))
    left = box_item(rng, "left", (0.16, 0.16, 0.15), 0.1, (0, 0, 0))
    right = box_item(rng, "right", (0.14, 0.18, 0.18), 0.85, (0, 0, 0))
    left = stood(left, *_beside(middle, -(0.15 + 0.16 + _GAP)), 25)
    right = stood(right, *_beside(middle, 0.15 + 0.14 + _GAP), 25)
    before = lit(rng, (left, middle, right), "tiles")
    return with_moved("touching", before, stood(middle, -0.1, 0.4, 60))


def docked(seed: int = 0) -> World:
    """A box is moved until its face touches a box that stays."""
    rng = world_rng(seed, "docked")
    quay = box_item(rng, "quay", (0.19, 0.16, 0.2), 0.08, (0.4, 0.25, 20))
    box = box_item(rng, "box", (0.17, 0.15, 0.15), 0.62, (-0.45, -0.4, -25))
    before = lit(rng, (quay, box), "bricks")
    return with_moved("docked", before, stood(box, *_beside(quay, -(0.19 + 0.17 + _GAP)), 20))


def stacked(seed: int = 0) -> World:
    """A small box on top of a larger one is taken down to the floor."""
    rng = world_rng(seed, "stacked")
    large = box_item(rng, "large", (0.23, 0.2, 0.17), 0.1, (-0.25, -0.2, 15))
    small = box_item(rng, "small", (0.13, 0.12, 0.12), 0.6, (-0.27, -0.18, 40))
    on_top = small.turned(0, (0, 0, 2 * 0.17))
    before = lit(rng, (large, on_top), "wood")
    return with_moved("stacked", before, stood(small, 0.35, 0.3, 5))


def swapped(seed: int = 0) -> World:
    """Two boxes of about the same size exchange places and turn a little."""
    rng = world_rng(seed, "swapped")
    here, there = (-0.38, -0.25), (0.36, 0.3)
    one = box_item(rng, "one", (0.19, 0.17, 0.19), 0.58, (*here, 20))
    two = box_item(rng, "two", (0.18, 0.19, 0.17), 0.02, (*there, -10))
    before = lit(rng, (one, two), "tiles")
    return with_moved("swapped", before, stood(one, *there, 32), stood(two, *here, -25))


def _five(rng: np.random.Generator) -> tuple[Item, ...]:
    return (
        box_item(rng, "box", (0.16, 0.15, 0.17), 0.6, (0.55, 0.1, 15)),
        round_item(rng, "drum", Cylinder(0.14, 0.36), 0.03, (0.08, 0.58, 0)),
        round_item(rng, "ball", Sphere(0.16), 0.35, (-0.52, 0.28, 0)),
        round_item(rng, "cone", Cone(0.18, 0.38), 0.8, (-0.42, -0.4, 0)),
        box_item(rng, "parcel", (0.2, 0.13, 0.09), 0.13, (0.2, -0.52, -30)),
    )


def five(seed: int = 0) -> World:
    """Five objects of different shapes, all moved at once."""
    rng = world_rng(seed, "five")
    box, drum, ball, cone, parcel = _five(rng)
    moved = (
        stood(box, 0.0, 0.0, 60),
        stood(drum, 0.48, 0.42, 130),
        stood(ball, -0.25, 0.62, 50),
        stood(cone, -0.58, -0.08, 100),
        stood(parcel, 0.5, -0.28, 40),
    )
    return with_moved("five", lit(rng, (box, drum, ball, cone, parcel), "wood"), *moved)


def mixed(seed: int = 0) -> World:
    """Five changes of all kinds: box and drum moved, ball and crate left, a tin arrived; cone and parcel stay."""
    rng = world_rng(seed, "mixed")
    crate = box_item(rng, "crate", (0.13, 0.12, 0.14), 0.9, (0.63, -0.33, -20))
    tin = round_item(rng, "tin", Cylinder(0.12, 0.22), 0.55, (-0.15, 0.62, 0))
    box, drum, *rest = _five(rng)
    before = lit(rng, (box, drum, *rest, crate), "bricks")
    moved = with_moved("mixed", before, stood(box, 0.03, 0.0, -35), stood(drum, 0.58, 0.48, 80))
    after = moved.after.without("ball", "crate")
    return replace(moved, after=replace(after, items=(*after.items, tin)))
