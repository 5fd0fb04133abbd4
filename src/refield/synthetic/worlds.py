"""Worlds we know exactly: the paper's scenes (§11.1) and harder ones, before and after.

World axes: z up, the floor at z = 0, metres. A world is two `State`s; what differs between them is the
change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.scene.change import Kind, OccupancyGrid
from refield.scene.pose import exp, invert, rigid, transform
from refield.synthetic import textures
from refield.synthetic.shapes import Box, Cone, Cylinder, Solid, Sphere

Triple = tuple[float, float, float]

PAPER_MOVE = (0.227, 0.227, 0.0)
"""§11.1, metres"""
FLOOR_HALF = 1.2
_GRID = 64  # nodes a side of a true occupancy grid
_GRID_FACTOR = 1.5  # its box, against the object's


@dataclass(frozen=True)
class Item:
    """A textured solid in the world."""

    name: str
    solid: Solid
    texture: NDArray[np.float32]
    """(H, W, 3) sRGB, the solid's atlas"""
    world_from_item: Tensor
    """(4, 4) float64"""
    glossy: bool = False

    def turned(self, degrees: float, shift: Triple) -> Item:
        """Turned about the upright through its own middle, then shifted."""
        turn = exp(torch.tensor([0, 0, 0, 0, 0, np.deg2rad(degrees)], dtype=torch.float64))[:3, :3]
        here = self.world_from_item
        pose = rigid(turn @ here[:3, :3], here[:3, 3] + torch.tensor(shift, dtype=torch.float64))
        return replace(self, world_from_item=pose)

    def box(self) -> Tensor:
        """(2, 3) float64 world box around the solid's own box."""
        half = torch.tensor(self.solid.half, dtype=torch.float64)
        corners = torch.cartesian_prod(*torch.stack([-half, half]).T)
        corners = transform(self.world_from_item, corners)
        return torch.stack([corners.amin(0), corners.amax(0)])

    def distance(self, x: Tensor) -> Tensor:
        """Signed distance from world points (..., 3) -> (...,)."""
        return self.solid.distance(transform(invert(self.world_from_item), x))

    def grid(self) -> OccupancyGrid:
        """The true occupancy: 0.5 on the surface, a ramp two cells wide."""
        box = self.box().float()
        middle, half = box.mean(0), (box[1] - box[0]) / 2 * _GRID_FACTOR
        aabb = torch.stack([middle - half, middle + half])
        empty = OccupancyGrid(aabb, torch.zeros(_GRID, _GRID, _GRID))
        cell = float((2 * half / (_GRID - 1)).max())
        values = (0.5 - self.distance(empty.nodes()) / (2 * cell)).clamp(0, 1)
        return replace(empty, values=values)


@dataclass(frozen=True)
class State:
    """Everything in the scene at one time; the first item is the floor."""

    items: tuple[Item, ...]
    surroundings: NDArray[np.float32]
    """(H, 2H, 3) linear radiance, latitude-longitude, z up"""
    sun: Triple | None = None
    """Irradiance of a hard light, linear RGB; None = the surroundings alone"""
    sun_direction: Triple = (-0.55, 0.45, -0.7)
    """The way the hard light travels"""

    def named(self, name: str) -> Item | None:
        return next((item for item in self.items if item.name == name), None)


@dataclass(frozen=True)
class TrueChange:
    """One object that differs between the two states."""

    kind: Kind
    old: Item | None
    new: Item | None

    @property
    def new_from_old(self) -> Tensor | None:
        if self.old is None or self.new is None:
            return None
        return self.new.world_from_item @ invert(self.old.world_from_item)


@dataclass(frozen=True)
class World:
    """A scene before and after."""

    name: str
    before: State
    after: State
    target: Triple = (0.0, 0.0, 0.15)
    """What the cameras look at"""

    @property
    def changes(self) -> tuple[TrueChange, ...]:
        """Moved and removed objects in the order of the old state, then the added ones."""
        out = []
        for old in self.before.items:
            new = self.after.named(old.name)
            if new is None:
                out.append(TrueChange("removed", old, None))
            elif not torch.equal(old.world_from_item, new.world_from_item):
                out.append(TrueChange("moved", old, new))
        added = [item for item in self.after.items if self.before.named(item.name) is None]
        return (*out, *(TrueChange("added", None, item) for item in added))


def standing(solid: Solid, x: float, y: float, degrees: float = 0.0) -> Tensor:
    """Pose (4, 4) float64 of a solid that stands on the floor at (x, y), turned about the upright."""
    twist = torch.tensor([0, 0, 0, 0, 0, np.deg2rad(degrees)], dtype=torch.float64)
    return rigid(exp(twist)[:3, :3], torch.tensor([x, y, solid.half[2]], dtype=torch.float64))


Paving = Literal["bricks", "tiles", "wood"]


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


def _rng(seed: int, world: str) -> np.random.Generator:
    return np.random.default_rng([seed, *world.encode()])


def _state(
    rng: np.random.Generator,
    items: tuple[Item, ...],
    paving: Paving = "bricks",
    sun: Triple | None = None,
) -> State:
    """A state on a floor; with a hard sun the surroundings are dimmer and have no soft one."""
    ground = floor(rng, paving)
    light = textures.surroundings(rng, sun=9.0) if sun is None else 0.5 * textures.surroundings(rng, sun=0.0)
    return State((ground, *items), light, sun)


def _moved(name: str, before: State, item: str, after: Item) -> World:
    items = tuple(after if i.name == item else i for i in before.items)
    return World(name, before, replace(before, items=items))


