"""Real-looking textures made from numbers: floors, painted boxes, patchwork, surroundings. sRGB in [0, 1].

Everything is band-limited: the finest detail is about a fiftieth of a face, so that photos of 128 pixels can
hold it.
"""

from __future__ import annotations

import colorsys

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
"""(H, W, 3) sRGB in [0, 1]"""
_SHIFT = 4  # cv2 draws with 4 fractional bits


def noise(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int], octaves: int = 3) -> Image:
    """Smooth noise (H, W) around 0, about ±1, periodic in both directions; ``cells`` is its coarsest grid."""
    out = np.zeros(shape, np.float32)
    for k in range(octaves):
        grid = rng.uniform(-1, 1, (cells[0] << k, cells[1] << k)).astype(np.float32)
        wrapped = np.pad(grid, 2, mode="wrap")
        scale = [shape[i] / grid.shape[i] for i in range(2)]
        size = (round(wrapped.shape[1] * scale[1]), round(wrapped.shape[0] * scale[0]))
        fine = cv2.resize(wrapped, size, interpolation=cv2.INTER_CUBIC)
        y, x = round(2 * scale[0]), round(2 * scale[1])
        out += 0.5**k * fine[y : y + shape[0], x : x + shape[1]]
    return out


def colour(hue: float, saturation: float, value: float) -> NDArray[np.float32]:
    """(3,) sRGB; any hue is taken modulo 1, the others are clamped to [0, 1]."""
    s, v = min(max(saturation, 0.0), 1.0), min(max(value, 0.0), 1.0)
    return np.array(colorsys.hsv_to_rgb(hue % 1.0, s, v), np.float32)


def blurred(image: Image, sigma: float) -> Image:
    """Gaussian blur by ``sigma`` pixels."""
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT).astype(np.float32)


