"""The surfaces that a field shows, as points: where its photos' rays end, kept where the views agree.

Letters: V views of h x w pixels, P points. A point's *footprint* is how far apart, in world units, neighbouring pixels
of a view lie at its distance: what can be told apart there. Everything is in the world of the field.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from refield.field.radiance import Field
from refield.field.render import render_camera, render_many
from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays, camera_rays
from refield.scene.pose import invert, transform

Progress = Callable[[int, int], None]

RAYS = 2_000_000
"""asked of a field for all views together, about and at most"""
POINTS = 300_000
"""kept, at most: as splats of 56 bytes they take 17 MB"""
_OPAQUE = 0.9  # of the light has to end in what is taken for a surface
_PIECE = 200_000  # points that are looked at at once
_FINE = 1.0  # footprints: cells in which pixels are pooled before the views are asked about them
_AGREE = 2  # views, its own among them, have to show a point
_THROUGH = 0.25  # of as many views as show a point may look through it
_PARALLAX = 0.2  # of that of the nearer surfaces; where it is less their distance is not known
_NEARER = 0.75  # of the pixels may show a sky
_BACK, _STRAY = 4.0, 3.0  # footprints: from how far a point is asked for again, and how far it may have been off
_STEPS = 32  # of that way, and of as much behind the point
_CLOSE = 0.06  # of a colour's range: a colour from close by may differ by as much from the views' mean
_NEIGHBOURS = 12  # tell a normal
_MAD = 1.4826


@dataclass(frozen=True)
class View:
    """What a field shows of one photo's camera, perhaps on a coarser sensor."""

    camera: Camera
    world_from_cam: Tensor
    """(4, 4) float64"""
    rgb: Tensor
    """(h, w, 3) float32 in [0, 1]"""
    depth: Tensor
    """(h, w) float32, along the ray; inf where no surface is"""
    nearest: Tensor
    """(h, w) float32: the smallest depth of a pixel and its neighbours"""
    farthest: Tensor
    """(h, w) float32: the largest"""

    @property
    def focal(self) -> float:
        """Pixels per unit of a thing one unit away, at the middle of the picture."""
        return math.sqrt(self.camera.fx * self.camera.fy)

    @property
    def centre(self) -> Tensor:
        """Where it was taken, (3,) float32."""
        return self.world_from_cam[:3, 3].float()


@dataclass(frozen=True)
class Points:
    """P points of surfaces."""

    xyz: Tensor
    """(P, 3) float32, world"""
    rgb: Tensor
    """(P, 3) float32 in [0, 1]"""
    footprint: Tensor
    """(P,) float32, of the finest view that shows the point; world units"""
    facing: Tensor
    """(P, 3) float32, unit: towards where it is seen from"""
    normal: Tensor
    """(P, 3) float32, unit, on the side that is seen"""
    spacing: Tensor
    """(P,) float32: how far apart the points lie around it, world units"""

    def __len__(self) -> int:
        return len(self.xyz)

    def __getitem__(self, index: Tensor) -> Points:
        return Points(*(getattr(self, f.name)[index] for f in fields(self)))


@dataclass(frozen=True)
class Surface:
    """Everything that a field's views show."""

    points: Points
    """of surfaces that the views agree on"""
    far_directions: Tensor
    """(F, 3) float32, unit: of rays that end beyond all surfaces, where nothing tells how far away"""
    far_rgb: Tensor
    """(F, 3) float32: what these rays show"""


@dataclass(frozen=True)
class _Seen:
    """What all views say of P points."""

    shown: Tensor
    """(P,) number of views that show a surface there"""
    through: Tensor
    """(P,) number of views that look through it"""
    rgb: Tensor
    """(P, 3) float32, mean colour of the views that show it, the finest ones most"""
    footprint: Tensor
    """(P,) float32, of the finest view that shows it; inf where none does"""
    facing: Tensor
    """(P, 3) float32: the mean of the unit directions to where it is seen from; the shorter the more they differ"""

    @property
    def agreed(self) -> Tensor:
        """(P,) bool: a surface is there."""
        return (self.shown >= _AGREE) & (self.through <= _THROUGH * self.shown)

    @property
    def parallax(self) -> Tensor:
        """(P,) radians, about: how much the directions differ."""
        return (2 * (1 - self.facing.norm(dim=-1))).clamp_min(0).sqrt()