_CUBE: Triple = (0.2, 0.2, 0.2)
_PLACE = (-0.1, -0.1, 20.0)  # so that old and new place lie evenly about the middle


def cube(seed: int = 0, name: str = "cube") -> World:
    """§11.1: a painted cube of 40 cm, moved by (0.227, 0.227, 0) and turned by 35 degrees."""
    rng = _rng(seed, name)
    item = box_item(rng, "cube", _CUBE, 0.58, _PLACE)
    return _moved(name, _state(rng, (item,)), "cube", item.turned(35, PAPER_MOVE))


def cylinder(seed: int = 0) -> World:
    """§11.1, turned by 50 degrees."""
    rng = _rng(seed, "cylinder")
    item = round_item(rng, "cylinder", Cylinder(0.19, 0.42), 0.02, _PLACE)
    return _moved("cylinder", _state(rng, (item,), "tiles"), "cylinder", item.turned(50, PAPER_MOVE))


def sphere(seed: int = 0) -> World:
    """§11.1, turned by 30 degrees."""
    rng = _rng(seed, "sphere")
    item = round_item(rng, "sphere", Sphere(0.22), 0.5, _PLACE)
    return _moved("sphere", _state(rng, (item,), "wood"), "sphere", item.turned(30, PAPER_MOVE))


def cone(seed: int = 0) -> World:
    """§11.1, turned by 40 degrees."""
    rng = _rng(seed, "cone")
    item = round_item(rng, "cone", Cone(0.24, 0.46), 0.3, _PLACE)
    return _moved("cone", _state(rng, (item,), "bricks"), "cone", item.turned(40, PAPER_MOVE))


def _pair(rng: np.random.Generator) -> tuple[Item, Item]:
    one = box_item(rng, "cube", (0.19, 0.19, 0.19), 0.6, (-0.45, -0.35, 15))
    return one, round_item(rng, "drum", Cylinder(0.16, 0.4), 0.05, (0.4, 0.35, 0))


def two_moved(seed: int = 0) -> World:
    """A cube and a drum, each moved and turned in its own way."""
    rng = _rng(seed, "two_moved")
    one, two = _pair(rng)
    before = _state(rng, (one, two), "tiles")
    after = (before.items[0], one.turned(-30, (0.1, 0.62, 0)), two.turned(60, (0.08, -0.6, 0)))
    return World("two_moved", before, replace(before, items=after))


def removed(seed: int = 0) -> World:
    """Of a cube and a drum, the cube left."""
    rng = _rng(seed, "removed")
    before = _state(rng, _pair(rng), "wood")
    return World("removed", before, replace(before, items=tuple(i for i in before.items if i.name != "cube")))


def added(seed: int = 0) -> World:
    """Beside a drum, a cube arrived."""
    rng = _rng(seed, "added")
    after = _state(rng, _pair(rng), "bricks")
    return World("added", replace(after, items=tuple(i for i in after.items if i.name != "cube")), after)


def tipped(seed: int = 0) -> World:
    """A tall box tipped over its edge onto another face, and shifted."""
    rng = _rng(seed, "tipped")
    item = box_item(rng, "box", (0.17, 0.2, 0.26), 0.75, (-0.3, -0.2, 25))
    tip = exp(torch.tensor([0, 0, 0, 0, np.pi / 2, 0], dtype=torch.float64))[:3, :3]
    upright = exp(torch.tensor([0, 0, 0, 0, 0, np.deg2rad(50)], dtype=torch.float64))[:3, :3]
    lying = rigid(upright @ tip, torch.tensor([0.35, 0.25, 0.17], dtype=torch.float64))
    return _moved("tipped", _state(rng, (item,), "tiles"), "box", replace(item, world_from_item=lying))


def shadow(seed: int = 0) -> World:
    """A cube under a hard sun: its sharp shadow moves along."""
    rng = _rng(seed, "shadow")
    item = box_item(rng, "cube", _CUBE, 0.13, (-0.25, -0.25, 10))
    before = _state(rng, (item,), "bricks", sun=(2.8, 2.6, 2.3))
    return _moved("shadow", before, "cube", item.turned(35, (0.5, 0.4, 0)))


def plain(seed: int = 0) -> World:
    """A box of one colour: nothing to match, only shape and shade."""
    rng = _rng(seed, "plain")
    solid = Box((0.24, 0.16, 0.2))
    paint = np.broadcast_to(textures.colour(0.02, 0.7, 0.7), (64, 96, 3)).copy()
    item = Item("box", solid, paint, standing(solid, -0.25, -0.25, 15), glossy=True)
    return _moved("plain", _state(rng, (item,), "tiles"), "box", item.turned(40, (0.5, 0.4, 0)))


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
    rng = _rng(seed, name)
    items = _table(rng)
    return _moved(name, _state(rng, items, paving), "box", items[0].turned(40, (0.38, 0.36, 0)))


def table(seed: int = 0) -> World:
    """The packaged sample: the same things on tiles."""
    return cluttered(seed, "table", "tiles")


def nothing(seed: int = 0) -> World:
    """The same scene twice."""
    rng = _rng(seed, "nothing")
    state = _state(rng, _table(rng)[:3], "tiles")
    return World("nothing", state, state)


WORLDS: dict[str, Callable[[int], World]] = {
    f.__name__: f
    for f in (
        cube, cylinder, sphere, cone, two_moved, removed, added, tipped, shadow, plain, cluttered, table,
        nothing,
    )
}  # fmt: skip
"""Name → builder of a world from a seed."""
