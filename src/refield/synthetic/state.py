"""The types of a world we know exactly: what stands where, before and after.

World axes: z up, the floor at z = 0, metres. A world is two `State`s; what differs between them is the
change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.scene.change import Kind, OccupancyGrid
from refield.scene.pose import exp, invert, rigid, transform
from refield.synthetic.shapes import Solid

Triple = tuple[float, float, float]

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
    """Varnished: highlights over the paint"""
    metal: bool = False
    """Reflects its surroundings, tinted by the texture, and has no paint of its own"""
    roughness: float = 0.35
    """Of the varnish or the metal: the microfacets' alpha; 0.05 is a mirror, 0.35 satin"""

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
class Lamp:
    """A light in a room: a panel that shines downwards, or a bulb that throws sharp shadows."""

    at: Triple
    light: Triple
    """Linear RGB: a panel's radiance, a bulb's intensity"""
    half: tuple[float, float] | None = None
    """Half the panel's sides, metres; None = a bulb, itself not seen"""


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
    lamps: tuple[Lamp, ...] = ()

    def brightened(self, factor: float) -> State:
        """The same state under so many times as much light."""

        def more(light: Triple) -> Triple:
            return (factor * light[0], factor * light[1], factor * light[2])

        return replace(
            self,
            surroundings=(factor * self.surroundings).astype(np.float32),
            sun=None if self.sun is None else more(self.sun),
            lamps=tuple(replace(lamp, light=more(lamp.light)) for lamp in self.lamps),
        )

    def named(self, name: str) -> Item | None:
        return next((item for item in self.items if item.name == name), None)

    def without(self, *names: str) -> State:
        """The same state, less the items of these names."""
        return replace(self, items=tuple(item for item in self.items if item.name not in names))


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
        """Moved and removed objects in the order of the old state, then the added ones.

        An object of the same name whose shape is another has no ``new_from_old``: it is told as the old shape
        removed and the new one added (`rigid` is then False).
        """
        out = []
        for old in self.before.items:
            new = self.after.named(old.name)
            if new is None or new.solid != old.solid:
                out.append(TrueChange("removed", old, None))
            elif not torch.equal(old.world_from_item, new.world_from_item):
                out.append(TrueChange("moved", old, new))
        here = {item.name: item.solid for item in self.before.items}
        added = [item for item in self.after.items if here.get(item.name) != item.solid]
        return (*out, *(TrueChange("added", None, item) for item in added))

    @property
    def rigid(self) -> bool:
        """Whether every object that is there both times kept its shape."""
        pairs = ((item, self.after.named(item.name)) for item in self.before.items)
        return all(new is None or new.solid == old.solid for old, new in pairs)
