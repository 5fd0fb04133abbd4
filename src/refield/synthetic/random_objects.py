"""Objects drawn at random from a wide family, resting on z = 0.

`random_item` draws one. A family is a function of a random stream and the sides (x, y, z) of the box to fill, metres.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from refield.scene.pose import rigid
from refield.synthetic.compound import Compound, Part, Turn
from refield.synthetic.random_textures import PATTERNS, Pattern, atlas, draw_style
from refield.synthetic.shapes import Box, Cone, Cylinder, Solid
from refield.synthetic.solids import Convex, Ellipsoid, RoundedBox, prism
from refield.synthetic.state import Item

Sides = NDArray[np.float64]
"""(3,) metres"""
Family = Callable[[np.random.Generator, Sides], Solid]

_ROUND_STEPS = 20  # sides of a tube
_LETTERS: dict[str, list[tuple[float, float, float, float]]] = {
    "L": [(0, 0, 1, 0.25), (0, 0.25, 0.3, 1)],
    "T": [(0, 0.75, 1, 1), (0.36, 0, 0.64, 0.75)],
    "H": [(0, 0, 0.28, 1), (0.72, 0, 1, 1), (0.28, 0.38, 0.72, 0.62)],
    "E": [(0, 0, 0.28, 1), (0.28, 0, 1, 0.2), (0.28, 0.4, 0.85, 0.6), (0.28, 0.8, 1, 1)],
    "F": [(0, 0, 0.28, 1), (0.28, 0.4, 0.85, 0.6), (0.28, 0.8, 1, 1)],
    "U": [(0, 0, 0.28, 1), (0.72, 0, 1, 1), (0.28, 0, 0.72, 0.25)],
    "Z": [(0, 0, 1, 0.22), (0, 0.78, 1, 1), (0.36, 0.22, 0.64, 0.78)],
    "P": [(0, 0, 0.28, 1), (0.28, 0.8, 1, 1), (0.28, 0.4, 1, 0.6), (0.72, 0.6, 1, 0.8)],
}
"""Strokes (left, bottom, right, top) in a unit square; they touch and do not overlap."""


def random_item(
    rng: np.random.Generator,
    name: str,
    size: float,
    *,
    family: str | None = None,
    patterns: tuple[Pattern, ...] = PATTERNS,
) -> Item:
    """An object resting on z = 0 about the origin, its box's root mean square side ``size`` metres."""
    return drawn_item(rng, name, size, family=family, patterns=patterns)[0]


def drawn_item(
    rng: np.random.Generator,
    name: str,
    size: float,
    *,
    family: str | None = None,
    patterns: tuple[Pattern, ...] = PATTERNS,
) -> tuple[Item, str, Pattern]:
    """As `random_item`, and the names of its family and its pattern."""
    family = family or str(rng.choice(list(FAMILIES)))
    make, stretch = FAMILIES[family]
    sides = np.exp(rng.uniform(-1, 1, 3) * np.log(stretch))
    solid = make(rng, size * sides / np.sqrt(np.mean(sides**2)))
    style = draw_style(rng, patterns)
    roughness = float(rng.choice([0.1, 0.2, 0.35]))
    pose = rigid(torch.eye(3, dtype=torch.float64), torch.tensor([0, 0, -lowest(solid)], dtype=torch.float64))
    texture = atlas(rng, solid, style)
    return Item(name, solid, texture, pose, glossy=bool(rng.random() < 0.4), roughness=roughness), family, style.pattern


def lowest(solid: Solid, turn: NDArray[np.float64] | None = None) -> float:
    """z of the lowest place of a solid turned by (3, 3), its middle at the origin."""
    vertices = solid.mesh()[0].astype(float)
    return float((vertices if turn is None else vertices @ turn.T)[:, 2].min())


def round_about_z(solid: Solid) -> bool:
    """Whether turning it about its own upright leaves its shape."""
    if isinstance(solid, Ellipsoid):
        return bool(np.isclose(solid.half[0], solid.half[1]))
    return isinstance(solid, Cylinder | Cone)


