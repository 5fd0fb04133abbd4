"""Other ground for a world than its flat floor: wavy, or strewn with things; whatever stood, stands on it."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from refield.scene.errors import InputError
from refield.scene.pose import exp, invert, rigid, rotate, transform
from refield.synthetic import textures
from refield.synthetic.placing import FLOOR_HALF, box_item, floor, standing, world_rng, wrapped
from refield.synthetic.shapes import Cone, Cylinder, Solid, Sphere
from refield.synthetic.state import Item, World
from refield.synthetic.terrain import Terrain, Wave

Ground = Literal["flat", "wavy", "cluttered"]

_WAVES = ((0.85, 0.03), (0.55, 0.018), (0.4, 0.008))
"""metres from crest to crest, and height: slopes of up to some 20 degrees"""
_SLABS, _THINGS = 14, 26
"""of the cluttered ground: flat ones, which may lie under anything, and others, which lie beside"""
_APART = 0.03  # metres between what stands and the things beside it
_NODES = 48  # a side of the lattice on which things are let down
_SUNK = 0.002  # metres, so that no light comes in beneath
_FAR = 5.0  # metres above and beneath everything


def on_ground(world: World, ground: Ground, seed: int) -> World:
    """The same objects over the same ground plan, on other ground; what it looks like follows from the seed.

    Each is let down until it touches. On wavy ground it first leans as the ground beneath it does, so that the change
    is no turn about the upright any more.

    Raises:
        InputError: something in the world does not stand on its floor.
    """
    if ground == "flat":
        return world
    standing_on_it = [item for state in (world.before, world.after) for item in state.items[1:]]
    for item in standing_on_it:
        if abs(_lowest(item)) > 1e-3:
            raise InputError(f"the world {world.name}", f"its {item.name} does not stand on the floor", "leave it flat")
    rng = world_rng(seed, f"{world.name} {ground}")
    new = (_wavy(rng),) if ground == "wavy" else _cluttered(rng, [item.box()[:, :2] for item in standing_on_it])
    leaning = ground == "wavy"
    before, after = (
        replace(s, items=(*new, *(_let_down(i, new, leaning=leaning) for i in s.items[1:])))
        for s in (world.before, world.after)
    )
    return World(f"{world.name}-{ground}", before, after, world.target)


def _wavy(rng: np.random.Generator) -> Item:
    """Ground that rolls, three waves of it in any directions."""
    waves: list[Wave] = []
    for apart, high in _WAVES:
        way, phase = rng.uniform(0, 2 * np.pi, 2)
        k = 2 * np.pi / apart
        waves.append((float(k * np.cos(way)), float(k * np.sin(way)), float(phase), high))
    paint = textures.tiles(rng, 768, rows=12, hue=0.3)
    return Item("floor", Terrain(FLOOR_HALF, waves=tuple(waves)), paint, torch.eye(4, dtype=torch.float64))


def _cluttered(rng: np.random.Generator, taken: list[Tensor]) -> tuple[Item, ...]:
    """A floor with flat slabs anywhere on it, and with small things wherever nothing of ``taken`` stands."""
    items = [floor(rng, "tiles")]
    for k in range(_SLABS):
        half = (*rng.uniform(0.05, 0.14, 2).tolist(), float(rng.uniform(0.004, 0.012)))
        at = (*rng.uniform(-0.75, 0.75, 2).tolist(), float(rng.uniform(0, 90)))
        items.append(box_item(rng, f"slab {k}", half, float(rng.uniform()), at))
    while len(items) < 1 + _SLABS + _THINGS:
        thing = _thing(rng, f"thing {len(items)}")
        if not any(_near(thing.box()[:, :2], place) for place in taken):
            items.append(thing)
    return tuple(items)


def _thing(rng: np.random.Generator, name: str) -> Item:
    """A box, ball, drum or cone of some centimetres, anywhere."""
    size, hue = float(rng.uniform(0.025, 0.06)), float(rng.uniform())
    at = (*rng.uniform(-1.0, 1.0, 2).tolist(), float(rng.uniform(0, 90)))
    if rng.uniform() < 0.25:
        return box_item(rng, name, (size, 0.7 * size, size), hue, at)
    solid = (Sphere(size), Cylinder(0.7 * size, 2 * size), Cone(size, 2 * size))[int(rng.integers(3))]
    return Item(name, solid, wrapped(rng, solid, hue, cells=20, size=48), standing(solid, *at), glossy=True)


def _near(a: Tensor, b: Tensor) -> bool:
    """Whether two boxes (2, 2) of the plan come close to each other."""
    return bool(((a[0] < b[1] + _APART) & (b[0] < a[1] + _APART)).all())


def _lowest(item: Item) -> float:
    """Height of its lowest point."""
    vertices = torch.from_numpy(item.solid.mesh()[0]).double()
    return float(transform(item.world_from_item, vertices)[:, 2].min())


def _let_down(item: Item, ground: tuple[Item, ...], *, leaning: bool) -> Item:
    """The item over the same place of the plan, on the ground."""
    low, high = item.box()[:, :2]
    axes = [torch.linspace(float(a), float(b), _NODES, dtype=torch.float64) for a, b in zip(low, high)]
    plan = torch.cartesian_prod(*axes)
    top = torch.stack([_met(g.solid, g.world_from_item, plan, down=True) for g in ground]).amax(0)
    pose = item.world_from_item
    if leaning:
        under = _met(item.solid, pose, plan, down=False).isfinite()
        lean = _lean(plan[under], top[under])
        pose = rigid(lean @ pose[:3, :3], pose[:3, 3])
    gap = float((_met(item.solid, pose, plan, down=False) - top).min())
    return replace(item, world_from_item=rigid(pose[:3, :3], pose[:3, 3] - pose.new_tensor([0, 0, gap + _SUNK])))


def _met(solid: Solid, world_from_item: Tensor, plan: Tensor, *, down: bool) -> Tensor:
    """Height (N,) at which something is first met over places (N, 2) of the plan, from far above (else from beneath);
    infinitely low (high) where nothing is."""
    way = -1.0 if down else 1.0
    origins = torch.cat([plan, torch.full((len(plan), 1), -way * _FAR, dtype=plan.dtype)], -1)
    item_from_world = invert(world_from_item)
    along = rotate(item_from_world, plan.new_tensor([0, 0, way]).expand(len(plan), 3))
    return way * (solid.hit(transform(item_from_world, origins), along) - _FAR)


def _lean(plan: Tensor, heights: Tensor) -> Tensor:
    """(3, 3) the least rotation that takes the upright to the normal of the plane through heights (N,) over (N, 2)."""
    columns = torch.cat([plan, torch.ones(len(plan), 1, dtype=plan.dtype)], -1)
    a, b, _ = torch.linalg.lstsq(columns, heights[:, None]).solution[:, 0].tolist()
    axis = torch.tensor([b, -a, 0.0], dtype=torch.float64)  # the upright x (-a, -b, 1)
    angle = float(np.arctan(np.hypot(a, b)))
    twist = torch.cat([torch.zeros(3, dtype=torch.float64), axis / axis.norm().clamp_min(1e-12) * angle])
    return exp(twist)[:3, :3]
