"""What happens in a rehearsal: random objects at free places, and one kind of change, all from a seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.rehearse.spots import Site, is_free, pose_at, upright
from refield.scene.errors import InputError
from refield.scene.pose import exp
from refield.scene.srgb import to_linear
from refield.synthetic.random_objects import drawn_item
from refield.synthetic.random_textures import Pattern
from refield.synthetic.shading import Light
from refield.synthetic.shapes import Solid
from refield.synthetic.state import Item, State, World

HAPPENINGS = ("moved", "added", "removed", "several", "turned", "tipped", "nothing")
"""what seed N does is the N-th of these, round and round"""
LARGEST, SMALLEST = 0.35, 0.10
"""of the picture's shorter side at that distance"""
_T = TypeVar("_T")
_TRIES = 60
_THINGS = 3  # that stand there, where one state is changed in several ways
_JOINED = 0.4  # of those changes something arrives as well
_SHRINK, _LEAST = 0.85, 0.9
_LEAST_TURN, _MOST_TURN = 25.0, 65.0  # degrees: a square looks the same again at 90
_ROUND = 0.05  # of its reach from the upright: what turns by less of it looks as before
_MEAN_ALBEDO = 0.3
_WHITEST = 0.8


class NoRoomError(InputError):
    """There is no place for what is to happen."""


@dataclass(frozen=True)
class Plan:
    """A rehearsal before it is photographed."""

    world: World
    site: Site
    light: Light
    facts: dict[str, Any]


