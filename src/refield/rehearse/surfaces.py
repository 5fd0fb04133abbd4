"""What is photographed lies where? The depth that a fitted field has in each photo, made robust.

A field's depth is noisy: it is median-filtered, its noise is measured between views, and points near a plane that
holds things up are taken to lie on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_camera, render_many
from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays, camera_rays, centres
from refield.scene.planes import Plane
from refield.scene.pose import invert, transform

Progress = Callable[[int, int], None]

VIEW = 160 * 160
"""pixels, about and at most, at which a whole view's depth is asked for"""
CLOSE = 120 * 120
"""pixels, about and at most, for the part of a view in which an object stands"""
_FAR = 1e9
_OPAQUE = 0.5
_SURE = 3.0  # deviations of the depth's noise
_LEAN = np.deg2rad(15.0)  # a floor leans by less: up is known from how the photos were held
_LEANS = 60  # tried
_SLOPE = np.cos(np.deg2rad(40.0))  # most of the normals that a noisy depth has on a floor lean by less
_STEP = 4  # coarse pixels, to the neighbours that tell a normal
_NEARER = 0.6  # of the level points count: farther off the field is rough
_PEAK = 2.0  # times as many points lie on a plane as beside it, in a layer as thick
_SHARE, _FEWEST = 0.08, 200  # of the level points lie on a plane that counts
_MOST_POINTS, _MOST_LEVEL = 200_000, 40_000
_MAD = 1.4826


@dataclass(frozen=True)
class View:
    """What the field shows of a photo, on a coarse sensor."""

    frame: Frame
    camera: Camera
    rgb: Tensor
    """(h, w, 3) float32"""
    depth: Tensor
    """(h, w) float32; inf where nothing is seen"""

    def points(self) -> Tensor:
        """World points (h, w, 3) float32; not finite where nothing is seen."""
        rays = camera_rays(self.camera, self.frame.world_from_cam)
        return (rays.origins + rays.directions * self.depth.reshape(-1, 1)).reshape(*self.depth.shape, 3)

    def sees(self, points: Tensor, noise: float, inset: float = 0.05) -> Tensor:
        """Which of the points (N, 3) are in the picture, this part of its sides away from its border, and not behind
        what it shows; (N,) bool."""
        pixels, z = self.camera.project(transform(invert(self.frame.world_from_cam), points.double()))
        size = pixels.new_tensor([self.camera.width, self.camera.height])
        inside = (z > 0) & ((pixels > inset * size) & (pixels < (1 - inset) * size)).all(-1)
        at = torch.where(inside[:, None], pixels, 0.5).long()
        distance = (points.double() - self.frame.centre).norm(dim=-1)
        return inside & (distance < self.depth[at[:, 1], at[:, 0]] * (1 + _SURE * noise))


@dataclass(frozen=True)
class Surfaces:
    """The photographed surfaces, from all views."""

    views: tuple[View, ...]
    noise: float
    """how uncertain a depth is, as a part of it: its deviation between views, or a coarse pixel"""
    points: NDArray[np.float32]
    """(P, 3) of all views, world; some of them, drawn at random, where they are many"""
    kept: float
    """which part of the views' points these are"""
    colours: NDArray[np.float32]
    """(P, 3) in [0, 1]"""
    planes: tuple[Plane, ...]
    """that things can stand on, the largest first"""


def surfaces_of(field: Field, frames: Sequence[Frame], up: Tensor, on_progress: Progress | None = None) -> Surfaces:
    """Of a field, from where its photos were taken. ``up``: (3,), unit."""
    views = []
    for i, frame in enumerate(frames):
        views.append(_view(field, frame))
        if on_progress is not None:
            on_progress(i + 1, len(frames))
    noise = _noise(views)
    points = torch.cat([view.points()[view.depth.isfinite()] for view in views]).numpy()
    colours = torch.cat([view.rgb[view.depth.isfinite()] for view in views]).numpy()
    kept = min(1.0, _MOST_POINTS / max(len(points), 1))
    chosen = np.random.default_rng(0).random(len(points)) < kept
    distance = float(torch.cat([view.depth[view.depth.isfinite()] for view in views]).median()) if len(points) else 0.0
    pixel = float(np.mean([1 / view.camera.fx for view in views]))
    planes = _planes(views, up, max(noise, pixel) * distance)
    return Surfaces(tuple(views), max(noise, pixel), points[chosen], kept, colours[chosen], tuple(planes))