def _box(rng: np.random.Generator, sides: Sides) -> Solid:
    return Box(_half(sides))


def _book(rng: np.random.Generator, sides: Sides) -> Solid:
    thin = sides * np.array([1.15, 1.15, 1.15])
    thin[int(rng.integers(3))] *= rng.uniform(0.12, 0.25)
    return Box(_half(thin))


def _rounded(rng: np.random.Generator, sides: Sides) -> Solid:
    return RoundedBox(_half(sides), float(rng.uniform(0.15, 0.9) * sides.min() / 2))


def _ball(rng: np.random.Generator, sides: Sides) -> Solid:
    return Ellipsoid(_half(np.full(3, np.sqrt(np.mean(sides**2)))))


def _egg(rng: np.random.Generator, sides: Sides) -> Solid:
    return Ellipsoid(_half(sides))


def _can(rng: np.random.Generator, sides: Sides) -> Solid:
    return Cylinder(float(sides[:2].mean() / 2), float(sides[2]))


def _pole(rng: np.random.Generator, sides: Sides) -> Solid:
    return Cylinder(float(sides[0] * rng.uniform(0.12, 0.2)), float(1.4 * sides[2]))


def _cone(rng: np.random.Generator, sides: Sides) -> Solid:
    return Cone(float(sides[:2].mean() / 2), float(sides[2]))


def _outline(rng: np.random.Generator, sides: Sides, count: int) -> list[tuple[float, float]]:
    angle = 2 * np.pi * (np.arange(count) + rng.uniform(0, 1)) / count
    return [(float(sides[0] / 2 * np.cos(a)), float(sides[1] / 2 * np.sin(a))) for a in angle]


def _prism(rng: np.random.Generator, sides: Sides) -> Solid:
    return prism(_outline(rng, sides, int(rng.integers(3, 9))), float(sides[2]))


def _tapered(rng: np.random.Generator, sides: Sides) -> Solid:
    return prism(_outline(rng, sides, int(rng.integers(4, 9))), float(sides[2]), float(rng.uniform(0.3, 0.8)))


def _pyramid(rng: np.random.Generator, sides: Sides) -> Solid:
    return prism(_outline(rng, sides, int(rng.integers(3, 6))), float(sides[2]), 0.0)


def _wedge(rng: np.random.Generator, sides: Sides) -> Solid:
    x, y, z = sides / 2
    low, ridge = [[-x, -y, -z], [x, -y, -z], [x, y, -z], [-x, y, -z]], float(rng.uniform(-1, 1) * x)
    return Convex.of(np.array([*low, [ridge, -y, z], [ridge, y, z]]))


def _stone(rng: np.random.Generator, sides: Sides) -> Solid:
    out = rng.normal(size=(int(rng.integers(12, 24)), 3))
    out *= rng.uniform(0.85, 1.0, (len(out), 1)) / np.linalg.norm(out, axis=1, keepdims=True) * sides / 2
    out[:, 2] = np.maximum(out[:, 2], -0.6 * sides[2] / 2)
    foot = [(x, y, -0.3 * float(sides[2])) for x, y in _outline(rng, 0.7 * sides, 5)]
    return Convex.of(np.concatenate([out, foot]))


def _letter(rng: np.random.Generator, sides: Sides) -> Solid:
    wide, thick, high = sides * np.array([1.1, rng.uniform(0.25, 0.5), 1.2])
    strokes = _LETTERS[str(rng.choice(list(_LETTERS)))]
    return Compound.of([_block((a * wide, 0, b * high), (c * wide, thick, d * high)) for a, b, c, d in strokes])


def _block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Part:
    a, b = np.array(low, float), np.array(high, float)
    middle = (a + b) / 2
    return Part(Box(_half(b - a)), (float(middle[0]), float(middle[1]), float(middle[2])))


