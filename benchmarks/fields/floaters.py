"""What hangs in the air before a camera that was left out.

The measure: light that is stopped at less than half of the distance at which the training photos show anything in that
direction. The training photos' own surfaces (the field's depth from where each was taken, small) are points; those
that fall within an eighth of the left-out picture's longer side around a pixel tell how near things are there, by
their 10 % quantile, in which each photo has one vote: what hangs before a single one of them moves it little. Pixels
where too few points fall count neither way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_many, visible_samples
from refield.field.volrend import weights
from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays, camera_rays
from refield.scene.pose import invert, transform

_Array = NDArray[Any]
NEAR = 0.5
"""of the distance of what is there: nearer than that is in the air"""
LIGHT = 0.1
"""part of a pixel's light that, stopped there, is seen"""
_CELLS = 24  # along a picture's longer side; a window is 3 x 3 of them
_QUANTILE, _FEWEST = 0.1, 40
_VOTE = 10  # points of a photo in a window that share one vote if they are more; fewer have less than one
_SMALL, _LOOKED_AT, _MOST_PHOTOS = 48, 160, 100  # pixels of the longer side of the training photos, of those judged
_SURFACE = 0.9  # opacity of what is taken for one
_CHUNK = 8192


@dataclass(frozen=True)
class Points:
    """What the training photos show."""

    places: Tensor
    """(P, 3) float64, world"""
    photos: Tensor
    """(P,) int64: which photo shows each"""


@dataclass(frozen=True)
class Floaters:
    """Of one picture or, by `pooled`, of several."""

    stopped: Tensor
    """(K,) part of the light stopped too near, of the pixels of which it can be told"""
    pixels: int
    """that were asked, K of them with an answer"""

    @property
    def share(self) -> float:
        """Part of the pixels in which they are seen; NaN if there are none."""
        return float((self.stopped > LIGHT).double().mean())

    @property
    def light(self) -> float:
        """Part of all light."""
        return float(self.stopped.double().mean())

    @property
    def known(self) -> float:
        """Part of the pixels of which it can be told."""
        return len(self.stopped) / max(self.pixels, 1)


def pooled(each: Sequence[Floaters]) -> Floaters:
    """The pixels of all of them."""
    return Floaters(torch.cat([torch.zeros(0), *(f.stopped for f in each)]), sum(f.pixels for f in each))


def surfaces(field: Field, train: Sequence[Frame]) -> Points:
    """What the photos of a fit show."""
    step, found = max(-(-len(train) // _MOST_PHOTOS), 1), []
    for frame in train[::step]:
        rays = camera_rays(_small(frame.camera, _SMALL), frame.world_from_cam)
        seen = render_many(field, rays)
        solid = seen.opacity > _SURFACE
        found.append((rays.origins + rays.directions * seen.depth[:, None])[solid])
    counts = torch.tensor([len(places) for places in found])
    return Points(torch.cat(found).double(), torch.arange(len(found)).repeat_interleave(counts))


def floaters_before(field: Field, frame: Frame, points: Points) -> Floaters:
    """Of a photo that was left out; ``points`` are the `surfaces`."""
    camera = _small(frame.camera, _LOOKED_AT)
    limit = NEAR * nearest(points, camera, frame.world_from_cam).flatten()
    rows = limit.isfinite().nonzero()[:, 0]
    rays = camera_rays(camera, frame.world_from_cam)[rows]
    return Floaters(_stopped_before(field, rays, limit[rows]), len(limit))


def nearest(points: Points, camera: Camera, world_from_cam: Tensor) -> Tensor:
    """How far from a camera the nearest of the points around each pixel are, (H, W) float32; NaN if they are few."""
    side = max(camera.width, camera.height) / _CELLS
    across, down = int(camera.width / side) + 1, int(camera.height / side) + 1
    pixels, distance, which = _projected(points.places, camera, world_from_cam)
    column, row = (pixels / side).long().unbind(-1)
    votes = []
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            u, v = column + du, row + dv
            inside = (u >= 0) & (u < across) & (v >= 0) & (v < down)
            votes.append(torch.stack([(v * across + u).double(), points.photos[which].double(), distance])[:, inside])
    cell, photo, far = torch.cat(votes, 1).numpy()
    table = _low(cell.astype(np.int64), photo.astype(np.int64), far, across * down)
    u, v = (camera.pixel_centres() / side).long().unbind(-1)
    return torch.from_numpy(table)[v * across + u].float().reshape(camera.height, camera.width)


def _low(cell: _Array, photo: _Array, far: _Array, cells: int) -> _Array:
    """The low quantile of each cell's distances, (cells,), photos having a vote each; NaN where the points are few."""
    group = cell * (int(photo.max(initial=0)) + 1) + photo
    weight = (1 / np.maximum(np.bincount(group), _VOTE))[group] if len(group) else far
    order = np.lexsort((far, cell))
    cell, far, weight = cell[order], far[order], weight[order]
    total = np.bincount(cell, weight, cells)
    before = np.concatenate([[0.0], np.cumsum(total)[:-1]])
    reached = np.cumsum(weight) - before[cell] >= _QUANTILE * total[cell]
    rows = np.flatnonzero(reached)
    chosen, first = np.unique(cell[rows], return_index=True)
    out = np.full(cells, np.nan)
    out[chosen] = far[rows[first]]
    out[np.bincount(cell, minlength=cells) < _FEWEST] = np.nan
    return out


def _projected(points: Tensor, camera: Camera, world_from_cam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (K, 2) and distances (K,) of the points in the picture, and their rows (K,)."""
    here = transform(invert(world_from_cam), points)
    # far outside of the picture a lens' polynomial folds back into it: only what a straight lens shows nearby is asked
    straight = replace(camera, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    pixels, z = straight.project(here)
    rows = ((z > 1e-9) & ((pixels / size - 0.5).abs() < 0.75).all(-1)).nonzero()[:, 0]
    pixels, _ = camera.project(here[rows])
    inside = ((pixels >= 0) & (pixels < size)).all(-1)
    return pixels[inside], here[rows[inside]].norm(dim=-1), rows[inside]


def _stopped_before(field: Field, rays: Rays, limit: Tensor) -> Tensor:
    """The part of each ray's light that is stopped before its limit, (N,)."""
    out = [torch.zeros(0)]
    with torch.no_grad():
        for i in range(0, len(rays), _CHUNK):
            some = rays[i : i + _CHUNK]
            samples = visible_samples(field, some)
            sigmas, _ = field(*samples.positions(some))
            ids = samples.ray_ids
            near = (samples.t_starts + samples.t_ends) / 2 < limit[i : i + _CHUNK][ids]
            w = weights(sigmas, samples) * near
            out.append(torch.zeros(len(some)).index_add(0, ids, w))
    return torch.cat(out)


def _small(camera: Camera, longest: int) -> Camera:
    return camera.shrunk(min(1.0, longest / max(camera.width, camera.height)))
