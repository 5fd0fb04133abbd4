"""Worlds that break an assumption: that light stays, surfaces are dull, objects rigid, the scene the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from refield.synthetic.placing import box_item, lit, round_item, stood, with_moved, world_rng
from refield.synthetic.shapes import Box, Cone, Cylinder, Sphere
from refield.synthetic.state import Item, State, World

_DIM = np.array([0.09, 0.12, 0.19], np.float32)  # an eighth of the light in the mean luminance, and bluer


def mirror(seed: int = 0) -> World:
    """A cabinet of polished steel stays; a box moves before it, and so does its reflection."""
    rng = world_rng(seed, "mirror")
    cabinet = box_item(rng, "cabinet", (0.34, 0.1, 0.26), 0.6, (0.25, 0.3, -35))
    steel = (0.8 + 0.08 * (cabinet.texture - 0.5)).astype(np.float32)
    cabinet = replace(cabinet, texture=steel, glossy=False, metal=True, roughness=0.06)
    box = box_item(rng, "box", (0.16, 0.15, 0.16), 0.05, (-0.35, 0.05, 20))
    return with_moved("mirror", lit(rng, (cabinet, box), "tiles"), stood(box, 0.15, -0.28, 65))


def shiny(seed: int = 0) -> World:
    """A polished box under six lamps: its highlights stay with the lamps and the eye, not with the box."""
    rng = world_rng(seed, "shiny")
    item = box_item(rng, "box", (0.2, 0.18, 0.19), 0.6, (-0.3, -0.2, 15))
    item = replace(item, roughness=0.07)
    before = lit(rng, (item,), "wood")
    return with_moved("shiny", replace(before, surroundings=_lamps(before)), item.turned(40, (0.5, 0.4, 0)))


def _lamps(state: State) -> NDArray[np.float32]:
    """Dimmer surroundings with six bright panels in them, as high as the cameras are, so that tops show them."""
    height, width = state.surroundings.shape[:2]
    elevation = 90 - 180 * (np.arange(height) + 0.5) / height
    azimuth = 360 * (np.arange(width) + 0.5) / width
    high = np.abs(elevation - 38) < 7
    there = np.abs((azimuth + 20) % 60 - 30) < 9
    return (0.6 * state.surroundings + 9.0 * (high[:, None] & there[None])[..., None]).astype(np.float32)


def deformed(seed: int = 0) -> World:
    """A box is squashed to half its height and spreads; its paint stays on it. No rigid motion explains it."""
    rng = world_rng(seed, "deformed")
    item = box_item(rng, "box", (0.18, 0.18, 0.2), 0.6, (-0.05, -0.05, 20))
    ball = round_item(rng, "ball", Sphere(0.15), 0.1, (0.5, 0.35, 0))
    squashed = stood(replace(item, solid=Box((0.25, 0.26, 0.1))), -0.02, -0.03, 28)
    return with_moved("deformed", lit(rng, (item, ball), "bricks"), squashed)


def _shelf(rng: np.random.Generator) -> tuple[Item, ...]:
    return (
        box_item(rng, "box", (0.2, 0.18, 0.19), 0.6, (-0.3, -0.3, 20)),
        round_item(rng, "drum", Cylinder(0.15, 0.36), 0.03, (0.45, -0.2, 0)),
        round_item(rng, "ball", Sphere(0.17), 0.35, (-0.1, 0.45, 0)),
    )


def lights_off(seed: int = 0) -> World:
    """Nothing moved, but the light is an eighth and bluer."""
    rng = world_rng(seed, "lights_off")
    before = lit(rng, _shelf(rng), "wood")
    return World("lights_off", before, replace(before, surroundings=before.surroundings * _DIM))


def elsewhere(seed: int = 0) -> World:
    """The new photos show another scene: other floor, other objects, other light. All left, all is new."""
    rng = world_rng(seed, "elsewhere")
    before = lit(rng, _shelf(rng), "tiles")
    others = (
        round_item(rng, "cone", Cone(0.22, 0.44), 0.85, (-0.4, 0.2, 0)),
        box_item(rng, "chest", (0.26, 0.17, 0.15), 0.12, (0.3, 0.35, 40)),
        box_item(rng, "tower", (0.11, 0.12, 0.27), 0.45, (0.1, -0.4, 10)),
    )
    after = lit(rng, others, "bricks")
    ground = replace(after.items[0], name="other floor")
    return World("elsewhere", before, replace(after, items=(ground, *others)))
