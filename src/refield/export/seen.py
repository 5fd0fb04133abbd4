"""What a field shows from its photos' places, and what these views say of points: who shows one, who looks through it.

Letters: V views of h x w pixels, P points. A point's *footprint* is how far apart, in world units, neighbouring pixels
of a view lie at its distance: what can be told apart there. Everything is in the world of the field.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import cv2
import torch
from torch import Tensor
from torch.nn import functional

from refield.field.radiance import Field
from refield.field.render import render_camera
from refield.field.volrend import OPAQUE, depths_around
from refield.scene.camera import Camera
from refield.scene.capture import Frame, camera_rays
from refield.scene.pose import invert, transform

Progress = Callable[[int, int], None]

RAYS = 2_000_000
"""asked of a field for all views together, about and at most"""
_PIECE = 200_000  # points that are looked at at once
_AGREE = 2  # views, its own among them, have to show a point
_THROUGH = 0.25  # of as many views as show a point may look through it
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
class Seen:
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
    there = (opacity > OPAQUE) & (depth > 0)
    # single pixels stray where a ray passes by an edge
    calm = cv2.medianBlur(torch.where(there, depth, torch.inf).numpy(), 3)
    depth = torch.where(there, torch.from_numpy(calm), torch.inf)
    return View(camera, frame.world_from_cam, shown.rgb.cpu().clamp(0, 1), depth, *depths_around(depth))


def ends_of(view: View) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """World points (P, 3) where a view's rays end, the rays' directions, footprints (P,) and colours (P, 3)."""
    rays, depth = camera_rays(view.camera, view.world_from_cam), view.depth.reshape(-1)
    there = depth.isfinite()
    xyz = rays.origins + rays.directions * depth[:, None]
    return xyz[there], rays.directions[there], depth[there] / view.focal, view.rgb.reshape(-1, 3)[there]


def tolerance_of(views: Sequence[View]) -> float:
    """How far depths of neighbouring views may disagree, as a part of them: three deviations, a pixel at least."""
    at = torch.stack([view.centre for view in views])
    apart = torch.cdist(at, at).fill_diagonal_(torch.inf)
    found = []
    for view, other in zip(views, apart.argmin(1).tolist()):
        there = views[other]
        local = transform(invert(there.world_from_cam), ends_of(view)[0][::7])
        pixels, z = there.camera.project(local)
        inside = there.camera.shows(pixels, z)
        column, row = pixels[inside].long().T
        ratio = there.depth[row, column] / local[inside].norm(dim=-1)
        found.append(ratio[ratio.isfinite() & (ratio > 0)].log())
    errors = torch.cat(found).abs()
    noise = float(_MAD * errors.median()) if len(errors) else 0.0
    return max(3 * noise, *(1 / view.focal for view in views))


def seen_by(views: Sequence[View], xyz: Tensor, tolerance: float) -> Seen:
    """What the views say of points (P, 3), where depths are known to this part of them."""
    pieces = [_piece_seen_by(views, part, tolerance) for part in xyz.split(_PIECE)]
    return Seen(*(torch.cat([getattr(p, f.name) for p in pieces]) for f in fields(Seen)))


def _piece_seen_by(views: Sequence[View], xyz: Tensor, tolerance: float) -> Seen:
    count = len(xyz)
    shown, through, weight = torch.zeros(3, count)
    rgb, facing = torch.zeros(2, count, 3)
    finest = torch.full((count,), torch.inf)
    for view in views:
        which, at, distance, beside = asked(view, xyz, tolerance)
        footprint = distance / view.focal
        finest[which] = torch.minimum(finest[which], footprint)
        through[beside] += 1
        shown[which] += 1
        w = footprint**-4  # a photo from twice as far adds nothing but blur
        weight[which] += w
        rgb[which] += w[:, None] * _picked(view.rgb, at)
        facing[which] += functional.normalize(view.centre - xyz[which], dim=-1)
    tiny = torch.finfo(torch.float32).tiny
    return Seen(shown, through, rgb / weight.clamp_min(tiny)[:, None], finest, facing / shown.clamp_min(1)[:, None])


def asked(view: View, xyz: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Which of the points (P, 3) a view shows: their numbers, pixels (K, 2) and distances (K,); and the numbers of
    those that it looks through."""
    local = transform(invert(view.world_from_cam), xyz)
    pixels, z = view.camera.project(local)
    inside = view.camera.shows(pixels, z).nonzero()[:, 0]
    at, distance = pixels[inside], local[inside].norm(dim=-1)
    column, row = at.long().T
    before = distance < view.nearest[row, column] * (1 - tolerance)
    behind = distance > view.farthest[row, column] * (1 + tolerance)
    here = ~(before | behind) & view.depth[row, column].isfinite()
    return inside[here], at[here], distance[here], inside[before]


def _picked(picture: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear colours (P, 3) of a picture (h, w, 3) at pixels (P, 2)."""
    height, width, _ = picture.shape
    grid = 2 * pixels / pixels.new_tensor([width, height]) - 1
    rows = picture.permute(2, 0, 1)[None]
    found = functional.grid_sample(rows, grid[None, None], padding_mode="border", align_corners=False)
    return found[0, :, 0].T
