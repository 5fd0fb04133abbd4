"""Camera paths for pictures that nobody took: around what the photos look at, through keyframes, through the photos.

Facts about cameras alone: what the field shows on the way is not asked here.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import astuple, fields
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor
from torch.nn.functional import normalize

from refield.scene.camera import Camera
from refield.scene.capture import Frame, centres
from refield.scene.pose import rigid
from refield.scene.world import looked_at

SPREADS = (40.0, 20.0, 10.0, 5.0)
"""degrees within which `orbit` joins the photos' places to one: the wider, the smoother; the narrower, the closer to
where photographers stood"""
_AROUND = math.pi / 2  # a wider gap between the photos is not crossed
_INWARD = 0.3  # mean cosine to the focus above which photos look at it, and not around
_STEEPEST = math.radians(80)  # straight down there is no way to turn
_FINE = 32  # places at which the length of a part of a path is measured
_TOUR, _MOST_PHOTOS = 24, 400
_KEPT_ORDER = 1.5  # times the shortest tour that was found


def typical_camera(frames: Sequence[Frame]) -> Camera:
    """Size and focal length as most photos have them, without distortion."""
    size, _ = Counter((f.camera.width, f.camera.height) for f in frames).most_common(1)[0]
    alike = [f.camera for f in frames if (f.camera.width, f.camera.height) == size]
    fx, fy = (sorted(getattr(c, k) for c in alike)[len(alike) // 2] for k in ("fx", "fy"))
    return Camera(*size, fx, fy, size[0] / 2, size[1] / 2)


def orbit(frames: Sequence[Frame], up: Tensor, count: int, spread: float = SPREADS[0]) -> list[Tensor]:
    """``count`` poses world_from_cam (4, 4) around what the photos look at, upright and in a loop.

    Each is as far from it and as high as the photos on that side are, weighted over ``spread`` degrees. Where a quarter
    or more of the way round has no photos, the path swings to and fro in front of the rest. Photos that look around
    instead of at something are followed from among their places, looking outwards.
    """
    at = centres(frames)
    forward = torch.stack([f.world_from_cam[:3, 2] for f in frames])
    focus = looked_at(at, forward)
    up = normalize(up.to(at), dim=0)
    plane = torch.linalg.svd(up[None]).Vh[1:]
    if torch.linalg.det(torch.cat([plane, up[None]])) < 0:
        plane = plane.flip(0)
    inward = bool((normalize(focus - at, dim=1) * forward).sum(1).mean() > _INWARD)
    way = at - focus if inward else forward
    distance = way.norm(dim=1).clamp_min(1e-12)
    high = (way @ up / distance).clamp(-1, 1).asin().clamp(-_STEEPEST, _STEEPEST)
    side = torch.atan2(way @ plane[1], way @ plane[0])
    turn = _turns(side, count)
    # those who look down from above stand on no side
    near = (torch.cos(turn[:, None] - side) - 1) / math.radians(spread) ** 2 + high.cos().log()
    part = near.softmax(1)
    climb = part @ high
    flat = turn.cos()[:, None] * plane[0] + turn.sin()[:, None] * plane[1]
    out = climb.cos()[:, None] * flat + climb.sin()[:, None] * up
    if inward:
        eyes, looks = focus + (part @ distance.log()).exp()[:, None] * out, -out
    else:
        eyes, looks = part @ at, out
    return [_upright(eye, look, up) for eye, look in zip(eyes, looks)]


def _turns(side: Tensor, count: int) -> Tensor:
    """(count,) radians: all the way round from the first photo's side; to and fro where photos leave a wide gap."""
    step = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    order = side.sort().values
    gaps = torch.cat([order[1:], order[:1] + 2 * math.pi]) - order
    widest = int(gaps.argmax())
    if gaps[widest] < _AROUND:
        return side[0] + step
    half = math.pi - gaps[widest] / 2
    return order[(widest + 1) % len(order)] + half * (1 + step.sin())


def _upright(eye: Tensor, look: Tensor, up: Tensor) -> Tensor:
    right = normalize(torch.linalg.cross(look, up), dim=0)
    return rigid(torch.stack([right, torch.linalg.cross(look, right), look], -1), eye)


def smooth_path(keyframes: Sequence[Frame], count: int) -> list[tuple[Camera, Tensor]]:
    """``count`` cameras and poses world_from_cam on a smooth path through all keyframes, at an even pace.

    Positions lie on a centripetal Catmull-Rom curve, rotations on a cubic spline. The keyframes themselves are on it
    (where there are fewer pictures than keyframes, some). All have the size of the first; lenses that differ go over
    into each other.
    """
    keyframes = [k for i, k in enumerate(keyframes) if i == 0 or not _same(k, keyframes[i - 1])]
    first = keyframes[0]
    if len(keyframes) == 1:
        return [(first.camera, first.world_from_cam)] * count
    at = centres(keyframes).numpy()
    turns = Rotation.from_matrix(np.stack([k.world_from_cam[:3, :3].numpy() for k in keyframes]))
    size = float(np.ptp(at, axis=0).max()) or 1.0
    knots = np.concatenate([[0.0], np.cumsum(np.sqrt(_travel(at, turns, size)))])
    place, turn = CubicHermiteSpline(knots, at, _tangents(knots, at)), RotationSpline(knots, turns)
    fine = np.concatenate([np.linspace(a, b, _FINE, endpoint=False) for a, b in pairwise(knots)] + [knots[-1:]])
    length = np.concatenate([[0.0], np.cumsum(_travel(place(fine), turn(fine), size))])
    lenses = [_lens(k.camera, first.camera) for k in keyframes]
    parts, along = _paced(length[::_FINE], count)
    ends = np.minimum(parts + 1, len(keyframes) - 1)
    goal = (1 - along) * length[::_FINE][parts] + along * length[::_FINE][ends]
    now = np.interp(goal, length, fine)
    poses = rigid(torch.from_numpy(turn(now).as_matrix()), torch.from_numpy(place(now)))
    out = []
    for i, j, u, pose in zip(parts, ends, along, poses):
        lens = _camera((1 - u) * lenses[i] + u * lenses[j], first.camera)
        out.append((lens, pose if u else keyframes[i].world_from_cam))
    return out