def _open_box(rng: np.random.Generator, sides: Sides) -> Solid:
    x, y, z = (float(s) for s in sides)
    w = float(rng.uniform(0.05, 0.1)) * min(x, y)
    return Compound.of(
        [
            _block((0, 0, 0), (x, y, w)),
            _block((0, 0, w), (w, y, z)),
            _block((x - w, 0, w), (x, y, z)),
            _block((w, 0, w), (x - w, w, z)),
            _block((w, y - w, w), (x - w, y, z)),
        ]
    )


def _ring(radius: float, thickness: float, height: float, z: float = 0.0) -> list[Part]:
    """A tube of wedge-shaped staves."""
    angle = 2 * np.pi * np.arange(_ROUND_STEPS + 1) / _ROUND_STEPS
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    parts = []
    for a, b in pairwise(circle):
        flat = np.array([a * radius, b * radius, b * (radius - thickness), a * (radius - thickness)])
        middle = (flat.min(0) + flat.max(0)) / 2
        stave = prism([(float(x), float(y)) for x, y in flat], height)
        parts.append(Part(stave, (float(middle[0]), float(middle[1]), z + height / 2)))
    return parts


def _tube(rng: np.random.Generator, sides: Sides) -> Solid:
    radius = float(sides[:2].mean() / 2)
    return Compound.of(_ring(radius, radius * float(rng.uniform(0.12, 0.3)), float(sides[2])))


def _mug(rng: np.random.Generator, sides: Sides) -> Solid:
    radius, high = float(0.45 * sides[:2].mean()), float(sides[2])
    wall = 0.12 * radius
    bottom = Part(Cylinder(radius - wall, 0.1 * high), (0.0, 0.0, 0.05 * high))
    out, thick = radius * 1.45, 0.12 * radius
    handle = [
        _block((radius * 0.97, -thick, 0.7 * high), (out, thick, 0.8 * high)),
        _block((radius * 0.97, -thick, 0.2 * high), (out, thick, 0.3 * high)),
        _block((out - 2 * thick, -thick, 0.3 * high), (out, thick, 0.7 * high)),
    ]
    return Compound.of([*_ring(radius, wall, high), bottom, *handle])


def _stool(rng: np.random.Generator, sides: Sides) -> Solid:
    return Compound.of(table_parts(sides, float(rng.uniform(0.08, 0.16)), float(rng.uniform(0.1, 0.18))))


def table_parts(sides: Sides, top: float, leg: float) -> list[Part]:
    """A table in (0, 0, 0) .. sides: a top that is ``top`` of the height, legs ``leg`` of the shorter side."""
    x, y, z = (float(s) for s in sides)
    w, under = leg * min(x, y), z * (1 - top)
    corners = [(0.0, 0.0), (x - w, 0.0), (x - w, y - w), (0.0, y - w)]
    return [_block((0, 0, under), (x, y, z)), *(_block((a, b, 0), (a + w, b + w, under)) for a, b in corners)]


def _chair(rng: np.random.Generator, sides: Sides) -> Solid:
    x, y, z = (float(s) for s in sides * np.array([0.8, 0.8, 1.2]))
    seat = float(rng.uniform(0.4, 0.55)) * z
    back = float(rng.uniform(0.1, 0.18)) * y
    return Compound.of([*table_parts(np.array([x, y, seat]), 0.2, 0.16), _block((0, y - back, seat), (x, y, z))])


def _house(rng: np.random.Generator, sides: Sides) -> Solid:
    x, y, z = (float(s) for s in sides)
    eaves = z * float(rng.uniform(0.45, 0.65))
    roof = np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0], [0, y / 2, z - eaves], [x, y / 2, z - eaves]])
    middle = (x / 2, y / 2, (z + eaves) / 2)
    return Compound.of([_block((0, 0, 0), (x, y, eaves)), Part(Convex.of(roof), middle)])