@dataclass
class _Stage:
    """Fills a site with objects that do not meet, in either state."""

    site: Site
    rng: np.random.Generator
    taken: list[tuple[NDArray[np.float64], float]]
    drawn_as: dict[str, tuple[str, Pattern]] = field(default_factory=dict)
    """family and texture, by name"""

    def drawn(self, name: str, size: float, doing: str) -> Item:
        """A random object; one that is to be turned is not round."""
        while True:
            item, family, pattern = drawn_item(self.rng, name, size / 3**0.5 * self.rng.uniform(1.1, 1.5))
            if doing != "turned" or not is_round(item.solid):
                self.drawn_as[name] = (family, pattern)
                return item

    def place(self, item: Item, near: Tensor | None = None, tip: Tensor | None = None) -> Item | None:
        """The item at a free spot, by preference close to the place ``near``; None where it finds no room."""
        spots = self.site.centres[: max(len(self.site.centres) // 2, 8)]  # the better seen half
        order = self.rng.permutation(len(spots))
        if near is not None:
            away = np.linalg.norm(spots - near.numpy(), axis=-1)
            order = order[np.argsort(away[order] > 5 * max(item.solid.half), kind="stable")]
        vertices = torch.from_numpy(item.solid.mesh()[0]).double()
        for k in order[:_TRIES].tolist():
            turn = upright(self.site, self.rng.uniform(0, 360))
            turn = turn if tip is None else turn @ tip
            radius, height, lowest = _extent(vertices @ turn.T, self.site.up)
            apart = all(np.linalg.norm(spots[k] - at) > 1.1 * (radius + r) for at, r in self.taken)
            if apart and is_free(self.site, spots[k], radius, height):
                self.taken.append((spots[k], radius))
                return replace(item, world_from_item=pose_at(self.site, spots[k], turn, -lowest))
        return None


def is_round(solid: Solid) -> bool:
    """Whether turning it about its own upright hardly changes its shape: also a bottle's or a tube's."""
    vertices = torch.from_numpy(solid.mesh()[0]).double()
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    turned = torch.cat([vertices @ _twist(up, d).T for d in np.linspace(_LEAST_TURN, _MOST_TURN, 3)])
    reach = float(vertices[:, :2].norm(dim=-1).max())
    return float(solid.distance(turned).max()) < _ROUND * reach


def plans_of(sites: Sequence[Site], seed: int, count: int) -> list[Plan]:
    """So many random changes of one and the same state with three objects, each of one to three of them, at the first
    of the sites that has room.

    Raises:
        NoRoomError: there is no place that enough photos see, or no free one.
    """
    part = float(np.random.default_rng([seed, 17]).uniform(SMALLEST, LARGEST))
    stage, state = _staged(sites, (seed, 18), part, _things)
    light = _light(np.random.default_rng([seed, 19]), stage.site, World("several", state, state))
    return [_changed(stage, state, light, seed, k) for k in range(count)]


def _things(stage: _Stage, size: float) -> State | None:
    """Objects any of which can be turned; None where there is no room for all."""
    items = [stage.place(stage.drawn(f"object {k}", size, "turned")) for k in range(_THINGS)]
    there = tuple(item for item in items if item is not None)
    return State(there, np.zeros((1, 2, 3), np.float32)) if len(there) == len(items) else None


def _changed(stage: _Stage, before: State, light: Light, seed: int, number: int) -> Plan:
    """One change of a state: what has no room to go elsewhere leaves."""
    stage = replace(stage, rng=np.random.default_rng([seed, 20, number]), taken=[*stage.taken])
    rng = stage.rng
    chosen = rng.permutation(_THINGS)[: 1 + number % _THINGS].tolist()
    after: list[Item] = []
    for k, item in enumerate(before.items):
        now: Item | None = item
        if k in chosen:
            doing = str(rng.choice([*_DOINGS, "removed"]))
            now = _DOINGS[doing](stage, item) if doing in _DOINGS else None
        after += [] if now is None else [now]
    if rng.random() < _JOINED:
        size = max(2 * max(item.solid.half) for item in before.items)
        new = stage.place(stage.drawn(f"object {_THINGS + number}", size, ""))
        after += [] if new is None else [new]
    world = World("random several", before, State(tuple(after), before.surroundings))
    return Plan(world, stage.site, light, _facts(seed, "several", stage, world, light) | {"change": number})


def plan_of(sites: Sequence[Site], seed: int) -> Plan:
    """A random rehearsal at the first of the sites that has room for it.

    Raises:
        NoRoomError: there is no place that enough photos see, or no free one.
    """
    rng = np.random.default_rng([seed, 11])
    happening, part = HAPPENINGS[seed % len(HAPPENINGS)], float(rng.uniform(SMALLEST, LARGEST))
    stage, world = _staged(sites, (seed, 13), part, lambda stage, size: _enacted(stage, happening, size))
    light = _light(rng, stage.site, world)
    return Plan(world, stage.site, light, _facts(seed, happening, stage, world, light))


def _staged(
    sites: Sequence[Site], seed: Sequence[int], part: float, enacted: Callable[[_Stage, float], _T | None]
) -> tuple[_Stage, _T]:
    """What is enacted at the first of the sites that has room for it, with smaller and smaller objects.

    Args:
        part: of the picture's shorter side, how large the objects are at first.

    Raises:
        NoRoomError: there is no place that enough photos see, or no free one.
    """
    for site in sites:
        smaller = part
        while len(site.centres) and smaller >= _LEAST * SMALLEST:
            stage = _Stage(site, np.random.default_rng(seed), [])
            found = enacted(stage, smaller * site.width)
            if found is not None:
                return stage, found
            smaller *= _SHRINK
    what = "there is no free place in it that a third of the photos and three of the four new ones show"
    raise NoRoomError("the rehearsal", what, "photos that look at one place from many sides are needed")


def _enacted(stage: _Stage, happening: str, size: float) -> World | None:
    """Bystanders and the changes of a kind; None where there is no room for all."""
    rng = stage.rng
    if happening == "several":
        doings = [str(d) for d in rng.choice(["moved", "added", "removed", "turned"], int(rng.integers(2, 4)))]
    else:
        doings = [happening]
    bystanders = int(rng.integers(0, 2)) + (happening == "nothing")
    before: list[Item] = []
    after: list[Item] = []
    for k, doing in enumerate(doings + ["nothing"] * (bystanders - (happening == "nothing"))):
        item = stage.place(stage.drawn(f"object {k}", size, doing))
        if item is None:
            return None
        now: Item | None = item
        if doing in _DOINGS:
            now = _DOINGS[doing](stage, item)
            if now is None:
                return None
        before += [item] if doing != "added" else []
        after += [now] if doing != "removed" and now is not None else []
    dark = np.zeros((1, 2, 3), np.float32)
    return World(f"random {happening}", State(tuple(before), dark), State(tuple(after), dark))


def _moved(stage: _Stage, item: Item) -> Item | None:
    return stage.place(item, near=item.world_from_item[:3, 3])


def _turned(stage: _Stage, item: Item) -> Item:
    degrees = stage.rng.uniform(_LEAST_TURN, _MOST_TURN) * stage.rng.choice([-1, 1])
    pose = item.world_from_item.clone()
    pose[:3, :3] = _twist(stage.site.up, degrees) @ pose[:3, :3]
    return replace(item, world_from_item=pose)


def _tipped(stage: _Stage, item: Item) -> Item | None:
    """Laid on its side, at another place."""
    axis = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)[int(stage.rng.integers(2))]
    return stage.place(item, near=item.world_from_item[:3, 3], tip=_twist(axis, 90.0 * stage.rng.choice([-1, 1])))


_DOINGS: dict[str, Callable[[_Stage, Item], Item | None]] = {"moved": _moved, "turned": _turned, "tipped": _tipped}


def _twist(axis: Tensor, degrees: float) -> Tensor:
    return exp(torch.cat([torch.zeros(3, dtype=torch.float64), axis * np.deg2rad(degrees)]))[:3, :3]


def _extent(vertices: Tensor, up: Tensor) -> tuple[float, float, float]:
    """How far points (V, 3) reach across ``up``, how high they are, and where along it they begin."""
    along = vertices @ up
    beside = (vertices - along[:, None] * up).norm(dim=-1)
    return float(beside.max()), float(along.max() - along.min()), float(along.min())


def _light(rng: np.random.Generator, site: Site, world: World) -> Light:
    """A soft sun from somewhere above; as bright as what is photographed around the objects."""
    height, bearing = np.deg2rad(rng.uniform(40, 70)), rng.uniform(0, 360)
    frame = upright(site, bearing)
    sun = np.cos(height) * frame[:, 0] + np.sin(height) * frame[:, 2]
    places = torch.stack([i.box().mean(0) for i in (*world.before.items, *world.after.items)]).numpy()
    reach = 3 * max(max(item.solid.half) for item in (*world.before.items, *world.after.items))
    points, colours = site.surfaces.points, to_linear(site.surfaces.colours)
    near = np.min([np.linalg.norm(points - at, axis=-1) for at in places], 0) < reach
    around = colours[near] if near.sum() > 50 else colours
    bright = float(np.quantile(colours.mean(-1), 0.98)) / _WHITEST  # nothing is put in that outshines the scene
    level = min(float(around.mean()) / _MEAN_ALBEDO, max(bright, float(around.mean())))
    cast = colours.mean(0) / max(float(colours.mean()), 1e-6)
    radiance = torch.from_numpy((level * cast**0.5).astype(np.float32))
    return Light(site.up, sun / sun.norm(), float(rng.uniform(0.25, 0.55)), float(rng.uniform(0.1, 0.3)), radiance)


def _facts(seed: int, happening: str, stage: _Stage, world: World, light: Light) -> dict[str, Any]:
    site = stage.site
    items = {item.name: item for item in (*world.before.items, *world.after.items)}
    kinds = {item.name: c.kind for c in world.changes for item in (c.old, c.new) if item is not None}
    return {
        "seed": seed,
        "happening": happening,
        "changes": [c.kind for c in world.changes],
        "objects": [
            {
                "name": name,
                "family": stage.drawn_as[name][0],
                "texture": stage.drawn_as[name][1],
                "size": 2 * max(item.solid.half),
                "part_of_picture": 2 * max(item.solid.half) / site.width,
                "change": kinds.get(name, "none"),
            }
            for name, item in items.items()
        ],
        "floating": site.floating,
        "up": site.up.tolist(),
        "sun": light.sun.tolist(),
        "depth_noise": site.surfaces.noise,
    }