def _same(a: Frame, b: Frame) -> bool:
    return bool(torch.allclose(a.world_from_cam, b.world_from_cam, rtol=0, atol=1e-9))


def _travel(at: NDArray[np.float64], turns: Rotation, size: float) -> NDArray[np.float64]:
    """How far it is from each pose to the next: the distance as a part of ``size`` and the angle together."""
    return np.linalg.norm(np.diff(at, axis=0), axis=1) / size + (turns[:-1].inv() * turns[1:]).magnitude()


def _tangents(knots: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those of the Catmull-Rom curve with these knots; at the ends it does not bend."""
    step = np.diff(knots)[:, None]
    slope = np.diff(at, axis=0) / step
    if len(at) == 2:
        return np.concatenate([slope, slope])
    across = (at[2:] - at[:-2]) / (step[:-1] + step[1:])
    inner = slope[:-1] - across + slope[1:]
    return np.concatenate([(3 * slope[:1] - inner[:1]) / 2, inner, (3 * slope[-1:] - inner[-1:]) / 2])


def _paced(length: NDArray[np.float64], count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """For each picture the part of the path it is on, (count,), and how far along that part; keyframes fall on
    pictures."""
    picture = np.rint(length / length[-1] * max(count - 1, 1)).astype(np.int64)
    n = np.arange(count)
    part = np.searchsorted(picture, n, side="right") - 1
    span = np.append(np.diff(picture), 1)[part]
    return part, (n - picture[part]) / span


_LENS = tuple(f.name for f in fields(Camera))[2:]


def _lens(camera: Camera, like: Camera) -> NDArray[np.float64]:
    """Its intrinsics on a sensor of another size, the principal point from the middle."""
    scale = max(like.width, like.height) / max(camera.width, camera.height)
    fx, fy, cx, cy, *distortion = astuple(camera)[2:]
    return np.array(
        [fx * scale, fy * scale, (cx - camera.width / 2) * scale, (cy - camera.height / 2) * scale, *distortion]
    )


def _camera(lens: NDArray[np.float64], like: Camera) -> Camera:
    values = dict(zip(_LENS, lens.tolist()))
    values["cx"] += like.width / 2
    values["cy"] += like.height / 2
    return Camera(like.width, like.height, **values)


def tour(frames: Sequence[Frame]) -> list[Frame]:
    """Photos in an order that makes a short way through their places: as given, if that is not much longer. Of photos
    that stand close together one is left."""
    frames = [frames[round(i)] for i in np.linspace(0, len(frames) - 1, min(len(frames), _MOST_PHOTOS))]
    at = centres(frames).numpy()
    turns = Rotation.from_matrix(np.stack([f.world_from_cam[:3, :3].numpy() for f in frames]))
    size = float(np.ptp(at, axis=0).max()) or 1.0
    between = np.linalg.norm(at[:, None] - at, axis=2) / size
    between += np.stack([(t.inv() * turns).magnitude() for t in turns])
    order = _short_order(between)
    if _total(between, np.arange(len(frames))) <= _KEPT_ORDER * _total(between, order):
        order = np.arange(len(frames))
    apart, kept, since = _total(between, order) / _TOUR, [int(order[0])], 0.0
    for a, b in pairwise(order):
        since += between[a, b]
        if since >= apart:
            kept.append(int(b))
            since = 0.0
    return [frames[i] for i in kept]


def _total(between: NDArray[np.float64], order: NDArray[np.int64]) -> float:
    return float(between[order[:-1], order[1:]].sum())


def _short_order(between: NDArray[np.float64]) -> NDArray[np.int64]:
    """Always on to the nearest that is left, from the one that is farthest out; then parts of the way are reversed as
    long as that makes it shorter (2-opt)."""
    left = set(range(len(between)))
    order = [int(between.sum(0).argmax())]
    left.remove(order[0])
    while left:
        rest = sorted(left)
        order.append(rest[int(between[order[-1], rest].argmin())])
        left.remove(order[-1])
    way, shorter = np.array(order), True
    while shorter:
        shorter = False
        for i in range(len(way) - 1):
            ends = np.arange(i + 1, len(way))
            old, new = between[way[i], way[i + 1]], between[way[i], way[ends]]
            after = np.append(between[way[ends[:-1]], way[ends[:-1] + 1]], 0.0)
            joined = np.append(between[way[i + 1], way[ends[:-1] + 1]], 0.0)
            gain = old + after - new - joined
            if gain.max() > 1e-9:
                j = int(ends[gain.argmax()])
                way[i + 1 : j + 1] = way[i + 1 : j + 1][::-1].copy()
                shorter = True
    return way