def _car(rng: np.random.Generator, sides: Sides) -> Solid:
    x, y, z = (float(s) for s in sides * np.array([1.4, 0.8, 0.7]))
    wheel, wide = 0.25 * z, 0.08 * y
    lying: Turn = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
    at = [(a * x, b, wheel) for a in (0.22, 0.78) for b in (-wide / 2, y + wide / 2)]
    wheels = [Part(Cylinder(wheel, wide), place, lying) for place in at]
    cabin = prism([(0, 0), (0.55 * x, 0), (0.55 * x, 0.9 * y), (0, 0.9 * y)], 0.42 * z, 0.75)
    return Compound.of([_block((0, 0, 0.2 * z), (x, y, 0.58 * z)), Part(cabin, (0.45 * x, y / 2, 0.79 * z)), *wheels])


def _bottle(rng: np.random.Generator, sides: Sides) -> Solid:
    radius, high = float(0.3 * sides[:2].mean()), float(1.3 * sides[2])
    body, neck = high * float(rng.uniform(0.5, 0.65)), radius * float(rng.uniform(0.3, 0.5))
    angle = 2 * np.pi * np.arange(16) / 16
    outline = [(float(radius * np.cos(a)), float(radius * np.sin(a))) for a in angle]
    shoulder = prism(outline, 0.15 * high, neck / radius)
    rest = 0.85 * high - body
    return Compound.of(
        [
            Part(Cylinder(radius, body), (0.0, 0.0, body / 2)),
            Part(shoulder, (0.0, 0.0, body + 0.075 * high)),
            Part(Cylinder(neck, rest), (0.0, 0.0, body + 0.15 * high + rest / 2)),
        ]
    )


def _lamp(rng: np.random.Generator, sides: Sides) -> Solid:
    wide, high = float(sides[:2].mean()), float(1.25 * sides[2])
    foot, shade = 0.06 * high, 0.32 * high
    angle = 2 * np.pi * np.arange(12) / 12
    outline = [(float(0.42 * wide * np.cos(a)), float(0.42 * wide * np.sin(a))) for a in angle]
    return Compound.of(
        [
            Part(Cylinder(0.32 * wide, foot), (0.0, 0.0, foot / 2)),
            Part(Cylinder(0.06 * wide, high - shade - foot), (0.0, 0.0, (high - shade + foot) / 2)),
            Part(prism(outline, shade, float(rng.uniform(0.4, 0.8))), (0.0, 0.0, high - shade / 2)),
        ]
    )


def _figure(rng: np.random.Generator, sides: Sides) -> Solid:
    """A ball on a rounded body."""
    x, y, z = (float(s) for s in sides)
    body, head = 0.65 * z, 0.42 * z
    torso = RoundedBox(_half(np.array([x, y, body])), 0.4 * min(x, y, body) / 2)
    top = body + 0.42 * head
    return Compound.of([Part(torso, (0.0, 0.0, body / 2)), Part(Ellipsoid(_half(np.full(3, head))), (0.0, 0.0, top))])


def _plant(rng: np.random.Generator, sides: Sides) -> Solid:
    """A pot with many bent blades."""
    wide, high = float(sides[:2].mean()), float(1.2 * sides[2])
    pot_high, pot = 0.35 * high, 0.3 * wide
    angle = 2 * np.pi * np.arange(10) / 10
    outline = [(float(pot * np.cos(a)), float(pot * np.sin(a))) for a in angle]
    parts = [Part(prism(outline, pot_high, 1.0), (0.0, 0.0, pot_high / 2), cell=0)]
    for k in range(int(rng.integers(10, 36))):
        turn = float(rng.uniform(0, 2 * np.pi))
        foot = rng.uniform(0.2, 0.6) * pot * np.array([np.cos(turn), np.sin(turn), 0.0])
        foot[2] = 0.97 * pot_high
        parts += _blade(rng, foot, turn, high - pot_high, wide, 1 + k % 3)
    return Compound.of(parts, shared=True)


