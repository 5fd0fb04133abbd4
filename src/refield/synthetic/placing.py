"""What worlds are put together from: a floor, painted boxes, patchwork solids, and a light over them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.scene.pose import exp, rigid
from refield.synthetic import textures
from refield.synthetic.shapes import Box, Cone, Cylinder, Solid, Sphere
from refield.synthetic.state import Item, State, Triple, World

FLOOR_HALF = 1.2
Paving = Literal["bricks", "tiles", "wood"]


def world_rng(seed: int, world: str) -> np.random.Generator:
    """A stream of its own for each world and seed."""
    return np.random.default_rng([seed, *world.encode()])


def standing(solid: Solid, x: float, y: float, degrees: float = 0.0) -> Tensor:
    """Pose (4, 4) float64 of a solid that stands on the floor at (x, y), turned about the upright."""
    twist = torch.tensor([0, 0, 0, 0, 0, np.deg2rad(degrees)], dtype=torch.float64)
    return rigid(exp(twist)[:3, :3], torch.tensor([x, y, solid.half[2]], dtype=torch.float64))


def stood(item: Item, x: float, y: float, degrees: float = 0.0) -> Item:
    """The item, standing on the floor at (x, y), turned about the upright."""
    return replace(item, world_from_item=standing(item.solid, x, y, degrees))


def floor(rng: np.random.Generator, paving: Paving = "bricks") -> Item:
    """A textured slab 2.4 m wide whose top is z = 0."""
    make = {
        "bricks": partial(textures.bricks, rows=16, hue=0.05),
        "tiles": partial(textures.tiles, rows=8, hue=0.1),
        "wood": partial(textures.wood, planks=10),
    }[paving]
    solid = Box((FLOOR_HALF, FLOOR_HALF, 0.04))
    pose = rigid(torch.eye(3, dtype=torch.float64), torch.tensor([0, 0, -0.04], dtype=torch.float64))
    return Item("floor", solid, textures.slab(make(rng, 768)), pose)


def box_item(
    rng: np.random.Generator,
    name: str,
    half: Triple,
    hue: float,
    at: Triple,
) -> Item:
    """A painted box standing at (x, y), turned by the third number in degrees."""
    solid = Box(half)
    return Item(name, solid, textures.painted_box(rng, 160, hue), standing(solid, *at), glossy=True)


def round_item(
    rng: np.random.Generator,
    name: str,
    solid: Sphere | Cylinder | Cone,
    hue: float,
    at: Triple,
) -> Item:
    """A patchwork solid standing at (x, y), turned by the third number in degrees."""
    return Item(name, solid, wrapped(rng, solid, hue), standing(solid, *at), glossy=True)


def wrapped(
    rng: np.random.Generator, solid: Sphere | Cylinder | Cone, hue: float, cells: int = 70, size: int = 192
) -> NDArray[np.float32]:
    """A patchwork atlas (size, size, 3) for a round solid."""
    texel = (torch.arange(size) + 0.5) / size
    v, u = torch.meshgrid(texel, texel, indexing="ij")
    points = solid.at(torch.stack([u, v], -1)).float().numpy()
    return textures.patchwork(points, rng, cells, hue)


def lit(
    rng: np.random.Generator,
    items: tuple[Item, ...],
    paving: Paving = "bricks",
    sun: Triple | None = None,
) -> State:
    """A state on a floor; with a hard sun the surroundings are dimmer and have no soft one."""
    ground = floor(rng, paving)
    light = textures.surroundings(rng, sun=9.0) if sun is None else 0.5 * textures.surroundings(rng, sun=0.0)
    return State((ground, *items), light, sun)


def with_moved(name: str, before: State, *moved: Item) -> World:
    """A world in which the items given stand elsewhere, and all others stay."""
    now = {item.name: item for item in moved}
    items = tuple(now.get(item.name, item) for item in before.items)
    return World(name, before, replace(before, items=items))
