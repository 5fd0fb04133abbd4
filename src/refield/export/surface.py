"""The surfaces that a field shows, as points: where its photos' rays end, kept where the views agree.

Letters: V views of h x w pixels, P points. A point's *footprint* is how far apart, in world units, neighbouring pixels
of a view lie at its distance: what can be told apart there. Everything is in the world of the field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from refield.export.seen import View, asked, ends_of, seen_by, tolerance_of
from refield.field.radiance import Field
from refield.field.render import render_many
from refield.field.volrend import OPAQUE
from refield.scene.capture import Rays

POINTS = 300_000
"""kept, at most: as splats of 56 bytes they take 17 MB"""
_AT_ONCE = 200_000  # samples of a field
_FINE = 1.0  # footprints: cells in which pixels are pooled before the views are asked about them
_PARALLAX = 0.2  # of that of the nearer surfaces; where it is less their distance is not known
_NEARER = 0.75  # of the pixels may show a sky
_BACK, _STRAY = 4.0, 3.0  # footprints: from how far a point is asked for again, and how far it may have been off
_STEPS = 32  # of that way, and of as much behind the point
_CLOSE = 0.06  # of a colour's range: a colour from close by may differ by as much from the views' mean
_NEIGHBOURS = 12  # tell a normal


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
    drawn: Tensor
    """(P, 3) float32, world: where pictures show it, which are rendered by coarser steps; what is to look like them
    stands there"""

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


def surface_of(field: Field, views: Sequence[View], most: int = POINTS) -> Surface:
    """The surfaces that the views show and agree on; ``most``: points, no closer than pixels are."""
    found = [ends_of(view) for view in views]
    xyz, directions, footprint, rgb = (torch.cat(part) for part in zip(*found))
    cells = cells_of(xyz, footprint * _FINE)
    pooled = mean_over(xyz, cells)
    tolerance = tolerance_of(views)
    seen = seen_by(views, pooled, tolerance)
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
    drawn = shown.depth.cpu() - back
    shift, opacity = _depth_near(field, points, way)
    met = (opacity > OPAQUE) & (torch.maximum(shift.abs(), drawn.abs()) < _STRAY * points.footprint)
    places = [points.xyz - way * behind[:, None] for behind in (shift, drawn)]
    moved = replace(points, xyz=places[0], drawn=places[1], rgb=shown.rgb.cpu(), facing=way)[met]
    seen = seen_by(views, moved.xyz, tolerance)
    # a ray that begins behind thin haze may show what no photo does
    rgb = seen.rgb + (moved.rgb - seen.rgb).clamp(-_CLOSE, _CLOSE)
    return _with_normals(replace(moved, rgb=rgb.clamp(0, 1))[seen.agreed])


def _depth_near(field: Field, points: Points, way: Tensor) -> tuple[Tensor, Tensor]:
    """How far behind the points, against ``way`` (P, 3), the light ends on the mean (P,), and how much of it (P,).

    By finer steps than a picture is rendered with: in these, what grows dense gradually is met too far in.
    """
    t = torch.linspace(-_BACK, _BACK, _STEPS + 1)
    middle, depths, opacities = (t[1:] + t[:-1]) / 2, [], []
    for rows in torch.arange(len(points)).split(_AT_ONCE // _STEPS):
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
        which, _, distance, _ = asked(view, points.xyz, tolerance)
        to_camera = functional.normalize(view.centre - points.xyz[which], dim=-1)
        score = (to_camera * points.normal[which]).sum(-1) * points.footprint[which] * view.focal / distance
        better = score > best[which]
        best[which[better]], way[which[better]] = score[better], to_camera[better]
    return way


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
    return _with_normals(Points(mean[0], mean[1], mean[2][:, 0] * wide, facing, facing, mean[2][:, 0], mean[0]))


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
