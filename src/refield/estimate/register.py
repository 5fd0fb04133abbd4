"""Registering an object's coloured surface to the new photos over all rotations: candidates for its pose change.

Meant for objects with too little texture or too few pixels for matched features. A thousand starting rotations, all of
SO(3) and more finely those about the support's normal, each improved by two Gauss–Newton steps on blurred photos, and
the likelier ones by more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.align_kernels import NOT_SHOWN, register_all
from refield.estimate.look import Array, View
from refield.estimate.objects import Cloud, sides_of
from refield.estimate.past import Past
from refield.scene.pose import angle_between, rigid, transform
from refield.vision import pixels

_F64 = NDArray[np.float64]
_FIRST = 2  # Gauss–Newton steps of all starting poses
_LIKELY = 0.25  # of them go on


@dataclass(frozen=True)
class RegisterConfig:
    """How poses are searched."""

    rotations: int = 700
    """evenly over SO(3): about 24 degrees apart, within reach of the steps below on blurred photos"""
    turns: int = 36
    """about the support's normal, or the vertical of the cameras"""
    points: int = 350
    """of the cloud in the coarse search"""
    steps: int = 7
    """Gauss–Newton steps in the coarse search, of starting poses that are likely after the first ones"""
    keep: int = 24
    """best poses that go on to the fine search"""
    coarse_blur: float = 0.09
    """of the object's apparent diameter"""
    fine_blur: float = 0.03
    """of the object's apparent diameter"""
    places: int = 3
    """at which all rotations are tried: where turns about the support's normal, or guesses, fit best, then the first"""
    enough: float = 0.2
    """a score that turns about the support's normal, or a guess, reach; then no other rotation is tried"""
    cap: float = 0.25
    """colour distance (in [0, 1] RGB) at which a point counts as wrong"""


@dataclass(frozen=True)
class Candidate:
    """A possible pose change."""

    new_from_old: Tensor
    """(4, 4) float64"""
    score: float
    """0 is perfect; up to 0.7 is what it leaves uncovered of the target"""


@dataclass(frozen=True)
class Target:
    """Where to look for an object: where a point of it may be, and the pixels it should cover."""

    places: Array
    """(K, 3) world"""
    wanted: tuple[Array, ...]
    """per view (H, W): 1 should be covered, 0 may be, -1 must not be"""
    anchor: Array | None = None
    """(3,) the point of the old object, world, that may be at the places; None is the middle of its surface"""


def lens_of(view: View) -> _F64:
    """The numbers that `align_kernels` knows a view by, (26,)."""
    m = view.frame.world_from_cam.numpy()
    r = m[:3, :3].T
    c = view.camera
    out = np.zeros(26)
    out[:9], out[9:12] = r.ravel(), -r @ m[:3, 3]
    out[12:21] = c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.p1, c.p2, c.k3
    out[21], out[22], out[23:26] = c.height, c.width, m[:3, 3]
    return out


def super_fibonacci(count: int) -> _F64:
    """``count`` rotations spread evenly over SO(3), (count, 3, 3) (Alexa 2022, super-Fibonacci spirals)."""
    phi, psi = 2**0.5, 1.533751168755204288118041
    s = np.arange(count) + 0.5
    t, d = s / count, 2 * np.pi * s
    r, big = np.sqrt(t), np.sqrt(1 - t)
    a, b = d / phi, d / psi
    q = np.stack([r * np.sin(a), r * np.cos(a), big * np.sin(b), big * np.cos(b)], -1)
    return _matrices(q)


def _matrices(q: _F64) -> _F64:
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def turns_about(axis: Array, count: int) -> _F64:
    """``count`` even turns about an axis, (count, 3, 3), starting with none."""
    a = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    half = np.arange(count) * np.pi / count
    return _matrices(np.concatenate([np.cos(half)[:, None], np.sin(half)[:, None] * a], -1))


@dataclass(frozen=True)
class Stage:
    """The photos at one level of blur, ready for the kernels."""

    lenses: _F64
    images: Array
    """(V, H, W, 9): colour, then d/du and d/dv of each channel"""
    depths: Array
    """(V, H, W) of what stands there without the object"""


def stage(views: Sequence[View], depths: Sequence[Array], sigma_of: Sequence[float]) -> Stage:
    """Blur the photos, take their derivatives, pad to one size."""
    h, w = max(v.shape[0] for v in views), max(v.shape[1] for v in views)
    images = np.zeros((len(views), h, w, 9), np.float32)
    far = np.full((len(views), h, w), np.inf, np.float32)
    for k, (view, sigma) in enumerate(zip(views, sigma_of)):
        im = pixels.blur(view.photo, sigma)
        dv, du = np.gradient(im, axis=(0, 1))
        a, b = view.shape
        images[k, :a, :b, :3] = im
        images[k, :a, :b, 3::2], images[k, :a, :b, 4::2] = du, dv
        far[k, :a, :b] = depths[k]
    return Stage(np.stack([lens_of(v) for v in views]), images, far)


