"""Textures drawn at random for any solid: plain to busy, each face and part its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from refield.synthetic import textures
from refield.synthetic.compound import Compound
from refield.synthetic.shapes import Box, Cone, Cylinder, Solid, Sphere
from refield.synthetic.solids import Convex, Ellipsoid, RoundedBox
from refield.synthetic.textures import Image

Pattern = Literal["plain", "mottled", "striped", "checked", "dotted", "painted", "patched", "wood", "marble"]
PATTERNS: tuple[Pattern, ...] = get_args(Pattern)
_HOW_OFTEN = (0.1, 0.1, 0.1, 0.1, 0.1, 0.2, 0.15, 0.1, 0.05)
_SIGNS = "A7K2F4"
_MOST = 1536  # pixels a side of an atlas
_LEAST = 12  # of a face


@dataclass(frozen=True)
class Style:
    """How an object is painted."""

    pattern: Pattern
    hue: float
    saturation: float
    value: float
    spread: float
    """of the hue over faces and parts; 0 = all alike"""


def draw_style(rng: np.random.Generator, patterns: tuple[Pattern, ...] = PATTERNS) -> Style:
    """A style of one of these patterns."""
    weights = np.array([_HOW_OFTEN[PATTERNS.index(p)] for p in patterns])
    pattern = patterns[int(rng.choice(len(patterns), p=weights / weights.sum()))]
    spread = float(rng.choice([0.0, 0.05, 0.4]))
    return Style(pattern, float(rng.random()), float(rng.uniform(0.1, 0.85)), float(rng.uniform(0.3, 0.9)), spread)


def face(rng: np.random.Generator, style: Style, size: int) -> Image:
    """One face (size, size, 3)."""
    hue = style.hue + style.spread * rng.uniform(-0.5, 0.5)
    ground = textures.colour(hue, style.saturation, style.value)
    if style.pattern == "plain":
        return np.broadcast_to(ground, (size, size, 3)).astype(np.float32)
    if style.pattern == "painted":
        return textures.painted_face(rng, size, hue, str(rng.choice(list(_SIGNS))))
    if style.pattern == "wood":
        return textures.wood(rng, size, int(rng.integers(1, 4)), hue=0.04 + 0.08 * style.hue)
    mix = _amount(rng, style.pattern, size)[..., None]
    other = textures.colour(hue + rng.choice([0.08, 0.33, 0.5]), rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.95))
    out = (1 - mix) * ground + mix * other
    return textures.blurred(np.clip(out, 0, 1).astype(np.float32), max(size / 120, 0.4))


def _amount(rng: np.random.Generator, pattern: str, size: int) -> NDArray[np.float32]:
    """How much of the second colour is where, (size, size) in [0, 1]; whole periods from side to side."""
    v, u = (np.mgrid[0:size, 0:size].astype(np.float32) + 0.5) / size
    count = int(rng.integers(2, 7))
    if pattern == "striped":
        lean = int(rng.integers(-2, 3))
        return ((count * u + lean * v) % 1 < rng.uniform(0.25, 0.6)).astype(np.float32)
    if pattern == "checked":
        return ((np.floor(2 * (count // 2 + 1) * u) + np.floor(count * v)) % 2).astype(np.float32)
    if pattern == "dotted":
        across = np.hypot((count * u) % 1 - 0.5, (count * v) % 1 - 0.5)
        return (across < rng.uniform(0.2, 0.4)).astype(np.float32)
    smooth = textures.noise(rng, (size, size), (3, 3), 3)
    if pattern == "marble":
        return np.exp(-((smooth / 0.15) ** 2)).astype(np.float32)
    if pattern == "mottled":
        return (0.25 * (1 + np.clip(smooth, -1, 1))).astype(np.float32)
    return (smooth > 0).astype(np.float32)


def atlas(rng: np.random.Generator, solid: Solid, style: Style, size: int = 128) -> Image:
    """A solid's whole atlas (H, W, 3), about ``size`` pixels across a face; less for solids of many."""
    if isinstance(solid, Compound):
        return _parts(rng, solid, style, size)
    if isinstance(solid, Sphere | Cylinder | Cone | Ellipsoid):
        return _wrapped(rng, solid, style, size)
    rows, columns = (
        solid.cells if isinstance(solid, Convex) else (2, 3) if isinstance(solid, Box | RoundedBox) else (1, 1)
    )
    size = max(min(size, _MOST // columns), _LEAST)
    faces = [[face(rng, style, size) for _ in range(columns)] for _ in range(rows)]
    return np.concatenate([np.concatenate(row, 1) for row in faces], 0)


def _parts(rng: np.random.Generator, solid: Compound, style: Style, size: int) -> Image:
    rows, columns = solid.cells
    size = max(min(size, 2 * size // columns), _LEAST)
    side = (2 * size, 3 * size)
    canvas = np.zeros((rows * side[0], columns * side[1], 3), np.float32)
    done: set[int] = set()
    for part in solid.parts:
        if part.cell not in done:
            done.add(part.cell)
            row, column = divmod(part.cell, columns)
            own = cv2.resize(atlas(rng, part.solid, style, size), side[::-1], interpolation=cv2.INTER_LINEAR)
            canvas[row * side[0] : (row + 1) * side[0], column * side[1] : (column + 1) * side[1]] = own
    return canvas


def _wrapped(rng: np.random.Generator, solid: Sphere | Cylinder | Cone | Ellipsoid, style: Style, size: int) -> Image:
    """Around a round solid: patches of its surface, or faces side by side."""
    if style.pattern == "patched":
        texel = (torch.arange(size) + 0.5) / size
        v, u = torch.meshgrid(texel, texel, indexing="ij")
        points = solid.at(torch.stack([u, v], -1)).float().numpy()
        return textures.patchwork(points, rng, int(rng.integers(12, 70)), style.hue)
    if isinstance(solid, Sphere | Ellipsoid):
        return np.concatenate([face(rng, style, size) for _ in range(2)], 1)
    side = np.concatenate([face(rng, style, size) for _ in range(3)], 1)
    caps = np.concatenate([face(rng, style, size) for _ in range(2)], 1)
    return np.concatenate([side, cv2.resize(caps, side.shape[1::-1], interpolation=cv2.INTER_AREA)], 0)


def ground(rng: np.random.Generator, size: int, *, outdoors: bool) -> tuple[str, Image]:
    """What one stands on, by name, (size, size, 3)."""
    kinds = ["grass", "gravel", "pavers", "sand"] if outdoors else ["wood", "tiles", "bricks", "carpet", "plain"]
    kind = str(rng.choice(kinds))
    hue = float(rng.random())
    if kind in ("pavers", "bricks"):
        return kind, textures.bricks(rng, size, 2 * int(rng.integers(10, 24)), hue, float(rng.uniform(0.5, 1.2)))
    if kind == "wood":
        return kind, textures.wood(rng, size, int(rng.integers(16, 36)), hue=0.05 + 0.06 * hue)
    if kind == "tiles":
        return kind, textures.tiles(rng, size, 2 * int(rng.integers(6, 16)), hue)
    paint, strength, finest = {
        "grass": (textures.colour(0.2 + 0.12 * hue, 0.6, 0.42), 0.35, 160),
        "gravel": (textures.colour(hue, 0.08, 0.55), 0.3, 120),
        "sand": (textures.colour(0.1, 0.35, 0.72), 0.1, 90),
        "carpet": (textures.colour(hue, 0.5, 0.5), 0.15, 90),
        "plain": (textures.colour(hue, 0.12, 0.66), 0.02, 8),
    }[kind]
    grain = textures.noise(rng, (size, size), (finest, finest), 2) + 0.5 * textures.noise(rng, (size, size), (6, 6), 3)
    tint = textures.noise(rng, (size, size), (8, 8), 3)[..., None] * np.array([0.12, 0.02, -0.08]) * strength
    return kind, np.clip(paint * (1 + strength * grain[..., None]) + tint, 0, 1).astype(np.float32)


def wall(rng: np.random.Generator, size: int) -> tuple[str, Image]:
    """A wall's face, by name, (size, size, 3)."""
    kind = str(rng.choice(["paint", "striped", "bricks", "pictures", "mottled"]))
    pale = Style("plain", float(rng.random()), float(rng.uniform(0, 0.3)), float(rng.uniform(0.6, 0.9)), 0.0)
    if kind == "bricks":
        return kind, textures.bricks(rng, size, 2 * int(rng.integers(5, 12)), pale.hue, 0.8)
    ground_colour = textures.colour(pale.hue, pale.saturation, pale.value)
    out = np.broadcast_to(ground_colour, (size, size, 3)).astype(np.float32).copy()
    if kind == "mottled":
        out *= 1 + 0.06 * textures.noise(rng, (size, size), (6, 6), 3)[..., None]
    if kind == "striped":
        u = np.arange(size) / size * int(rng.integers(6, 16)) % 1
        out *= np.where(u < 0.5, 1.0, float(rng.uniform(0.75, 0.92)))[None, :, None].astype(np.float32)
    if kind == "pictures":
        for _ in range(int(rng.integers(2, 5))):
            own = size // int(rng.integers(5, 9))
            row, column = rng.integers(size // 4, 3 * size // 4 - own), rng.integers(0, size - own)
            style = draw_style(rng, ("painted", "patched", "mottled"))
            out[row : row + own, column : column + own] = face(rng, style, own)
    return kind, np.clip(out, 0, 1).astype(np.float32)