def _blade(
    rng: np.random.Generator, foot: NDArray[np.float64], turn: float, high: float, wide: float, cell: int
) -> list[Part]:
    """Two flat pieces, the outer one leaning further out."""
    lean, length = float(rng.uniform(0.05, 0.45)), high * float(rng.uniform(0.6, 1.0))
    width = wide * float(rng.uniform(0.06, 0.14))
    thin = 0.25 * width
    parts, at = [], foot
    for share, narrow, more in ((0.55, 1.0, 0.0), (0.5, 0.65, float(rng.uniform(0.2, 0.8)))):
        angle = lean + more
        up = np.array([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
        across = np.array([-np.sin(turn), np.cos(turn), 0.0])
        out = np.cross(across, up)
        half = (width * narrow / 2, thin / 2, share * length / 2)
        middle = at + share * length / 2 * up
        rows = np.stack([across, -out, up], -1)
        parts.append(Part(Box(half), _point(middle), (_point(rows[0]), _point(rows[1]), _point(rows[2])), cell))
        at = at + 0.97 * share * length * up
    return parts


def _tree(rng: np.random.Generator, sides: Sides) -> Solid:
    wide, high = float(sides[:2].mean()), float(1.3 * sides[2])
    parts = [Part(Cylinder(0.08 * wide, 0.6 * high), (0.0, 0.0, 0.3 * high))]
    for _ in range(int(rng.integers(3, 8))):
        at = rng.uniform(-0.22, 0.22, 3) * np.array([wide, wide, high]) + np.array([0, 0, 0.7 * high])
        parts.append(Part(Ellipsoid(_half(wide * rng.uniform(0.35, 0.6, 3))), _point(at)))
    return Compound.of(parts)


def _heap(rng: np.random.Generator, sides: Sides) -> Solid:
    """Books, one on the other, glued."""
    parts, z = [], 0.0
    for _ in range(int(rng.integers(2, 5))):
        own = sides * np.array([*rng.uniform(0.75, 1.0, 2), rng.uniform(0.15, 0.35)])
        turn = float(rng.uniform(-0.4, 0.4))
        rows: Turn = (
            (float(np.cos(turn)), -float(np.sin(turn)), 0.0),
            (float(np.sin(turn)), float(np.cos(turn)), 0.0),
            (0.0, 0.0, 1.0),
        )
        parts.append(Part(Box(_half(own)), (0.0, 0.0, z + float(own[2]) / 2), rows))
        z += float(own[2])
    return Compound.of(parts)


def _half(sides: NDArray[np.float64]) -> tuple[float, float, float]:
    return (float(sides[0]) / 2, float(sides[1]) / 2, float(sides[2]) / 2)


def _point(x: NDArray[np.float64]) -> tuple[float, float, float]:
    return (float(x[0]), float(x[1]), float(x[2]))


FAMILIES: dict[str, tuple[Family, float]] = {
    "box": (_box, 1.8),
    "book": (_book, 1.3),
    "rounded": (_rounded, 1.6),
    "ball": (_ball, 1.0),
    "egg": (_egg, 1.5),
    "can": (_can, 1.6),
    "pole": (_pole, 1.2),
    "cone": (_cone, 1.3),
    "prism": (_prism, 1.5),
    "tapered": (_tapered, 1.5),
    "pyramid": (_pyramid, 1.4),
    "wedge": (_wedge, 1.4),
    "stone": (_stone, 1.4),
    "letter": (_letter, 1.2),
    "open_box": (_open_box, 1.4),
    "tube": (_tube, 1.5),
    "mug": (_mug, 1.2),
    "stool": (_stool, 1.3),
    "chair": (_chair, 1.1),
    "house": (_house, 1.3),
    "car": (_car, 1.1),
    "bottle": (_bottle, 1.1),
    "lamp": (_lamp, 1.2),
    "figure": (_figure, 1.3),
    "plant": (_plant, 1.1),
    "tree": (_tree, 1.1),
    "heap": (_heap, 1.2),
}
"""Name → the family, and by what factor its sides may differ from the mean."""