def _view(field: Field, frame: Frame) -> View:
    camera = frame.camera.within(VIEW)
    shown = render_camera(field, camera, frame.world_from_cam)
    depth = _filtered(shown.depth.cpu(), shown.opacity.cpu())
    return View(frame, camera, shown.rgb.cpu().clamp(0, 1), depth)


def _filtered(depth: Tensor, opacity: Tensor) -> Tensor:
    """A depth (h, w) without single outliers; inf where nothing is."""
    seen = torch.where((opacity > _OPAQUE) & (depth > 0), depth, _FAR).numpy()
    calm = torch.from_numpy(cv2.medianBlur(np.ascontiguousarray(seen, np.float32), 5))
    return torch.where(calm >= _FAR / 2, torch.inf, calm)


def _noise(views: Sequence[View]) -> float:
    """How far the depths of neighbouring views disagree, as a part of the depth; for one of the two."""
    found = []
    at = centres([view.frame for view in views])
    apart = torch.cdist(at, at).fill_diagonal_(torch.inf)
    for view, other in zip(views, apart.argmin(1).tolist()):
        points = view.points()[view.depth.isfinite()][::7].double()
        there = views[other]
        pixels, z = there.camera.project(transform(invert(there.frame.world_from_cam), points))
        size = pixels.new_tensor([there.camera.width, there.camera.height])
        inside = (z > 0) & ((pixels >= 0) & (pixels < size)).all(-1)
        column, row = pixels[inside].long().T
        ratio = there.depth[row, column] / (points[inside] - there.frame.centre).norm(dim=-1)
        found.append(ratio[ratio.isfinite() & (ratio > 0)].log())
    errors = torch.cat(found).abs() if found else torch.zeros(0)
    return float(_MAD * errors.median() / 2**0.5) if len(errors) else 0.0


def _planes(views: Sequence[View], up: Tensor, resolved: float) -> list[Plane]:
    """Level planes of what is photographed nearby, largest first; by points whose neighbours lie level with them."""
    found = [_level(view, up) for view in views]
    rest = torch.cat([points for points, _ in found]).double().numpy()
    depth = torch.cat([depth for _, depth in found]).numpy()
    if len(depth) < _FEWEST:
        return []
    rest = rest[depth <= np.quantile(depth, _NEARER)]
    rng = np.random.default_rng(0)
    if len(rest) > _MOST_LEVEL:
        rest = rest[rng.choice(len(rest), _MOST_LEVEL, replace=False)]
    planes, total = [], len(rest)
    for _ in range(3):
        if len(rest) < _FEWEST:
            break
        plane, on = _level_plane(rest, up.double().numpy(), resolved, rng)
        if on.sum() < max(_FEWEST, _SHARE * total):
            break
        beside = np.abs(rest @ plane.normal - plane.offset) < 3 * resolved
        if on.sum() > _PEAK * (beside.sum() - on.sum()) / 2:  # else points at all heights, no plane
            planes.append(plane)
        rest = rest[~on]
    return planes


def _level_plane(
    points: NDArray[np.float64], up: NDArray[np.float64], tol: float, rng: np.random.Generator
) -> tuple[Plane, NDArray[np.bool_]]:
    """The nearly level plane on which most of the points (N, 3) lie, and which do."""
    best = (-1, up, 0.0)
    for k in range(_LEANS):
        normal = up + (k > 0) * np.tan(_LEAN / 2) * rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        heights = np.sort(points @ normal)
        upto = np.searchsorted(heights, heights + 2 * tol, side="right")
        count = upto - np.arange(len(heights))
        i = int(count.argmax())
        if count[i] > best[0] and normal @ up > np.cos(_LEAN):
            best = (int(count[i]), normal, float(heights[i] + tol))
    _, normal, offset = best
    for _ in range(3):
        on = np.abs(points @ normal - offset) < tol
        centre = points[on].mean(0)
        axis = np.linalg.svd(points[on] - centre, full_matrices=False)[2][2]
        axis = axis if axis @ up > 0 else -axis
        if axis @ up > np.cos(_LEAN):  # else too few to tell how it leans
            normal = axis
        offset = float(np.median(points[on] @ normal))
    on = np.abs(points @ normal - offset) < tol
    noise = float(_MAD * np.median(np.abs(points[on] @ normal - offset))) if on.any() else 0.0
    return Plane(normal.astype(np.float32), offset, noise), on