def register(
    cloud: Cloud,
    past: Sequence[Past],
    target: Target,
    up: Array,
    config: RegisterConfig = RegisterConfig(),
    extra: Sequence[Tensor] = (),
) -> list[Candidate]:
    """The poses at which the object's surface explains the photos best, best first; none where they show none of it.

    Args:
        up: the support's normal, about which objects most often turn.
        extra: ``new_from_old`` guesses from elsewhere (matched features), tried as they are.
    """
    middle = cloud.points.mean(0)
    radius = float(np.sqrt(((cloud.points - middle) ** 2).sum(-1).mean()))
    middle_of_all = target.places.mean(0)
    away = [max(float(np.linalg.norm(middle_of_all - p.view.centre)), 1e-6) for p in past]
    size = [2 * radius * p.view.camera.fx / d for p, d in zip(past, away)]
    search = _Search(cloud, past, target, middle, radius, size, config)
    turns, places = turns_about(up, config.turns), np.asarray(target.places, np.float64)
    anchor = middle if target.anchor is None else target.anchor
    aside = np.asarray(middle, np.float64) - anchor
    starts = [(turns, place + turns @ aside) for place in places]
    starts += [(g[None, :3, :3].numpy(), (g[:3, :3].numpy() @ middle + g[:3, 3].numpy())[None]) for g in extra]
    found = search.best(*(np.concatenate(part) for part in zip(*starts)))
    if found[0].score > config.enough:
        every = super_fibonacci(config.rotations)
        nearest = np.linalg.norm(places - _put(found, anchor)[:, None], axis=-1).argmin(-1)
        for start in list(dict.fromkeys([*nearest.tolist(), *range(len(places))]))[: config.places]:
            found += search.best(every, places[start] + every @ aside)
    rotations = np.stack([c.new_from_old[:3, :3].numpy() for c in found])
    scores = np.array([c.score for c in found])
    apart = search.distinct(rotations, _put(found, middle), scores, 8, 3.0)
    return [found[k] for k in apart if scores[k] < NOT_SHOWN]


def _put(found: Sequence[Candidate], point: Array) -> _F64:
    """Where each of N candidates puts a point (3,) of the object, (N, 3)."""
    poses = torch.stack([c.new_from_old for c in found])
    return np.asarray(transform(poses, torch.from_numpy(point).double()).numpy())


@dataclass(frozen=True)
class _Search:
    cloud: Cloud
    past: Sequence[Past]
    target: Target
    middle: Array
    radius: float
    size: Sequence[float]
    config: RegisterConfig

    def best(self, rotations: _F64, centres: _F64) -> list[Candidate]:
        """The best of some starting poses, improved coarse to fine, best first."""
        c = self.config
        rotations, centres = rotations.copy(), centres.copy()
        scores = self.run(rotations, centres, c.points, _FIRST, c.coarse_blur)
        likely = np.argsort(scores)[: max(c.keep, round(len(scores) * _LIKELY))]
        rotations, centres = rotations[likely], centres[likely]
        scores = self.run(rotations, centres, c.points, c.steps - _FIRST, c.coarse_blur)
        some = self.distinct(rotations, centres, scores, c.keep, 8.0)
        rotations, centres = rotations[some].copy(), centres[some].copy()
        self.run(rotations, centres, 2 * c.points, 10, 0.5 * (c.coarse_blur + c.fine_blur))
        scores = self.run(rotations, centres, len(self.cloud.points), 12, c.fine_blur)
        order = self.distinct(rotations, centres, scores, 8, 3.0)
        return [Candidate(_pose(rotations[k], centres[k], self.middle), float(scores[k])) for k in order]

    def distinct(self, rotations: _F64, centres: _F64, scores: _F64, count: int, apart: float) -> list[int]:
        """Indices of the best scores whose poses differ by more than ``apart`` degrees, or in place."""
        r = torch.from_numpy(rotations)
        chosen: list[int] = []
        for k in np.argsort(scores):
            near = [c for c in chosen if np.linalg.norm(centres[k] - centres[c]) < 0.5 * self.radius]
            if all(float(angle_between(r[k], r[c])) > apart for c in near):
                chosen.append(int(k))
            if len(chosen) == count:
                break
        return chosen

    def run(self, rotations: _F64, centres: _F64, count: int, steps: int, blur: float) -> _F64:
        """Improve the poses in place at one level of blur and score them."""
        sigma = [max(0.6, blur * s) for s in self.size]
        ready = stage([p.view for p in self.past], [p.depth for p in self.past], sigma)
        wanted = np.zeros(ready.depths.shape, np.float32)
        for k, w in enumerate(self.target.wanted):
            wanted[k, : w.shape[0], : w.shape[1]] = w
        boxes = np.array([pixels.bounding_box(w > 0) or (0, 0, 0, 0) for w in self.target.wanted], np.int64)
        pick = np.random.default_rng(0).permutation(len(self.cloud.points))[:count]
        points = np.concatenate([self.cloud.points[pick] - self.middle, self.cloud.normals[pick]], -1)
        # how many pixels apart the points of the visible half lie, for counting covered pixels
        block = int(np.clip(np.ceil(2.2 * max(self.size) / max(len(pick), 1) ** 0.5), 2, 12))
        return register_all(
            points.astype(np.float64),
            sides_of(self.cloud.normals[pick]),
            self.cloud.colours[pick],
            ready.lenses,
            ready.images,
            ready.depths,
            wanted,
            boxes,
            rotations,
            centres,
            steps,
            0.15,
            self.config.cap,
            self.radius,
            block,
        )


def _pose(rotation: _F64, centre: _F64, middle: Array) -> Tensor:
    r = torch.from_numpy(np.ascontiguousarray(rotation))
    return rigid(r, torch.from_numpy(centre - rotation @ np.asarray(middle, np.float64)))
