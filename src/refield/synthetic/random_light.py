"""Light drawn at random: suns and skies outdoors, lamps in rooms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from refield.synthetic import textures
from refield.synthetic.random_places import Place
from refield.synthetic.state import Lamp, State, Triple

_SKY = 128  # rows of the surroundings
_DARK = 0.02  # radiance outside of a closed room


@dataclass(frozen=True)
class Light:
    """What shines on a place."""

    family: str
    surroundings: textures.Image
    sun: Triple | None = None
    sun_direction: Triple = (0.0, 0.0, -1.0)
    lamps: tuple[Lamp, ...] = ()

    def on(self, state: State) -> State:
        """The state in this light."""
        return State(state.items, self.surroundings, self.sun, self.sun_direction, self.lamps)


def _tint(rng: np.random.Generator, strength: float) -> Triple:
    """From warm to cold, of mean 1 in green."""
    warm = float(rng.uniform(-strength, strength))
    return (1 + warm, 1.0, 1 - warm)


def _times(factor: float, tint: Triple) -> Triple:
    return (factor * tint[0], factor * tint[1], factor * tint[2])


def sky(rng: np.random.Generator) -> Light:
    """Outdoors: a hard sun under a dimmer sky, a veiled one, an overcast sky, the evening."""
    family = str(rng.choice(["sun", "veiled sun", "overcast", "evening"], p=[0.4, 0.25, 0.2, 0.15]))
    if family in ("sun", "evening"):
        high = np.deg2rad(rng.uniform(25, 70) if family == "sun" else rng.uniform(12, 25))
        side = float(rng.uniform(0, 2 * np.pi))
        direction = (-float(np.cos(high) * np.cos(side)), -float(np.cos(high) * np.sin(side)), -float(np.sin(high)))
        tint = _tint(rng, 0.08) if family == "sun" else (1.35, 0.95, 0.6)
        strength = float(rng.uniform(1.5, 3.0))
        around = (0.5 * textures.surroundings(rng, sun=0.0, height=_SKY)).astype(np.float32)
        return Light(family, around, _times(strength, tint), direction)
    around = textures.surroundings(rng, sun=9.0 if family == "veiled sun" else 0.0, height=_SKY)
    turned = np.roll(around, int(rng.integers(around.shape[1])), axis=1)
    return Light(family, turned * np.array(_tint(rng, 0.08), np.float32))


def studio(rng: np.random.Generator) -> Light:
    """Large soft panels around in even grey, for places without walls."""
    height, width = _SKY, 2 * _SKY
    elevation = 90 - 180 * (np.arange(height) + 0.5) / height
    azimuth = 360 * (np.arange(width) + 0.5) / width
    out = np.full((height, width, 3), 0.35, np.float32)
    out[elevation < 0] = 0.15
    for _ in range(int(rng.integers(1, 5))):
        at, high, wide = rng.uniform(0, 360), rng.uniform(25, 75), rng.uniform(10, 30)
        inside = np.abs(elevation - high)[:, None] < wide / 2
        inside = inside & (np.abs((azimuth - at + 180) % 360 - 180) < wide)[None]
        out[inside] += rng.uniform(2, 8) * np.array(_tint(rng, 0.15), np.float32)
    return Light("studio", out.astype(np.float32))


def lamps(rng: np.random.Generator, place: Place, wide: float, high: float) -> Light:
    """Under the ceiling of a room: panels, or a bulb beside a panel; never behind what the place has at its back."""
    family = str(rng.choice(["panels", "bulb"], p=[0.7, 0.3]))
    back = -0.1 if place.faces_front else 1.0
    out = []
    for _ in range(int(rng.integers(1, 4)) if family == "panels" else 1):
        half = (float(rng.uniform(0.15, 0.35)) * wide, float(rng.uniform(0.15, 0.35)) * wide)
        x = float(rng.uniform(-1, 1)) * (0.9 * wide - half[0])
        y = float(rng.uniform(-0.9 * wide + half[1], back * (0.9 * wide - half[1])))
        out.append(Lamp((x, y, high - 0.01), _times(1 / (half[0] * half[1]), _tint(rng, 0.2)), half))
    if family == "bulb":
        x, y = float(rng.uniform(-0.5, 0.5)) * wide, float(rng.uniform(-0.5, 0.5 * back)) * wide
        out.append(Lamp((x, y, high - 0.25 * (high - place.target[2]) - 0.05), _times(4.0, _tint(rng, 0.25))))
    return Light(family, np.full((8, 16, 3), _DARK, np.float32), lamps=tuple(out))
