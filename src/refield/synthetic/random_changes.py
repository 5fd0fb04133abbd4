"""Where objects stand, and how they change: rested on what supports them, moved, turned, tipped, stacked, swapped.

Everything random is drawn from the stream that is given; what does not fit is None, and drawn anew by the caller.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from refield.scene.pose import rigid
from refield.synthetic.shapes import Solid
from refield.synthetic.solids import Ellipsoid, hull_faces
from refield.synthetic.state import Item

_CLEAR = 0.0005  # metres between an object and what it rests on
GAP = 0.004
"""metres at least between objects beside each other"""
_SAMPLES = 600  # points of a surface that are held against another solid
_SHARE = 0.02  # of a hull's surface, at least, that a face must have to be stood on
_FLAT = 1e-4  # parts of a hull's size, and radians: what is one face
_MANY = 1200  # vertices
Matrix = NDArray[np.float64]


class Support(Protocol):
    """What objects stand on: `random_places.Patch`, or another object's `Top`."""

    @property
    def low(self) -> tuple[float, float]: ...
    @property
    def high(self) -> tuple[float, float]: ...
    def heights(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]: ...
    def normal(self, x: float, y: float) -> NDArray[np.float64]: ...


@dataclass(frozen=True)
class Top:
    """The level top of an object."""

    low: tuple[float, float]
    high: tuple[float, float]
    z: float

    def heights(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.full(np.shape(x), self.z)

    def normal(self, x: float, y: float) -> NDArray[np.float64]:
        return np.array([0.0, 0.0, 1.0])


@lru_cache(maxsize=64)
def surface(solid: Solid) -> Matrix:
    """Points (N, 3) on a solid: some of its mesh's vertices, and more spread over its triangles."""
    vertices, _, faces = solid.mesh()
    corners = vertices.astype(float)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    rng = np.random.default_rng(0)
    chosen = corners[rng.choice(len(corners), _SAMPLES, p=area / area.sum())]
    weights = rng.dirichlet(np.ones(3), _SAMPLES)
    spread = np.einsum("nk,nkc->nc", weights, chosen)
    return np.concatenate([spread, vertices[:: max(len(vertices) // _SAMPLES, 1)].astype(float)])


@lru_cache(maxsize=64)
def vertices_of(solid: Solid) -> Matrix:
    """(V, 3) of its mesh."""
    return solid.mesh()[0].astype(float)


def rotation(item: Item) -> Matrix:
    return item.world_from_item[:3, :3].numpy()


def extent(item: Item) -> Matrix:
    """(2, 3): the world box around its mesh."""
    x = vertices_of(item.solid) @ rotation(item).T + item.world_from_item[:3, 3].numpy()
    return np.stack([x.min(0), x.max(0)])


def about_z(angle: float) -> Matrix:
    """Turned by so many radians about the upright."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def carrying(a: Matrix, b: Matrix) -> Matrix:
    """The least rotation that takes unit vector a to b."""
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-9:  # opposite: half a turn about anything across
        across = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        across /= np.linalg.norm(across)
        return 2 * np.outer(across, across) - np.eye(3)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + k + k @ k / (1 + cosine)


def placed_on(item: Item, support: Support, spot: tuple[float, float], turn: Matrix) -> Item:
    """Turned by (3, 3) from its own axes, leaning with the ground, and let down at (x, y) until it touches."""
    x, y = spot
    whole = carrying(np.array([0.0, 0.0, 1.0]), support.normal(x, y)) @ turn
    vertices = vertices_of(item.solid) @ whole.T
    heights = support.heights(vertices[:, 0] + x, vertices[:, 1] + y)
    z = float((heights - vertices[:, 2]).max()) + _CLEAR
    pose = rigid(torch.from_numpy(whole), torch.tensor([x, y, z], dtype=torch.float64))
    return replace(item, world_from_item=pose)


def rested(rng: np.random.Generator, item: Item, support: Support, turn: Matrix | None = None) -> Item | None:
    """Somewhere on a support, turned at random about the upright after ``turn`` (3, 3); None where it is too small."""
    whole = about_z(float(rng.uniform(0, 2 * np.pi))) @ (np.eye(3) if turn is None else turn)
    around = np.abs((vertices_of(item.solid) @ whole.T)[:, :2]).max(0)
    low, high = np.array(support.low) + around, np.array(support.high) - around
    part = rng.uniform(0, 1, 2)
    if (low > high).any():
        return None
    x, y = (low + part * (high - low)).tolist()
    return placed_on(item, support, (x, y), whole)


def apart(item: Item, others: Iterable[Item], gap: float = GAP) -> bool:
    """Whether it keeps clear of the others: no sampled place of a surface lies in or near another solid."""
    box = extent(item)
    own = torch.from_numpy(_world(item))
    for other in others:
        theirs = extent(other)
        if (theirs[0] > box[1] + gap).any() or (theirs[1] < box[0] - gap).any():
            continue
        if (other.distance(own) < gap * _beside(item, other)).any():
            return False
        points = _world(other)
        near = points[((points > box[0] - gap) & (points < box[1] + gap)).all(-1)]
        if len(near) and (item.distance(torch.from_numpy(near)) < gap * _beside(item, other)).any():
            return False
    return True


def _beside(item: Item, other: Item) -> float:
    """0 where one stands on the other, which may touch; else 1."""
    a, b = extent(item), extent(other)
    on = float(a[0, 2]) > float(b[1, 2]) - 2 * _CLEAR or float(b[0, 2]) > float(a[1, 2]) - 2 * _CLEAR
    return 0.0 if on else 1.0


def _world(item: Item) -> Matrix:
    return surface(item.solid) @ rotation(item).T + item.world_from_item[:3, 3].numpy()


@lru_cache(maxsize=64)
def stable_turns(solid: Solid) -> tuple[Matrix, ...]:
    """Rotations (3, 3) that stand a solid on a face of its hull over which its middle lies; the largest face first."""
    if isinstance(solid, Ellipsoid):
        return ()
    vertices = vertices_of(solid)
    if len(vertices) > _MANY:  # a round one: the outermost of it in many directions
        ways = np.random.default_rng(0).normal(size=(_MANY, 3))
        ways = np.concatenate([ways, np.eye(3), -np.eye(3)])
        vertices = vertices[np.unique((ways @ vertices.T).argmax(1))]
    middle = surface(solid).mean(0)
    found: list[tuple[float, Matrix]] = []
    total = 0.0
    for face in hull_faces(vertices, _FLAT):
        flat = (face.corners - middle) @ face.axes.T
        after = np.roll(flat, -1, axis=0)
        cross = flat[:, 0] * after[:, 1] - flat[:, 1] * after[:, 0]
        area = abs(float(cross.sum())) / 2
        total += area
        length = np.linalg.norm(after - flat, axis=1)
        inside = bool((cross > 0.02 * length * np.sqrt(area)).all())
        if inside:
            found.append((area, carrying(face.normal, np.array([0.0, 0.0, -1.0]))))
    found.sort(key=lambda pair: -pair[0])
    return tuple(turn for area, turn in found if area > _SHARE * total)


def other_face(rng: np.random.Generator, item: Item) -> Matrix | None:
    """A rotation that stands it on another face than now, at least 40 degrees away; None if it has none."""
    up_now = rotation(item).T @ np.array([0.0, 0.0, 1.0])
    turns = [t for t in stable_turns(item.solid) if (t.T @ np.array([0.0, 0.0, 1.0])) @ up_now < np.cos(np.deg2rad(40))]
    return turns[int(rng.integers(len(turns)))] if turns else None


def top_of(item: Item) -> Top | None:
    """A level rectangle on top of an object; None if it has none of three tenths of its width."""
    vertices = vertices_of(item.solid) @ rotation(item).T + item.world_from_item[:3, 3].numpy()
    highest = float(vertices[:, 2].max())
    on = vertices[vertices[:, 2] > highest - 1e-5]
    flat = surface(item.solid) @ rotation(item).T + item.world_from_item[:3, 3].numpy()
    level = flat[flat[:, 2] > highest - 1e-5]
    if len(on) < 3 or len(level) < 12:
        return None
    middle = level[:, :2].mean(0)
    # the largest centred square that the samples of the top fill
    out = np.abs(on[:, :2] - middle).max(0)
    if (out < 1e-6).any():  # a point, an edge
        return None
    part = min(0.7, 0.7 * float(np.sqrt(len(np.unique((4 * (level[:, :2] - middle) / out).round(), axis=0)) / 60)))
    low, high = middle - part * out, middle + part * out
    wide = np.ptp(vertices[:, :2], axis=0)
    if (2 * part * out < 0.3 * wide).any():
        return None
    return Top((float(low[0]), float(low[1])), (float(high[0]), float(high[1])), highest)


def stacked(rng: np.random.Generator, item: Item, below: Item) -> Item | None:
    """Standing on another object, as it stands now but turned; None where that has no top for it."""
    top = top_of(below)
    if top is None:
        return None
    whole = about_z(float(rng.uniform(0, 2 * np.pi))) @ upright(item)
    vertices = vertices_of(item.solid) @ whole.T
    foot = vertices[vertices[:, 2] < vertices[:, 2].min() + 1e-3 * np.ptp(vertices[:, 2])]
    half = np.abs(foot[:, :2]).max(0)
    low, high = np.array(top.low), np.array(top.high)
    if (half > 0.75 * (high - low)).any():  # what stands over the edge by more would fall
        return None
    middle = (low + high) / 2
    return placed_on(item, top, (float(middle[0]), float(middle[1])), whole)


def upright(item: Item) -> Matrix:
    """Its rotation, less the lean of sloping ground: which of its faces it stands on."""
    now = rotation(item)
    up = now.T @ np.array([0.0, 0.0, 1.0])
    faces = [t.T @ np.array([0.0, 0.0, 1.0]) for t in stable_turns(item.solid)] + list(np.eye(3)) + list(-np.eye(3))
    nearest = max(faces, key=lambda face: float(face @ up))
    return carrying(now @ nearest, np.array([0.0, 0.0, 1.0])) @ now


def moved_enough(old: Item, new: Item) -> bool:
    """By a third of its size, or turned by 20 degrees."""
    shift = float((new.world_from_item[:3, 3] - old.world_from_item[:3, 3]).norm())
    turn = (np.trace(rotation(new) @ rotation(old).T) - 1) / 2
    size = 2 * float(np.sqrt(np.mean(np.square(old.solid.half))))
    return shift >= size / 3 or bool(turn < np.cos(np.deg2rad(20)))


def all_apart(items: Sequence[Item], fixed: Sequence[Item]) -> bool:
    """Whether objects keep clear of each other and of what stays."""
    return all(apart(item, [*items[:i], *fixed]) for i, item in enumerate(items))
