"""What usually changes in a room: things are moved, taken away, brought, tipped over; or nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from refield.scene.pose import exp, rigid
from refield.synthetic import textures
from refield.synthetic.placing import Paving, box_item, lit, round_item, standing, with_moved, world_rng
from refield.synthetic.shapes import Box, Cylinder, Sphere
from refield.synthetic.state import Item, World


def _pair(rng: np.random.Generator) -> tuple[Item, Item]:
    one = box_item(rng, "cube", (0.19, 0.19, 0.19), 0.6, (-0.45, -0.35, 15))
    return one, round_item(rng, "drum", Cylinder(0.16, 0.4), 0.05, (0.4, 0.35, 0))


def two_moved(seed: int = 0) -> World:
    """A cube and a drum, each moved and turned in its own way."""
    rng = world_rng(seed, "two_moved")
    one, two = _pair(rng)
    before = lit(rng, (one, two), "tiles")
    return with_moved("two_moved", before, one.turned(-30, (0.1, 0.62, 0)), two.turned(60, (0.08, -0.6, 0)))


def removed(seed: int = 0) -> World:
    """Of a cube and a drum, the cube left."""
    rng = world_rng(seed, "removed")
    before = lit(rng, _pair(rng), "wood")
    return World("removed", before, before.without("cube"))


def added(seed: int = 0) -> World:
    """Beside a drum, a cube arrived."""
    rng = world_rng(seed, "added")
    after = lit(rng, _pair(rng), "bricks")
    return World("added", after.without("cube"), after)


def tipped(seed: int = 0) -> World:
    """A tall box tipped over its edge onto another face, and shifted."""
    rng = world_rng(seed, "tipped")
    item = box_item(rng, "box", (0.17, 0.2, 0.26), 0.75, (-0.3, -0.2, 25))
    tip = exp(torch.tensor([0, 0, 0, 0, np.pi / 2, 0], dtype=torch.float64))[:3, :3]
    upright = exp(torch.tensor([0, 0, 0, 0, 0, np.deg2rad(50)], dtype=torch.float64))[:3, :3]
    lying = rigid(upright @ tip, torch.tensor([0.35, 0.25, 0.17], dtype=torch.float64))
    return with_moved("tipped", lit(rng, (item,), "tiles"), replace(item, world_from_item=lying))


def shadow(seed: int = 0) -> World:
    """A cube under a hard sun: its sharp shadow moves along."""
    rng = world_rng(seed, "shadow")
    item = box_item(rng, "cube", (0.2, 0.2, 0.2), 0.13, (-0.25, -0.25, 10))
    before = lit(rng, (item,), "bricks", sun=(2.8, 2.6, 2.3))
    return with_moved("shadow", before, item.turned(35, (0.5, 0.4, 0)))


def plain(seed: int = 0) -> World:
    """A box of one colour: nothing to match, only shape and shade."""
    rng = world_rng(seed, "plain")
    solid = Box((0.24, 0.16, 0.2))
    paint = np.broadcast_to(textures.colour(0.02, 0.7, 0.7), (64, 96, 3)).copy()
    item = Item("box", solid, paint, standing(solid, -0.25, -0.25, 15), glossy=True)
    return with_moved("plain", lit(rng, (item,), "tiles"), item.turned(40, (0.5, 0.4, 0)))


def _table(rng: np.random.Generator) -> tuple[Item, ...]:
    """A box to move, among a drum, a ball and a low box that stay."""
    return (
        box_item(rng, "box", (0.2, 0.18, 0.19), 0.6, (-0.3, -0.3, 20)),
        round_item(rng, "drum", Cylinder(0.15, 0.36), 0.03, (0.5, -0.3, 0)),
        round_item(rng, "ball", Sphere(0.17), 0.35, (-0.35, 0.48, 0)),
        box_item(rng, "parcel", (0.24, 0.14, 0.1), 0.1, (0.5, 0.55, -25)),
    )


def cluttered(seed: int = 0, name: str = "cluttered", paving: Paving = "wood") -> World:
    """A box moved between things that stay."""
    rng = world_rng(seed, name)
    items = _table(rng)
    return with_moved(name, lit(rng, items, paving), items[0].turned(40, (0.38, 0.36, 0)))


def table(seed: int = 0) -> World:
    """The packaged sample: the same things on tiles."""
    return cluttered(seed, "table", "tiles")


def nothing(seed: int = 0) -> World:
    """The same scene twice."""
    rng = world_rng(seed, "nothing")
    state = lit(rng, _table(rng)[:3], "tiles")
    return World("nothing", state, state)