def views_of(
    field: Field, frames: Sequence[Frame], on_progress: Progress | None = None, rays: int = RAYS
) -> list[View]:
    """What ``field`` shows where its photos were taken, with about so many rays at most in all."""
    out = []
    for i, frame in enumerate(frames):
        out.append(_view(field, frame, frame.camera.within(max(rays // len(frames), 1))))
        if on_progress is not None:
            on_progress(i + 1, len(frames))
    return out


def _view(field: Field, frame: Frame, camera: Camera) -> View:
    shown = render_camera(field, camera, frame.world_from_cam)
    depth, opacity = shown.depth.cpu(), shown.opacity.cpu()
    there = (opacity > _OPAQUE) & (depth > 0)
    # single pixels stray where a ray passes by an edge
    calm = cv2.medianBlur(torch.where(there, depth, torch.inf).numpy(), 3)
    depth = torch.where(there, torch.from_numpy(calm), torch.inf)
    around = functional.pad(depth[None, None], (1, 1, 1, 1), mode="replicate")
    farthest = functional.max_pool2d(around, 3, stride=1)[0, 0]
    nearest = -functional.max_pool2d(-around, 3, stride=1)[0, 0]
    return View(camera, frame.world_from_cam, shown.rgb.cpu().clamp(0, 1), depth, nearest, farthest)


def surface_of(field: Field, views: Sequence[View], most: int = POINTS) -> Surface:
    """The surfaces that the views show and agree on; ``most``: points, no closer than pixels are."""
    found = [ends_of(view) for view in views]
    xyz, directions, footprint, rgb = (torch.cat(part) for part in zip(*found))
    cells = cells_of(xyz, footprint * _FINE)
    pooled = mean_over(xyz, cells)
    tolerance = _tolerance(views)
    seen = _seen_by(views, pooled, tolerance)
    parallax = seen.parallax
    firm = seen.agreed
    if firm.any():
        usual = np.quantile(parallax[cells][firm[cells]].numpy(), _NEARER)
        firm &= parallax > _PARALLAX * float(usual)
    points = _thinned(pooled[firm], seen.rgb[firm], seen.footprint[firm], seen.facing[firm], most)
    far = _beyond(xyz, ~firm[cells], points, views)
    if len(points):
        points = _asked_again(field, views, points, tolerance)
    return Surface(points, directions[far], rgb[far])


def ends_of(view: View) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """World points (P, 3) where a view's rays end, the rays' directions, footprints (P,) and colours (P, 3)."""
    rays, depth = camera_rays(view.camera, view.world_from_cam), view.depth.reshape(-1)
    there = depth.isfinite()
    xyz = rays.origins + rays.directions * depth[:, None]
    return xyz[there], rays.directions[there], depth[there] / view.focal, view.rgb.reshape(-1, 3)[there]


def _beyond(xyz: Tensor, loose: Tensor, points: Points, views: Sequence[View]) -> Tensor:
    """Which rays, ending at ``xyz`` (N, 3), that met no surface did so beyond all of them, (N,) bool."""
    middle = torch.stack([view.centre for view in views]).mean(0)
    within = (points.xyz - middle).norm(dim=-1).sort().values
    reach = float(within[int(0.95 * (len(within) - 1))]) if len(within) else 0.0
    return loose & ((xyz - middle).norm(dim=-1) > reach)


def _asked_again(field: Field, views: Sequence[View], points: Points, tolerance: float) -> Points:
    """The points as the field shows them from close by, on the way on which they are seen most squarely.

    Depths of slanted surfaces are pooled from few and long pixels: this one is better. Its colour is not blurred, as
    far as it is near what the views show there in the mean. What is not met near where it was is left out, and so is
    what the views do not agree on any longer.
    """
    way = _squarest(views, points, tolerance)
    back = _BACK * points.footprint
    shown = render_many(field, Rays(points.xyz + way * back[:, None], -way))
    shift, opacity = _depth_near(field, points, way)
    met = (opacity > _OPAQUE) & (shift.abs() < _STRAY * points.footprint)
    moved = replace(points, xyz=points.xyz - way * shift[:, None], rgb=shown.rgb.cpu(), facing=way)[met]
    seen = _seen_by(views, moved.xyz, tolerance)
    # a ray that begins behind thin haze may show what no photo does
    rgb = seen.rgb + (moved.rgb - seen.rgb).clamp(-_CLOSE, _CLOSE)
    return _with_normals(replace(moved, rgb=rgb.clamp(0, 1))[seen.agreed])


def _depth_near(field: Field, points: Points, way: Tensor) -> tuple[Tensor, Tensor]:
    """How far behind the points, against ``way`` (P, 3), the light ends on the mean (P,), and how much of it (P,).

    By finer steps than a picture is rendered with: in these, what grows dense gradually is met too far in.
    """
    t = torch.linspace(-_BACK, _BACK, _STEPS + 1)
    middle, depths, opacities = (t[1:] + t[:-1]) / 2, [], []
    for rows in torch.arange(len(points)).split(_PIECE // _STEPS):
        footprint = points.footprint[rows, None]
        x = points.xyz[rows, None] - way[rows, None] * (footprint * middle)[..., None]
        with torch.no_grad():
            sigmas = field.density(x.reshape(-1, 3)).reshape(x.shape[:2]).cpu()
        optical = (sigmas * footprint * (t[1] - t[0])).cumsum(1)
        weight = torch.diff(-torch.exp(-optical), dim=1, prepend=torch.full_like(footprint, -1.0))
        opacity = weight.sum(1)
        depths.append((weight * footprint * middle).sum(1) / opacity.clamp_min(torch.finfo(torch.float32).tiny))
        opacities.append(opacity)
    return torch.cat(depths), torch.cat(opacities)


def _squarest(views: Sequence[View], points: Points, tolerance: float) -> Tensor:
    """(P, 3) unit: to the view that shows each point most squarely, at about the finest footprint there is."""
    best, way = torch.full((len(points),), -torch.inf), points.facing.clone()
    for view in views:
        which, _, distance, _ = _asked(view, points.xyz, tolerance)
        to_camera = functional.normalize(view.centre - points.xyz[which], dim=-1)
        score = (to_camera * points.normal[which]).sum(-1) * points.footprint[which] * view.focal / distance
        better = score > best[which]
        best[which[better]], way[which[better]] = score[better], to_camera[better]
    return way


def _asked(view: View, xyz: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Which of the points (P, 3) a view shows: their numbers, pixels (K, 2) and distances (K,); and the numbers of
    those that it looks through."""
    local = transform(invert(view.world_from_cam), xyz)
    pixels, z = view.camera.project(local)
    size = pixels.new_tensor([view.camera.width, view.camera.height])
    inside = ((z > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)).nonzero()[:, 0]
    at, distance = pixels[inside], local[inside].norm(dim=-1)
    column, row = at.long().T
    before = distance < view.nearest[row, column] * (1 - tolerance)
    behind = distance > view.farthest[row, column] * (1 + tolerance)
    here = ~(before | behind) & view.depth[row, column].isfinite()
    return inside[here], at[here], distance[here], inside[before]


def _seen_by(views: Sequence[View], xyz: Tensor, tolerance: float) -> _Seen:
    """What the views say of points (P, 3), where depths are known to this part of them."""
    pieces = [_piece_seen_by(views, part, tolerance) for part in xyz.split(_PIECE)]
    return _Seen(*(torch.cat([getattr(p, f.name) for p in pieces]) for f in fields(_Seen)))


def _piece_seen_by(views: Sequence[View], xyz: Tensor, tolerance: float) -> _Seen:
    count = len(xyz)
    shown, through, weight = torch.zeros(3, count)
    rgb, facing = torch.zeros(2, count, 3)
    finest = torch.full((count,), torch.inf)
    for view in views:
        which, at, distance, beside = _asked(view, xyz, tolerance)
        footprint = distance / view.focal
        finest[which] = torch.minimum(finest[which], footprint)
        through[beside] += 1
        shown[which] += 1
        w = footprint**-4  # a photo from twice as far adds nothing but blur
        weight[which] += w
        rgb[which] += w[:, None] * _picked(view.rgb, at)
        facing[which] += functional.normalize(view.centre - xyz[which], dim=-1)
    tiny = torch.finfo(torch.float32).tiny
    return _Seen(shown, through, rgb / weight.clamp_min(tiny)[:, None], finest, facing / shown.clamp_min(1)[:, None])


def _picked(picture: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear colours (P, 3) of a picture (h, w, 3) at pixels (P, 2)."""
    height, width, _ = picture.shape
    grid = 2 * pixels / pixels.new_tensor([width, height]) - 1
    rows = picture.permute(2, 0, 1)[None]
    found = functional.grid_sample(rows, grid[None, None], padding_mode="border", align_corners=False)
    return found[0, :, 0].T


def _thinned(xyz: Tensor, rgb: Tensor, footprint: Tensor, facing: Tensor, most: int) -> Points:
    """One point in place of all that stand in one footprint, or in more, until they are no more than ``most``."""
    wide = 1.0
    while True:
        cells = cells_of(xyz, footprint * wide)
        count = int(cells.max()) + 1 if len(cells) else 0
        if count <= most:
            break
        wide *= 1.02 * math.sqrt(count / most)
    mean = [mean_over(v, cells) for v in (xyz, rgb, footprint[:, None], facing)]
    facing = functional.normalize(mean[3], dim=-1)
    return _with_normals(Points(mean[0], mean[1], mean[2][:, 0] * wide, facing, facing, mean[2][:, 0]))


def _with_normals(points: Points) -> Points:
    """The same with the normals of the planes through each one's nearest neighbours, and their spacing."""
    from scipy.spatial import cKDTree

    if len(points) < 3:
        return points
    xyz = points.xyz.numpy()
    distance, near = cKDTree(xyz).query(xyz, min(_NEIGHBOURS, len(xyz)))
    around = xyz[near] - xyz[near].mean(1, keepdims=True)
    normal = torch.linalg.eigh(torch.from_numpy(np.einsum("pki,pkj->pij", around, around))).eigenvectors[:, :, 0]
    side = torch.where((normal * points.facing).sum(-1) < 0, -1.0, 1.0)
    # k of them on a disc of radius d: one for each pi d^2 / k
    k = min(6, near.shape[1] - 1)
    spacing = torch.from_numpy(distance[:, k]).float() * math.sqrt(math.pi / k)
    return replace(points, normal=normal * side[:, None], spacing=spacing)


def cells_of(xyz: Tensor, size: Tensor) -> Tensor:
    """Numbers (P,) of the cells in which points (P, 3) lie, each of about the size (P,) asked for: equal where the
    cell is."""
    level = (2 * size.log2()).round()
    # not at the origin: what stands on a plane through it would be torn in two
    place = (xyz / torch.exp2(level / 2)[:, None] + 0.37).floor().long()
    # products with large odd numbers: that any two cells share a number is less likely than one in a million
    key = level.long() * 0x1D8E4E27C47D124F
    for axis, factor in enumerate((0x9E3779B97F4A7C1, 0x2545F4914F6CDD1D, 0x27220A95FE8D3A59)):
        key = (key ^ place[:, axis]) * factor
        key = key ^ ((key >> 32) & 0xFFFFFFFF)  # else cells on opposite sides of the origin share a number
    return torch.unique(key, return_inverse=True)[1]


def mean_over(values: Tensor, cells: Tensor) -> Tensor:
    """The mean of ``values`` (P, C) over each cell."""
    count = int(cells.max()) + 1 if len(cells) else 0
    total = torch.zeros(count, values.shape[1], dtype=torch.float64).index_add_(0, cells, values.double())
    return (total / torch.bincount(cells, minlength=count)[:, None]).float()


def _tolerance(views: Sequence[View]) -> float:
    """How far depths of neighbouring views may disagree, as a part of them: three deviations, a pixel at least."""
    at = torch.stack([view.centre for view in views])
    apart = torch.cdist(at, at).fill_diagonal_(torch.inf)
    found = []
    for view, other in zip(views, apart.argmin(1).tolist()):
        there = views[other]
        local = transform(invert(there.world_from_cam), ends_of(view)[0][::7])
        pixels, z = there.camera.project(local)
        size = pixels.new_tensor([there.camera.width, there.camera.height])
        inside = (z > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)
        column, row = pixels[inside].long().T
        ratio = there.depth[row, column] / local[inside].norm(dim=-1)
        found.append(ratio[ratio.isfinite() & (ratio > 0)].log())
    errors = torch.cat(found).abs()
    noise = float(_MAD * errors.median()) if len(errors) else 0.0
    return max(3 * noise, *(1 / view.focal for view in views))
