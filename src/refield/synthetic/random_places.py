"""Places drawn at random: floors, corners, desks, shelves, steps, slopes, bowls; in rooms and outdoors.

A place is what stays: the ground, walls and furniture, where objects may stand, and how large it all is. Its front is
towards -y. Lengths are metres, and most of them parts of ``reach``, the radius of the region that the photos show.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from refield.scene.pose import rigid
from refield.synthetic import random_textures, textures
from refield.synthetic.compound import Compound
from refield.synthetic.random_changes import apart, rested
from refield.synthetic.random_objects import drawn_item, table_parts
from refield.synthetic.shapes import Box, Solid
from refield.synthetic.state import Item, Triple
from refield.synthetic.terrain import Terrain

_THICK = 0.04
GROUND = 5.0
"""of its reach: half the side of ground under the sky"""


@dataclass(frozen=True)
class Patch:
    """Where objects may stand: a rectangle in (x, y), level or on terrain."""

    low: tuple[float, float]
    high: tuple[float, float]
    z: float = 0.0
    terrain: Terrain | None = None

    def heights(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.terrain is None:
            return np.full(np.shape(x), self.z)
        return self.terrain.height(torch.from_numpy(x), torch.from_numpy(y)).numpy()

    def normal(self, x: float, y: float) -> NDArray[np.float64]:
        return np.array([0.0, 0.0, 1.0]) if self.terrain is None else self.terrain.normal(x, y)


@dataclass(frozen=True)
class Place:
    """Where a world is."""

    family: str
    items: tuple[Item, ...]
    """the first is the ground"""
    patches: tuple[Patch, ...]
    reach: float
    target: Triple
    """what cameras look at"""
    largest: float
    """metres, of an object"""
    views: tuple[str, ...]
    """families of camera paths that suit it"""
    faces_front: bool
    """whether something stands behind it, so that it is seen from the front only"""
    ground: str
    front: float = -np.pi / 2
    """radians: the azimuth from which it is seen"""


_Furnish = Callable[[np.random.Generator, float], Place]
_AROUND = ("orbit", "half orbit", "hand-held", "dome", "forward")
_FRONT = ("forward", "half orbit", "hand-held")


def draw_place(rng: np.random.Generator, *, outdoors: bool) -> Place:
    """A place, without the room around it."""
    kinds = {"floor": 2.0, "corner": 1.0, "desk": 1.5, "cluttered desk": 1.5, "shelf": 1.0, "steps": 1.0}
    if outdoors:
        kinds |= {"slope": 1.2, "bowl": 1.2, "hills": 1.2, "shelf": 0.3, "corner": 0.7}
    weights = np.array(list(kinds.values()))
    family = str(rng.choice(list(kinds), p=weights / weights.sum()))
    reach = float(rng.uniform(0.5, 1.2))
    kind, paint = random_textures.ground(rng, 1024 if outdoors else 768, outdoors=outdoors)
    on_level: dict[str, _Furnish] = {
        "floor": _floor, "corner": _corner, "desk": _desk, "cluttered desk": _cluttered, "shelf": _shelf,
        "steps": _steps,
    }  # fmt: skip
    if family in on_level:
        place = on_level[family](rng, reach)
        place = replace(place, items=(level_ground(paint, GROUND * reach, outdoors), *place.items))
    else:
        place = _rolling(rng, reach, family, paint)
    return replace(place, family=family, ground=kind)


def level_ground(paint: textures.Image, side: float, outdoors: bool) -> Item:
    """Its top is z = 0."""
    if outdoors:  # one cell for the whole atlas: a large ground needs its texels
        solid: Solid = Terrain(side)
        return Item("ground", solid, paint, posed((0.0, 0.0, 0.0)))
    return Item("ground", Box((side, side, _THICK)), textures.slab(paint), posed((0.0, 0.0, -_THICK)))


def posed(at: Triple) -> torch.Tensor:
    return rigid(torch.eye(3, dtype=torch.float64), torch.tensor(at, dtype=torch.float64))


def slab_item(name: str, low: Triple, high: Triple, texture: textures.Image) -> Item:
    """A box between two corners, its atlas made from one face."""
    a, b = np.array(low), np.array(high)
    half = tuple(((b - a) / 2).tolist())
    row = np.concatenate([texture] * 3, 1)
    middle = tuple(((a + b) / 2).tolist())
    return Item(name, Box(half), np.concatenate([row, row], 0), posed(middle))


def _square(reach: float, part: float) -> Patch:
    return Patch((-part * reach, -part * reach), (part * reach, part * reach))


def _floor(rng: np.random.Generator, reach: float) -> Place:
    target = (0.0, 0.0, 0.15 * reach)
    return Place("", (), (_square(reach, 0.8),), reach, target, 0.85 * reach, _AROUND, False, "")


def _corner(rng: np.random.Generator, reach: float) -> Place:
    """Two walls at right angles behind the objects."""
    high, far = float(rng.uniform(1.2, 2.0)) * reach, float(rng.uniform(0.9, 1.1)) * reach
    paint = random_textures.wall(rng, 384)[1]
    long = 3 * reach
    walls = (
        slab_item("back wall", (-long, far, 0), (long, far + _THICK, high), paint),
        slab_item("side wall", (-far - _THICK, -long, 0), (-far, far, high), random_textures.wall(rng, 384)[1]),
    )
    target = (0.0, 0.0, 0.2 * reach)
    return Place("", walls, (_square(reach, 0.75),), reach, target, 0.8 * reach, _FRONT, True, "", -np.pi / 4)


def _desk(rng: np.random.Generator, reach: float) -> Place:
    reach = 0.6 * reach
    high = float(rng.uniform(0.5, 0.8))
    x, y = 1.15 * reach, float(rng.uniform(0.75, 1.1)) * reach
    solid = Compound.of(table_parts(np.array([2 * x, 2 * y, high]), 0.06, 0.08))
    style = random_textures.draw_style(rng, ("wood", "plain", "mottled", "marble"))
    texture = random_textures.atlas(rng, solid, style, 256)
    desk = Item("desk", solid, texture, posed((0.0, 0.0, high / 2)))
    top = Patch((-0.95 * x, -0.95 * y), (0.95 * x, 0.95 * y), high)
    return Place("", (desk,), (top,), reach, (0.0, 0.0, high + 0.15 * reach), 0.8 * reach, _AROUND, False, "")


def _cluttered(rng: np.random.Generator, reach: float) -> Place:
    """A desk with things on it that stay."""
    place = _desk(rng, reach)
    items: list[Item] = list(place.items)
    wanted = int(rng.integers(4, 9))
    for k in range(wanted):
        item = drawn_item(rng, f"clutter {k}", float(rng.uniform(0.12, 0.3)) * place.reach)[0]
        for _ in range(20):
            spot = rested(rng, item, place.patches[0])
            if spot is not None and apart(spot, items):
                items.append(spot)
                break
    return replace(place, items=tuple(items))


def _shelf(rng: np.random.Generator, reach: float) -> Place:
    """Boards between two sides before a wall."""
    boards = int(rng.integers(2, 4))
    step, deep, wide = float(rng.uniform(0.75, 0.95)) * reach, 0.55 * reach, 0.95 * reach
    thick, base = 0.05 * reach, float(rng.uniform(0.05, 0.4)) * reach
    style = random_textures.draw_style(rng, ("wood", "plain", "mottled"))
    paints = [random_textures.face(rng, style, 192) for _ in range(boards + 2)]
    top = base + (boards - 1) * step + 0.9 * step
    levels = [base + k * step for k in range(boards)]
    items = [
        slab_item(f"board {k}", (-wide, -deep / 2, z - thick), (wide, deep / 2, z), paints[k])
        for k, z in enumerate(levels)
    ]
    items += [
        slab_item(f"shelf side {k}", (x - thick / 2, -deep / 2, 0), (x + thick / 2, deep / 2, top), paints[boards + k])
        for k, x in enumerate((-wide - thick, wide + thick))
    ]
    back = deep / 2 + 0.02
    paint = random_textures.wall(rng, 512)[1]
    items.append(slab_item("back wall", (-3.5 * reach, back, 0), (3.5 * reach, back + _THICK, top + reach), paint))
    patches = tuple(Patch((-0.93 * wide, -deep / 2), (0.93 * wide, deep / 2), z) for z in levels)
    target = (0.0, 0.0, (levels[0] + levels[-1]) / 2 + 0.35 * step)
    return Place(
        "", tuple(items), patches, reach * (1.0 if boards == 2 else 1.25), target, 0.5 * reach, _FRONT, True, ""
    )


def _steps(rng: np.random.Generator, reach: float) -> Place:
    """Stairs that rise away from the front."""
    count, tread, rise = int(rng.integers(3, 5)), 0.6 * reach, float(rng.uniform(0.15, 0.3)) * reach
    style = random_textures.draw_style(rng, ("wood", "mottled", "marble", "plain", "checked"))
    items, patches = [], []
    first = -count * tread / 2
    for k in range(count):
        low, high = first + k * tread, first + count * tread
        corner = (1.5 * reach, high, (k + 1) * rise)
        paint = random_textures.face(rng, style, 256)
        items.append(slab_item(f"step {k}", (-1.5 * reach, low, k * rise), corner, paint))
        patches.append(Patch((-0.8 * reach, low), (0.8 * reach, low + tread), (k + 1) * rise))
    target = (0.0, 0.0, (count + 1) / 2 * rise + 0.15 * reach)
    return Place("", tuple(items), tuple(patches), reach, target, 0.6 * reach, _FRONT, True, "")


def _rolling(rng: np.random.Generator, reach: float, family: str, paint: textures.Image) -> Place:
    """Ground under the sky that leans, sinks or rolls."""
    lean, way = np.tan(np.deg2rad(float(rng.uniform(6, 16)))), float(rng.uniform(0, 2 * np.pi))
    slope = (float(lean * np.cos(way)), float(lean * np.sin(way))) if family == "slope" else (0.0, 0.0)
    wide = float(rng.uniform(0.6, 1.0)) * reach
    bowl = (float(rng.uniform(0.25, 0.5)) * wide, wide) if family == "bowl" else (0.0, 1.0)
    count, high = (4, 0.07) if family == "hills" else (2, 0.015)
    waves = []
    for _ in range(count):
        k, turn = 2 * np.pi / (reach * float(rng.uniform(1.2, 3.0))), float(rng.uniform(0, 2 * np.pi))
        phase, up = float(rng.uniform(0, 2 * np.pi)), high * reach * float(rng.uniform(0.4, 1.0))
        waves.append((float(k * np.cos(turn)), float(k * np.sin(turn)), phase, up))
    terrain = Terrain(GROUND * reach, slope, bowl, tuple(waves))
    low = float(terrain.height(torch.zeros(()), torch.zeros(())))
    ground = Item("ground", terrain, paint, posed((0.0, 0.0, 0.0)))
    patch = replace(_square(reach, 0.75), terrain=terrain)
    around = ("orbit", "half orbit", "hand-held", "dome")
    return Place("", (ground,), (patch,), reach, (0.0, 0.0, low + 0.2 * reach), 0.8 * reach, around, False, "")


def in_room(rng: np.random.Generator, place: Place, wide: float, high: float) -> Place:
    """The place within four walls and under a ceiling, ``wide`` metres from the middle to each wall."""
    t = _THICK
    names = [random_textures.wall(rng, 384)[1] for _ in range(int(rng.integers(1, 5)))]
    paints = [names[k % len(names)] for k in range(4)]
    white = np.full((8, 8, 3), 0.85, np.float32)
    floor = replace(place.items[0], solid=Box((wide, wide, t)))
    walls = [
        slab_item("room north", (-wide, wide, 0), (wide, wide + t, high), paints[0]),
        slab_item("room south", (-wide, -wide - t, 0), (wide, -wide, high), paints[1]),
        slab_item("room east", (wide, -wide, 0), (wide + t, wide, high), paints[2]),
        slab_item("room west", (-wide - t, -wide, 0), (-wide, wide, high), paints[3]),
        slab_item("ceiling", (-wide, -wide, high), (wide, wide, high + t), white),
    ]
    return replace(place, items=(floor, *place.items[1:], *walls))
