"""Camera paths drawn at random: orbits, half orbits, domes, forward-facing ones, and hand-held ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.pose import rigid
from refield.synthetic.cameras import looking_at
from refield.synthetic.random_places import Place
from refield.synthetic.state import Triple

PATHS = ("orbit", "half orbit", "hand-held", "dome", "forward")
_WAVES = 3  # of a hand's wander


@dataclass(frozen=True)
class CameraPath:
    """Poses along a way that is walked once: u in [0, 1)."""

    family: str
    target: Triple
    distance: float
    """metres to the target"""
    azimuth: tuple[float, float]
    """radians, first and last; for forward: metres left and right"""
    elevation: tuple[float, ...]
    """radians, one a lap; for forward: metres up and down"""
    sway: NDArray[np.float64]
    """(5, waves, 3): of azimuth, elevation, distance, aim and roll: how much, how often, from which phase"""
    jitter: float
    """of each photo by itself, a part of the distance and of a radian"""

    def _swayed(self, which: int, u: float) -> float:
        much, often, phase = self.sway[which].T
        return float((much * np.sin(2 * np.pi * (often * u + phase))).sum())

    def pose(self, u: float, rng: np.random.Generator) -> Tensor:
        """world_from_cam (4, 4) float64 of the photo taken at u; its own jitter is drawn."""
        lap = min(int(u * len(self.elevation)), len(self.elevation) - 1)
        along = u * len(self.elevation) - lap
        along = along if lap % 2 == 0 or self.family == "orbit" else 1 - along
        shake = rng.normal(size=6) * self.jitter
        target = np.array(self.target)
        distance = self.distance * (1 + self._swayed(2, u) + shake[2])
        level = self.elevation[lap]
        aim = target + self.distance * 0.5 * (shake[3:] + self._swayed(3, u) * np.array([1.0, -1.0, 0.5]))
        if self.family == "forward":
            across = self.azimuth[0] + along * (self.azimuth[1] - self.azimuth[0])
            offset = np.array([across, -distance, level]) + self.distance * np.array([shake[0], 0, shake[1]])
            aim = aim + 0.5 * np.array([across, 0, level])
        else:
            angle = self.azimuth[0] + along * (self.azimuth[1] - self.azimuth[0]) + self._swayed(0, u) + shake[0]
            high = float(np.clip(level + self._swayed(1, u) + shake[1], np.deg2rad(8), np.deg2rad(75)))
            flat = [np.cos(high) * np.cos(angle), np.cos(high) * np.sin(angle), np.sin(high)]
            offset = distance * np.array(flat)
        pose = looking_at(torch.from_numpy(target + offset), torch.from_numpy(aim))
        roll = self._swayed(4, u) + self.jitter * float(rng.normal())
        c, s = float(np.cos(roll)), float(np.sin(roll))
        turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
        return rigid(pose[:3, :3] @ turn, pose[:3, 3])

    def poses(self, rng: np.random.Generator, count: int) -> list[Tensor]:
        """So many photos, evenly along the way."""
        return [self.pose((i + 0.5) / count, rng) for i in range(count)]

    def new_poses(self, rng: np.random.Generator, count: int) -> list[Tensor]:
        """So many more, one at random from each of as many stretches of the way, whose laps are shuffled."""
        start = float(rng.random())
        laps = len(self.elevation)
        out = []
        for k in range(count):
            # spread over the directions, not over the laps: each at a random height
            along = (k + 0.8 * float(rng.random())) / count
            along = (along + start) % 1 if self.family in ("orbit", "dome") else along
            lap = int(rng.integers(laps))
            turned = along if lap % 2 == 0 or self.family == "orbit" else 1 - along
            out.append(self.pose(min((lap + turned) / laps, 0.999999), rng))
        return out


def draw_camera(rng: np.random.Generator) -> Camera:
    """A lens of 40 to 70 degrees across the longer side; 1200 pixels there, to be scaled."""
    wide, high = [(1200, 1200), (1200, 900), (900, 1200), (1200, 800)][int(rng.choice(4, p=[0.4, 0.3, 0.15, 0.15]))]
    focal = 600 / float(np.tan(np.deg2rad(rng.uniform(40, 70)) / 2))
    return Camera(wide, high, focal, focal, wide / 2, high / 2)


def in_both(camera: Camera) -> Camera:
    """What upright and turned photos of a camera both show: a square of its shorter side."""
    side = min(camera.width, camera.height)
    return Camera(side, side, camera.fx, camera.fy, side / 2, side / 2)


def turned(camera: Camera) -> Camera:
    """The camera held the other way, portrait or landscape."""
    return Camera(camera.height, camera.width, camera.fy, camera.fx, camera.cy, camera.cx)


def draw_path(rng: np.random.Generator, place: Place, camera: Camera) -> CameraPath:
    """A way around or before a place, from which its region about fills the picture."""
    family = str(rng.choice(list(place.views)))
    across = min(camera.width / camera.fx, camera.height / camera.fy) / 2
    distance = place.reach * float(rng.uniform(0.8, 1.1)) / across
    low = float(rng.uniform(15, 35))
    laps = int(rng.integers(1, 4))
    azimuth, elevation = (0.0, 2 * np.pi), tuple(np.deg2rad(low + 14 * k) for k in range(laps))
    sway, jitter = np.zeros((5, _WAVES, 3)), float(rng.uniform(0.0, 0.02))
    if family == "half orbit":
        span = np.deg2rad(rng.uniform(80, 130) if place.faces_front else rng.uniform(120, 200))
        azimuth = (place.front - span / 2, place.front + span / 2)
    elif family == "dome":
        elevation = tuple(np.deg2rad(np.linspace(low - 3, 68, int(rng.integers(4, 7)))))
    elif family == "forward":
        side, up = float(rng.uniform(0.4, 0.8)) * place.reach, float(rng.uniform(0.25, 0.5)) * place.reach
        azimuth, base = (-side, side), float(rng.uniform(0.15, 0.5)) * distance
        elevation = tuple(base + v for v in np.linspace(-up / 2, up / 2, int(rng.integers(3, 6))))
    elif family == "hand-held":
        span = np.deg2rad(rng.uniform(80, 120) if place.faces_front else rng.uniform(150, 330))
        azimuth = (place.front - span / 2, place.front + span / 2)
        much = rng.uniform(0.3, 1.0, (5, _WAVES)) * np.array([0.06, 0.08, 0.05, 0.03, 0.03])[:, None]
        sway = np.stack([much, rng.uniform(1, 6, (5, _WAVES)), rng.uniform(0, 1, (5, _WAVES))], -1)
        jitter = float(rng.uniform(0.01, 0.03))
    levels = tuple(float(e) for e in elevation)
    return CameraPath(family, place.target, distance, azimuth, levels, sway, jitter)
