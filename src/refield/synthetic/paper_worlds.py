"""The paper's scenes (§11.1): one object on a floor, moved and turned."""

from __future__ import annotations

from refield.synthetic.placing import box_item, lit, round_item, with_moved, world_rng
from refield.synthetic.shapes import Cone, Cylinder, Sphere
from refield.synthetic.state import Triple, World

PAPER_MOVE = (0.227, 0.227, 0.0)
"""§11.1, metres"""
_CUBE: Triple = (0.2, 0.2, 0.2)
_PLACE = (-0.1, -0.1, 20.0)  # so that old and new place lie evenly about the middle


def cube(seed: int = 0, name: str = "cube") -> World:
    """§11.1: a painted cube of 40 cm, moved by (0.227, 0.227, 0) and turned by 35 degrees."""
    rng = world_rng(seed, name)
    item = box_item(rng, "cube", _CUBE, 0.58, _PLACE)
    return with_moved(name, lit(rng, (item,)), item.turned(35, PAPER_MOVE))


def cylinder(seed: int = 0) -> World:
    """§11.1, turned by 50 degrees."""
    rng = world_rng(seed, "cylinder")
    item = round_item(rng, "cylinder", Cylinder(0.19, 0.42), 0.02, _PLACE)
    return with_moved("cylinder", lit(rng, (item,), "tiles"), item.turned(50, PAPER_MOVE))


def sphere(seed: int = 0) -> World:
    """§11.1, turned by 30 degrees."""
    rng = world_rng(seed, "sphere")
    item = round_item(rng, "sphere", Sphere(0.22), 0.5, _PLACE)
    return with_moved("sphere", lit(rng, (item,), "wood"), item.turned(30, PAPER_MOVE))


def cone(seed: int = 0) -> World:
    """§11.1, turned by 40 degrees."""
    rng = world_rng(seed, "cone")
    item = round_item(rng, "cone", Cone(0.24, 0.46), 0.3, _PLACE)
    return with_moved("cone", lit(rng, (item,), "bricks"), item.turned(40, PAPER_MOVE))
