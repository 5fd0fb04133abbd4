"""What an object that left had stood on or leant against: planes that go on where it was.

A few new photos agree on many geometries; what is known of the ground keeps haze out of the place where the object was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refield.field.render import render_many
from refield.field.warp import crosses
from refield.scene.capture import Rays
from refield.scene.change import OccupancyGrid
from refield.scene.planes import Plane, rough_planes
from refield.update.cut import Known
from refield.update.region import Region
from refield.update.supervision import Lessons

_POINTS = 6000  # that planes are looked for among
_RIM = 0.12  # of an object's mean side
_TOUCHED = 0.02  # the quantile of its heights above a plane, of what it touches
_RAYS = 12_000  # that planes are looked for along


@dataclass(frozen=True)
class GroundConfig:
    """What is known of the ground that objects stood on; the paper learns it as anything else."""

    footholds: bool = True
    """nothing is beyond the planes that objects stood on or leant against, and haze over them is dear"""
    textured: bool = True
    """these planes get the texture that the new photos show, by least squares; else the helper learns them"""
    patterned: bool = True
    """where no photo shows these planes they go on as around there, in their own pattern; else that is the helper's"""
    reach: float = 2.0
    """within each object's grid at its old and its new place, its box this many times as large (the paper: 2 to 3).
    When the object moves on, what lies within `composite.DILATION` times its box is forgotten."""


def ground_of(
    known: Known, old: Lessons, wide: Region, eyes: Tensor, resolved: float, draw: torch.Generator
) -> list[Foothold]:
    """What stood on planes where something is to be learnt: the objects that left, and what is left to learn of places
    that earlier visits know. The planes are looked for along the rays of the old photos that teach, else along those of
    the new ones that pass nearby.

    Args:
        wide: where something is to be learnt.
        eyes: (C, 3) old cameras' centres.
        resolved: how exact the old field's surfaces are, world units.
    """
    cut, shown, rays = known.cut, known.cut.pretrained, old.rays
    if len(rays) == 0:
        near = crosses(known.sparse.rays, wide.around)
        shown, rays = cut, known.sparse.rays[near.nonzero()[:, 0]]
    rays = rays[torch.randperm(len(rays), generator=draw)[:_RAYS]]
    points = rays.origins + rays.directions * render_many(shown, rays).depth[:, None]
    planes = planes_around(points, wide.box, eyes, resolved, draw)
    left = [o.grid for o in cut.to_learn.objects if o.kind != "added"]
    return footholds(left + list(cut.earlier.unknown.grids), planes)


def rim(grid: OccupancyGrid) -> float:
    """How deep an object's rim is, world units: so near it came to what it stood on; what is deeper was all its own."""
    return _RIM * float(grid.tight_aabb().diff(dim=0).mean())


def footholds(grids: Sequence[OccupancyGrid], planes: Sequence[Plane]) -> list[Foothold]:
    """Where what stood in the grids, and left, had touched planes."""
    found: list[Foothold] = []
    for grid in grids:
        occupied = grid.occupied().numpy()
        if not len(occupied):
            continue
        reach = rim(grid)
        touched = (p for p in planes if abs(float(np.quantile(p.height(occupied), _TOUCHED))) < reach)
        found += [Foothold(p, grid, reach) for p in touched]
    return found


@dataclass(frozen=True)
class Foothold:
    """A part of a plane on which an object stood or against which it leant."""

    plane: Plane
    grid: OccupancyGrid
    """the object's"""
    reach: float
    """world units above the plane, where the object is asked whether it stood there"""

    def holds(self, x: Tensor) -> Tensor:
        """Whether world points (N, 3) lie above or beneath it, (N,) bool."""
        normal = torch.from_numpy(self.plane.normal).to(x.dtype)
        height = torch.from_numpy(self.plane.height(x.numpy()))
        return self.grid.contains(x + (self.reach - height)[:, None] * normal)

    def entered(self, rays: Rays) -> Tensor:
        """Distances (N,) at which rays go through it from the front; infinite where they do not."""
        normal = torch.from_numpy(self.plane.normal).to(rays.origins.dtype)
        down = -(rays.directions @ normal)
        t = torch.from_numpy(self.plane.height(rays.origins.numpy())) / down.clamp_min(1e-6)
        met = (down > 1e-6) & (t > 0)
        rows = met.nonzero()[:, 0]
        met[rows] = self.holds(rays.origins[rows] + t[rows, None] * rays.directions[rows])
        return torch.where(met, t, torch.inf)


def planes_around(points: Tensor, box: Tensor, eyes: Tensor, resolved: float, draw: torch.Generator) -> list[Plane]:
    """Planes among surface points (N, 3) in and around a world box (2, 3).

    Args:
        eyes: (C, 3) camera centres, from which the planes are seen.
        resolved: how exact the points are, world units.
    """
    near = points[((points - box.mean(0)).abs() < (box[1] - box[0]).max()).all(-1)]
    some = near[torch.randperm(len(near), generator=draw)[:_POINTS]].double().numpy()
    return rough_planes(some, eyes.double().numpy(), resolved)