def _level(view: View, up: Tensor) -> tuple[Tensor, Tensor]:
    """Points (N, 3) of a view on surfaces that face up, and their depth (N,)."""
    points, step = view.points(), _STEP
    across = points[step:-step, 2 * step :] - points[step:-step, : -2 * step]
    down = points[2 * step :, step:-step] - points[: -2 * step, step:-step]
    normal = torch.linalg.cross(down, across)
    tilt = (normal @ up.float()) / normal.norm(dim=-1)
    middle, depth = points[step:-step, step:-step], view.depth[step:-step, step:-step]
    faces = (tilt > _SLOPE) & middle.isfinite().all(-1)
    return middle[faces], depth[faces]


@dataclass(frozen=True)
class Standing:
    """A plane that holds things up, as a depth map is put right by it."""

    normal: Tensor
    """(3,) float64, up"""
    offset: float
    near: float
    """points that lie no farther from the plane are taken to lie on it"""


def depth_in(
    field: Field, surfaces: Surfaces, frame: Frame, box: tuple[int, int, int, int], standing: Standing | None
) -> tuple[Tensor, Tensor]:
    """Distance of what is photographed in a photo, and from where on things are hidden: (H, W) float32 each.

    Within ``box`` (left, top, right, bottom, pixels) the field is asked on a finer lattice. Between lattice points a
    surface is interpolated, across an edge the nearest is taken.
    """
    view = next(v for v in surfaces.views if v.frame is frame)
    camera = frame.camera
    out = _grown(view.depth, (camera.height, camera.width), surfaces.noise)
    left, top, right, bottom = box
    if left < right and top < bottom:
        out[top:bottom, left:right] = _close(field, frame, box, surfaces.noise)
    limit = out * (1 + _SURE * surfaces.noise)
    return (out, limit) if standing is None else _put_right(frame, out, limit, standing)


def _close(field: Field, frame: Frame, box: tuple[int, int, int, int], noise: float) -> Tensor:
    left, top, right, bottom = box
    wide, high = right - left, bottom - top
    part = min(1.0, (CLOSE / (wide * high)) ** 0.5)
    columns, rows = max(5, round(wide * part)), max(5, round(high * part))
    u = left + (torch.arange(columns, dtype=torch.float64) + 0.5) * wide / columns
    v = top + (torch.arange(rows, dtype=torch.float64) + 0.5) * high / rows
    pixels = torch.stack(torch.meshgrid(v, u, indexing="ij"), -1).flip(-1).reshape(-1, 2)
    rays, device = camera_rays(frame.camera, frame.world_from_cam, pixels), field.sampler.grid.device
    shown = render_many(field, Rays(rays.origins.to(device), rays.directions.to(device)))
    depth = _filtered(shown.depth.cpu().reshape(rows, columns), shown.opacity.cpu().reshape(rows, columns))
    return _grown(depth, (high, wide), noise)


def _grown(depth: Tensor, size: tuple[int, int], noise: float) -> Tensor:
    """A depth (h, w) on more pixels: linear on a surface, the nearest lattice point's across an edge."""
    inverse = 1 / depth.numpy()
    wanted = (size[1], size[0])
    smooth = cv2.resize(inverse, wanted, interpolation=cv2.INTER_LINEAR)
    nearest = cv2.resize(inverse, wanted, interpolation=cv2.INTER_NEAREST_EXACT)
    square = np.ones((3, 3), np.uint8)
    lo, hi = (
        cv2.resize(f(inverse, square), wanted, interpolation=cv2.INTER_NEAREST_EXACT) for f in (cv2.erode, cv2.dilate)
    )
    edge = hi > lo * (1 + 0.1 + 4 * _SURE * noise)  # one surface seen at a slant changes by less from point to point
    with np.errstate(divide="ignore"):
        return torch.from_numpy(1 / np.where(edge, nearest, smooth).astype(np.float32))


def _put_right(frame: Frame, depth: Tensor, limit: Tensor, standing: Standing) -> tuple[Tensor, Tensor]:
    """Depth and limit with the plane's own in place of a depth that lies on it."""
    rays = camera_rays(frame.camera, frame.world_from_cam)
    d = rays.directions.double()
    slope = d @ standing.normal
    start = float(frame.centre @ standing.normal) - standing.offset
    exact = torch.where(slope < -1e-6, -start / slope.clamp(max=-1e-6), torch.inf).reshape(depth.shape)
    height = start + depth.double() * slope.reshape(depth.shape)
    on = (height.abs() <= standing.near) & exact.isfinite()
    return torch.where(on, exact.float(), depth), torch.where(on, exact.float() * (1 + 1e-3), limit)
