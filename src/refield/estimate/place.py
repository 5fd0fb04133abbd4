"""Where the new photos were taken, to a part of a pixel: their poses refined against the field (§4.2.1).

A pose that is a pixel off makes every edge a change. The old field's picture from the given pose has a depth at every
pixel, so its pixels are coloured points in the world; the photo's pose is improved until it shows them where they are
(direct image alignment). What changed disagrees and is left out by robust weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from refield.estimate.look import Array, View, pixel_slopes
from refield.scene.pose import exp
from refield.vision import pixels

_F64 = NDArray[np.float64]

_EXPLAINS = 0.25
"""of the points, about; of a photo of something else a pose explains 0.03 to 0.07, of one of the scene with half of it
changed 0.4"""


@dataclass(frozen=True)
class PlaceConfig:
    """How the new photos' poses are refined."""

    blurs: tuple[float, ...] = (2.0, 0.8)
    """pixels, coarse to fine"""
    steps: int = 8
    """Gauss–Newton steps at each blur"""
    points: int = 6000
    """pixels of the old field's picture that are looked for in the photo"""
    robust: float = 0.05
    """colour error, in [0, 1] RGB, beyond which a pixel counts less"""
    least: float = 0.3
    """pixels, rms; a pose that is off by less is left as it was given: the field is no more exact than that"""
    most: float = 8.0
    """pixels, rms; a pose that is off by more is not what this is for"""


@dataclass(frozen=True)
class Placed:
    """A view at its refined pose, not rendered again."""

    world_from_cam: torch.Tensor
    """(4, 4) float64"""
    shift: float
    """pixels, rms over the picture, between the given and the refined pose; 0 if the given one was kept"""


def place(view: View, config: PlaceConfig = PlaceConfig()) -> Placed:
    """The pose from which a photo shows the old field's surfaces best. The photo's colours are those of the field.

    A pose that explains the photo no better, or next to nothing of it, or is further off than a placement error, is
    left as it was.
    """
    given = view.frame.world_from_cam
    points, colours = _points(view, config)
    pose = given
    if len(points) < 200:
        return Placed(given, 0.0)
    for sigma in config.blurs:
        image = pixels.blur(view.photo, sigma)
        stack = np.concatenate([image, *np.gradient(image, axis=(1, 0))], -1)
        target = _sampled(pixels.blur(view.rgb, sigma), colours)
        before = _cost(_compared(view, given, points, stack, target)[0], config)
        pose = _descend(view, pose, points, (stack, target), config)
        after = _cost(_compared(view, pose, points, stack, target)[0], config)
    shift = _shift(view, given, pose, points)
    if not config.least < shift < config.most or after > 0.98 * before or 1 - after < _EXPLAINS:
        return Placed(given, 0.0)
    return Placed(pose, shift)


def _points(view: View, config: PlaceConfig) -> tuple[Array, Array]:
    """World points (N, 3) under the most telling pixels, and those pixels (N, 2)."""
    near = np.where(np.isfinite(view.depth), view.depth, 0)
    rough = cv2.morphologyEx(near.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    # beside an edge in depth what is seen from a little further on is something else
    usable = (view.opacity > 0.9) & (near > 0) & (rough < 8 * view.pixel_angle * np.maximum(near, 1e-6))
    grey = pixels.blur(view.rgb, 0.8).mean(-1)
    slope = np.hypot(*np.gradient(grey))
    ys, xs = np.nonzero(usable)
    if len(ys) == 0:
        return np.zeros((0, 3), np.float32), np.zeros((0, 2), np.int64)
    # evenly among the more textured half, so that a textured corner does not outweigh the rest
    textured = np.flatnonzero(slope[ys, xs] >= np.median(slope[ys, xs]))
    pick = np.random.default_rng(0).permutation(textured)[: config.points]
    at = np.stack([xs[pick], ys[pick]], -1)
    return view.surface[at[:, 1], at[:, 0]].astype(np.float64), at


def _sampled(image: Array, at: Array) -> Array:
    return image[at[:, 1], at[:, 0]].astype(np.float64)


def _local(pose: torch.Tensor, points: Array) -> torch.Tensor:
    return (torch.from_numpy(points) - pose[:3, 3]) @ pose[:3, :3]


def _compared(view: View, pose: torch.Tensor, points: Array, stack: Array, target: Array) -> tuple[Array, Array, Array]:
    """Colour errors (N, 3) with NaN outside the photo, slopes by pixel (N, 3, 2), and points before the camera."""
    local = _local(pose, points)
    uv, _ = view.camera.project(local)
    at = (uv.numpy() - 0.5).astype(np.float32)
    h, w = view.shape
    seen = cv2.remap(
        stack.astype(np.float32), at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )[0].astype(np.float64)
    inside = (at >= 1).all(-1) & (at[:, 0] < w - 2) & (at[:, 1] < h - 2)
    error = np.where(inside[:, None], seen[:, :3] - target, np.nan)
    return error, np.stack([seen[:, 3:6], seen[:, 6:]], -1), local.numpy()


def _cost(error: Array, config: PlaceConfig) -> float:
    q = (error**2).sum(-1) / config.robust**2
    seen = np.isfinite(q)
    return float((q[seen] / (1 + q[seen])).mean()) if seen.sum() > 0.5 * len(q) else np.inf


def _descend(
    view: View, pose: torch.Tensor, points: Array, images: tuple[Array, Array], config: PlaceConfig
) -> torch.Tensor:
    now = _compared(view, pose, points, *images)
    for _ in range(config.steps):
        cost = _cost(now[0], config)
        step = _step(view, *now, config.robust)
        trial = pose @ exp(torch.from_numpy(step))
        then = _compared(view, trial, points, *images)
        if not _cost(then[0], config) < cost:
            break
        pose, now = trial, then
    return pose


def _step(view: View, error: Array, slopes: Array, local: Array, robust: float) -> _F64:
    """Twist (6,) of the camera, in its own frame, that multiplies its pose from the right."""
    ok = np.isfinite(error).all(-1)
    e, x = error[ok], local[ok]
    per_point = slopes[ok] @ pixel_slopes(view.camera, torch.from_numpy(x)).numpy()  # (N, 3, 3)
    # a camera that moves by (v, w) sees a point at x - v - w × x
    cross = np.cross(x[:, None, :], np.eye(3)[None])  # rows: x × e_k = -(e_k × x)
    per_turn = np.einsum("nij,nkj->nik", per_point, cross)
    j = np.concatenate([-per_point, per_turn], -1)
    w = 1 / (1 + (e**2).sum(-1) / robust**2) ** 2
    a = np.einsum("ncp,n,ncq->pq", j, w, j)
    b = np.einsum("ncp,n,nc->p", j, w, e)
    if not np.trace(a) > 0:  # a picture without any detail
        return np.zeros(6)
    return -np.linalg.solve(a + 1e-6 * np.trace(a) * np.eye(6), b)


def _shift(view: View, given: torch.Tensor, pose: torch.Tensor, points: Array) -> float:
    a, b = (view.camera.project(_local(p, points))[0] for p in (given, pose))
    return float((a - b).square().sum(-1).mean().sqrt())
