"""Worlds photographed from within: ways round a free middle, with things all around, drawn at random.

One looks outwards in every direction (inside-out), one walks in a circle and looks along it (walk). Objects that may
change stand in one direction of the middle, towards +y; the new photos are taken of these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refield.scene.pose import rigid
from refield.synthetic import random_textures
from refield.synthetic.cameras import looking_at
from refield.synthetic.random_changes import apart, rested
from refield.synthetic.random_objects import drawn_item
from refield.synthetic.random_places import GROUND, Patch, Place, level_ground, slab_item
from refield.synthetic.state import Item, Triple

ROUNDS = ("inside-out", "walk")
_NORTH = np.pi / 2
_FREE = np.deg2rad(28)  # to both sides of the objects' direction nothing else stands
_TURNS = np.deg2rad(100)  # to both sides of it new photos are taken


@dataclass(frozen=True)
class RoundPath:
    """Poses along a circle around the middle of the world that is walked once a lap: u in [0, 1)."""

    family: str
    target: Triple
    distance: float
    """metres from the circle to the target"""
    radius: float
    """metres, of the circle"""
    heights: tuple[float, ...]
    """metres above the ground, one a lap"""
    pitches: tuple[float, ...]
    """radians upwards, one a lap"""
    heading: float
    """radians from outwards to where the camera looks"""
    start: float
    """radians: where the laps begin"""
    jitter: float
    """of each photo by itself, a part of the distance and of a radian"""

    def _eye(self, angle: float, high: float, rng: np.random.Generator) -> Tensor:
        at = np.array([self.radius * np.cos(angle), self.radius * np.sin(angle), high])
        return torch.from_numpy(at + self.radius * self.jitter * rng.normal(size=3))

    def pose(self, u: float, rng: np.random.Generator) -> Tensor:
        """world_from_cam (4, 4) float64 of the photo taken at u; its own jitter is drawn."""
        lap = min(int(u * len(self.heights)), len(self.heights) - 1)
        # laps stand between each other's places
        angle = self.start + 2 * np.pi * (u * len(self.heights) - lap + 0.38 * lap / len(self.heights))
        eye = self._eye(angle, self.heights[lap], rng)
        way, up = angle + self.heading + self.jitter * rng.normal(), self.pitches[lap] + self.jitter * rng.normal()
        ahead = np.array([np.cos(up) * np.cos(way), np.cos(up) * np.sin(way), np.sin(up)])
        return self._rolled(looking_at(eye, eye + torch.from_numpy(ahead)), rng)

    def _rolled(self, pose: Tensor, rng: np.random.Generator) -> Tensor:
        roll = self.jitter * float(rng.normal())
        c, s = float(np.cos(roll)), float(np.sin(roll))
        turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
        return rigid(pose[:3, :3] @ turn, pose[:3, 3])

    def poses(self, rng: np.random.Generator, count: int) -> list[Tensor]:
        """So many photos, evenly along the way."""
        return [self.pose((i + 0.5) / count, rng) for i in range(count)]

    def new_poses(self, rng: np.random.Generator, count: int) -> list[Tensor]:
        """So many of the objects' place, one from each of as many stretches of the circle on its side."""
        out = []
        for k in range(count):
            angle = _NORTH + _TURNS * (2 * (k + 0.1 + 0.8 * float(rng.random())) / count - 1)
            eye = self._eye(angle, self.heights[int(rng.integers(len(self.heights)))], rng)
            aim = torch.from_numpy(np.array(self.target) + self.distance * self.jitter * rng.normal(size=3))
            out.append(self._rolled(looking_at(eye, aim), rng))
        return out


def draw_round(rng: np.random.Generator, family: str, *, outdoors: bool) -> tuple[Place, RoundPath, float]:
    """A place with things all around, a way round its middle, and how far the things reach, metres."""
    reach = float(rng.uniform(0.5, 0.9))
    far = reach * float(rng.uniform(2.4, 3.2))
    edge = far + 0.9 * reach
    kind, paint = random_textures.ground(rng, 1024 if outdoors else 768, outdoors=outdoors)
    ground = level_ground(paint, edge + GROUND * reach if outdoors else edge, outdoors)
    patch = Patch((-0.9 * reach, far - 0.6 * reach), (0.9 * reach, far + 0.6 * reach))
    target = (0.0, far, 0.25 * reach)
    stands = tuple(_stands(rng, reach, far))
    place = Place("around", (ground, *stands), (patch,), reach, target, 0.8 * reach, (family,), False, kind)
    radius = far * (float(rng.uniform(0.22, 0.4)) if family == "inside-out" else float(rng.uniform(0.4, 0.5)))
    aside = 0.0 if family == "inside-out" else float(rng.choice([-1, 1])) * float(np.deg2rad(rng.uniform(45, 85)))
    laps, eyes = int(rng.integers(2, 4)), reach * float(rng.uniform(0.8, 1.3))
    heights = tuple(eyes * (1 + 0.2 * k) for k in range(laps))
    pitches = tuple(-float(np.deg2rad(rng.uniform(2, 22))) for _ in range(laps))
    start, jitter = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(0.005, 0.03))
    path = RoundPath(family, target, far - radius, radius, heights, pitches, aside, start, jitter)
    return place, path, edge


def _stands(rng: np.random.Generator, reach: float, far: float) -> list[Item]:
    """What stays, in all directions but the objects' own: things on the floor, and boxes as high as furniture."""
    out: list[Item] = []
    wanted = int(rng.integers(9, 15))
    for k in range(wanted):
        angle = _NORTH + _FREE + (2 * np.pi - 2 * _FREE) * (k + float(rng.uniform(0.2, 0.8))) / wanted
        away = far * float(rng.uniform(0.92, 1.12))
        x, y = away * float(np.cos(angle)), away * float(np.sin(angle))
        if rng.random() < 0.4:
            half, high = reach * rng.uniform(0.12, 0.3, 2), reach * float(rng.uniform(0.8, 1.8))
            style = random_textures.draw_style(rng, ("wood", "painted", "mottled", "checked"))
            paint = random_textures.face(rng, style, 192)
            low, top = (x - float(half[0]), y - float(half[1]), 0.0), (x + float(half[0]), y + float(half[1]), high)
            item: Item | None = slab_item(f"stands {k}", low, top, paint)
        else:
            thing = drawn_item(rng, f"stands {k}", reach * float(rng.uniform(0.4, 0.8)))[0]
            item = rested(rng, thing, Patch((x - 2 * reach, y - 2 * reach), (x + 2 * reach, y + 2 * reach)))
            item = None if item is None else _at(item, x, y)
        if item is not None and apart(item, out):
            out.append(item)
    return out


def _at(item: Item, x: float, y: float) -> Item:
    """The item with its middle above (x, y), as it stands."""
    now = item.world_from_item[:2, 3].tolist()
    return item.turned(0.0, (x - now[0], y - now[1], 0.0))