def bricks(rng: np.random.Generator, size: int, rows: int, hue: float, contrast: float = 1.0) -> Image:
    """Running-bond bricks or pavers with light joints, each of its own shade."""
    v, u = np.mgrid[0:size, 0:size].astype(np.float32) / size * rows
    row = np.floor(v).astype(int)
    along = u / 2 + 0.5 * (row % 2)
    column = np.floor(along).astype(int) % max(rows // 2, 1)
    shade = rng.uniform(-1, 1, (rows, max(rows // 2, 1)))[row % rows, column]
    tint = rng.uniform(-1, 1, (rows, max(rows // 2, 1)))[row % rows, column]
    joint = np.minimum(np.minimum(v % 1, 1 - v % 1), 2 * np.minimum(along % 1, 1 - along % 1))
    body = np.clip((joint - 0.06) / 0.08, 0, 1)[..., None]
    grain = noise(rng, (size, size), (rows, rows), 2)
    value = 0.52 + contrast * (0.13 * shade + 0.05 * grain)
    face = np.stack([value * c for c in colour(hue, 0.45, 1.0)], -1)
    face += contrast * 0.05 * tint[..., None] * np.array([1.0, 0.1, -0.9])
    return blurred((body * face + (1 - body) * 0.72).astype(np.float32), size / 300)


def tiles(rng: np.random.Generator, size: int, rows: int, hue: float) -> Image:
    """Square stone tiles in two tones with veins."""
    v, u = np.mgrid[0:size, 0:size].astype(np.float32) / size * rows
    i, j = v.astype(int), u.astype(int)
    shade = rng.uniform(-0.1, 0.1, (rows, rows))[i, j] + 0.13 * ((i + j) % 2)
    joint = np.minimum(np.minimum(v % 1, 1 - v % 1), np.minimum(u % 1, 1 - u % 1))
    body = np.clip((joint - 0.02) / 0.04, 0, 1)[..., None]
    veins = np.exp(-((noise(rng, (size, size), (4, 4), 4) / 0.12) ** 2))
    value = 0.45 + shade + 0.04 * noise(rng, (size, size), (8, 8), 2) - 0.12 * veins
    face = value[..., None] * (colour(hue, 0.18, 1.0) / 0.9)
    return blurred((body * face + (1 - body) * 0.3).astype(np.float32), size / 300)


def wood(rng: np.random.Generator, size: int, planks: int, hue: float = 0.08) -> Image:
    """Planks with grain along u."""
    v, u = np.mgrid[0:size, 0:size].astype(np.float32) / size
    plank = np.minimum((v * planks).astype(int), planks - 1)
    shade = rng.uniform(-0.12, 0.12, planks)[plank]
    offset = rng.uniform(0, 1, planks)[plank]
    grain = noise(rng, (size, size), (planks * 4, 3), 2)
    knots = noise(rng, (size, size), (planks, 3), 2)
    rings = np.sin(2 * np.pi * (v * planks * 2.2 + 0.6 * knots + offset))
    value = 0.58 + shade + 0.06 * grain + 0.07 * rings
    butt = np.abs((u * 2 + offset) % 1 - 0.5) * planks / 2
    seam = np.minimum((v * planks) % 1, 1 - (v * planks) % 1)
    dark = np.clip(np.minimum(seam / 0.08, butt / 0.05), 0.35, 1)
    return blurred(((value * dark)[..., None] * colour(hue, 0.5, 1.0)).astype(np.float32), size / 300)


def painted_face(rng: np.random.Generator, size: int, hue: float, label: str) -> Image:
    """One face of a box: a ground colour, a border, soft-edged patches and a big sign; no symmetry."""
    n = 2 * size
    ground = colour(hue, 0.62, 0.62) * (1 + 0.22 * noise(rng, (n, n), (4, 4), 2)[..., None])
    canvas = np.rint(np.clip(ground, 0, 1) * 255).astype(np.uint8)
    for k in range(7):
        paint = colour(hue + rng.choice([0.12, 0.33, 0.5, 0.67]), rng.uniform(0.2, 0.8), rng.uniform(0.2, 0.95))
        at, reach = rng.uniform(0.1, 0.9, 2) * n, rng.uniform(0.07, 0.17) * n
        _patch(canvas, rng, k, _ink(paint), at, reach)
    paint = colour(hue + 0.5, 0.2, 0.97) if rng.random() < 0.5 else colour(hue, 0.5, 0.1)
    scale = 0.42 * n
    corner = rng.uniform(0.15, 0.85, 2) * (n - np.array([0.6, 1.0]) * scale)
    lines = [np.rint(corner + scale * np.array(stroke)).astype(np.int32) for stroke in _SIGNS[label]]
    cv2.polylines(canvas, lines, False, _ink(paint), int(n * 0.055), cv2.LINE_AA)
    cv2.rectangle(canvas, (0, 0), (n - 1, n - 1), _ink(colour(hue + 0.08, 0.5, 0.3)), int(n * 0.05))
    small = cv2.resize(canvas, (size, size), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    return blurred(small, size / 90)


_SIGNS: dict[str, list[list[tuple[float, float]]]] = {
    "A": [[(0.0, 1.0), (0.3, 0.0), (0.6, 1.0)], [(0.12, 0.62), (0.48, 0.62)]],
    "7": [[(0.0, 0.0), (0.6, 0.0), (0.2, 1.0)]],
    "K": [[(0.0, 0.0), (0.0, 1.0)], [(0.6, 0.0), (0.0, 0.6)], [(0.2, 0.45), (0.6, 1.0)]],
    "2": [[(0.0, 0.2), (0.3, 0.0), (0.6, 0.25), (0.0, 1.0), (0.6, 1.0)]],
    "F": [[(0.6, 0.0), (0.0, 0.0), (0.0, 1.0)], [(0.0, 0.5), (0.45, 0.5)]],
    "4": [[(0.45, 1.0), (0.45, 0.0), (0.0, 0.7), (0.6, 0.7)]],
}
"""Strokes in a frame 0.6 wide and 1 high: our own, so that a texture does not depend on a font's version."""


def _ink(paint: NDArray[np.float32]) -> tuple[int, int, int]:
    r, g, b = np.rint(np.clip(paint, 0, 1) * 255).astype(int).tolist()
    return r, g, b


def _patch(
    canvas: NDArray[np.uint8], rng: np.random.Generator, kind: int, ink: tuple[int, int, int],
    at: NDArray[np.float64], reach: float,
) -> None:  # fmt: skip
    """A disc, a bar or a triangle."""
    if kind % 3 == 0:
        cv2.circle(canvas, (int(at[0]), int(at[1])), int(reach * 0.8), ink, -1, cv2.LINE_AA)
        return
    if kind % 3 == 1:
        corners = np.array([[-0.9, -0.45], [0.9, -0.45], [0.9, 0.45], [-0.9, 0.45]])
        a = rng.uniform(0, np.pi)
        corners = corners @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
    else:
        turn = rng.uniform(0, 2 * np.pi) + np.array([0, 2.2, 4.0])
        corners = np.stack([np.cos(turn), np.sin(turn)], -1)
    fixed = np.rint((at + reach * corners) * 2**_SHIFT).astype(np.int32)
    cv2.fillConvexPoly(canvas, fixed, ink, cv2.LINE_AA, _SHIFT)


def painted_box(rng: np.random.Generator, size: int, hue: float, labels: str = "A7K2F4") -> Image:
    """Atlas of a `Box`: six different faces."""
    hues = hue + np.array([0.0, 0.17, 0.42, 0.58, 0.75, 0.08])
    faces = [painted_face(rng, size, float(h), labels[k]) for k, h in enumerate(hues)]
    return np.concatenate([np.concatenate(faces[:3], 1), np.concatenate(faces[3:], 1)], 0)


def slab(top: Image) -> Image:
    """Atlas of a flat `Box`: the top, and plain sides and bottom."""
    side = np.broadcast_to(top.mean((0, 1)) * 0.8, top.shape)
    stripe = np.concatenate([side, side, side], 1)
    lower = np.concatenate([side, side, top], 1)
    return np.concatenate([stripe, lower], 0).astype(np.float32)


def patchwork(points: NDArray[np.float32], rng: np.random.Generator, cells: int, hue: float) -> Image:
    """Coloured, irregular cells with dark seams: a solid texture looked up at surface points (H, W, 3).

    Works on any solid, without seams of its own; the cells are about ``(area / cells) ** 0.5`` wide.
    """
    flat = points.reshape(-1, 3)
    seeds = flat[rng.choice(len(flat), cells, replace=False)]
    paints = np.array([colour(hue + rng.choice([0, 0.08, 0.35, 0.55]), *rng.uniform(0.25, 0.9, 2)) for _ in seeds])
    distance = np.linalg.norm(flat[:, None] - seeds[None], axis=-1)
    spread = 0.06 * float(np.median(np.sort(distance, 1)[:, 1]))
    weight = np.exp(-(distance - distance.min(1, keepdims=True)) / spread)
    weight /= weight.sum(1, keepdims=True)
    nearest, second = np.partition(distance, 1, axis=1)[:, :2].T
    seam = np.clip((second - nearest) / (5 * spread), 0.45, 1)[:, None]
    return (weight @ paints * seam).reshape(points.shape).astype(np.float32)


def surroundings(rng: np.random.Generator, sun: float, height: int = 256) -> Image:
    """Linear radiance (H, 2H, 3), latitude-longitude, z up: sky, a soft sun, hedges, ground."""
    shape = (height, 2 * height)
    elevation = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * np.pi
    azimuth = ((np.arange(2 * height) + 0.5) / (2 * height))[None] * 2 * np.pi
    clouds = noise(rng, shape, (4, 8), 3)[..., None]
    up = np.clip(elevation / 1.2, 0, 1)[..., None]
    sky = (1 - up) * np.array([0.72, 0.74, 0.78]) + up * np.array([0.42, 0.55, 0.78]) + 0.16 * clouds
    ground = np.array([0.27, 0.24, 0.20]) * (1 + 0.35 * noise(rng, shape, (6, 12), 2)[..., None])
    skyline = 0.12 + 0.09 * noise(rng, (1, 2 * height), (1, 10), 3)
    hedge = colour(0.3, 0.5, 0.3) * (1 + 0.4 * noise(rng, shape, (8, 16), 2)[..., None])
    hedge = hedge + 0.12 * noise(rng, (1, 2 * height), (1, 16), 1)[..., None] * np.array([1, 0.2, -0.4])
    blend = [1 / (1 + np.exp((elevation - level) / 0.02))[..., None] for level in (skyline, -0.12)]
    out = (1 - blend[0]) * sky + blend[0] * hedge
    out = (1 - blend[1]) * out + blend[1] * ground
    high, side = 0.95, 2.2  # where the sun stands, radians
    cosine = np.sin(elevation) * np.sin(high) + np.cos(elevation) * np.cos(high) * np.cos(azimuth - side)
    glow = sun * np.exp((cosine - 1) / (2 * 0.09**2))[..., None] * np.array([1.0, 0.93, 0.82])
    return (1.3 * (np.clip(out, 0.02, None) + glow)).astype(np.float32)
