"""The helper: a small hash field over the region around what changed, trained from scratch (§4.1.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional

from refield.field.occupancy import OccupancyTrainer
from refield.field.radiance import Field, HashField, HashFieldConfig
from refield.field.sampling import OccupancySampler
from refield.scene.capture import Frame
from refield.scene.change import OccupancyGrid, SceneChange
from refield.update.ground import Foothold, rim
from refield.update.region import Region, grown
from refield.update.unseen import Sight

_SHAPE = HashFieldConfig(levels=8, coarsest=16, log2_table=15)  # of a region, a small part of a scene
_FINE = 1.5  # pixels of the nearest new photo, the side of a finest cell; so many of these along the space at least and
_FINEST = 64, 2048  # at most
_OPACITY = 5e-2  # a cell is shown if a sample in it is more opaque than this
_CULL_FROM = 64  # steps, from which on cells that no ray sees are left out
_PROBES = 4  # points of a cell that are asked for it
_WEIGHT = 5e-3  # and it or a neighbour gave some ray this much of its colour
_RIM = 0.5  # as empty as this is the rim of what stood on a plane, and everything beneath the plane
_BESIDE = 1.5  # cells of the old field; so far around an object that left its fitted surface may be taken for something
_BAND = 2.5  # cells above and beneath what an object stood on over which it becomes so empty


def new_helper(
    region: OccupancySampler, frames: tuple[Frame, ...], seed: int, *, directions: bool = False
) -> HashField:
    """A fresh helper that looks everywhere in ``region``; its finest cells are 1.5 pixels of the nearest photo.

    Its colours do not depend on the direction unless ``directions``: what a few photos say about that does not hold
    between them.
    """
    space = region.contraction
    pixel = min(float((f.centre.float() - space.centre).norm()) / max(f.camera.fx, f.camera.fy) for f in frames)
    finest = int(min(max(4 * space.radius / (_FINE * pixel), _FINEST[0]), _FINEST[1]))
    helper = HashField(replace(_SHAPE, finest=finest), region, seed)
    if not directions:
        with torch.no_grad():
            without_directions(helper, [helper.encoding.tables, *helper.networks])
    return helper


def without_directions(helper: HashField, into: list[Tensor]) -> None:
    """Zero what belongs to all harmonics of the direction but the constant one, of tensors shaped as the helper's
    tables and matrices."""
    into[3][:, helper.config.geometry_features + 1 :] = 0


def step_near(field: Field, point: Tensor) -> float:
    """Length of the old field's samples at a world point (3,), world units."""
    s = field.sampler
    return s.step * max(float(s.contraction.reach(point)), 1.0) ** 1.5


def emptiness(
    change: SceneChange,
    cells: OccupancySampler,
    taken: Region,
    ground: Sequence[Foothold] = (),
    sight: Sight | None = None,
) -> Tensor:
    """How surely nothing is in each cell, (R**3,) float32: 0 where there may be something, 1 where nothing can be.

    What stood in the way of everything is not there any more: deep inside an object that left is nothing, and only
    near its surface may something else begin: the ground under it, the wall behind it. Where that is one of
    ``ground``, it is there, and the more so the nearer to it; what is above it near the object's surface is half as
    empty, since a wall that the object leant on may not be among them; so is what lies above it right beside the
    object, where the old field shows the object's own skin. Where old photos looked through (``sight``), nothing is.
    0 in ``taken``, where something stands now.
    """
    r = cells.resolution
    depth = torch.zeros(r**3)
    cell = 4 * cells.contraction.radius / r
    centres = cells.points_in(torch.arange(r**3), jitter=False)
    left = [o.grid for o in change.objects if o.kind != "added"]
    left += [f.grid for f in ground if all(f.grid is not g for g in left)]
    for grid in left:
        if not len(grid.occupied()):
            continue
        inside = grid.contains(centres)
        if inside.any():  # not of what is thinner than a cell
            distance = distance_transform_edt(inside.reshape(r, r, r).numpy())
            deep = torch.from_numpy(distance).float().reshape(-1) * cell / rim(grid) - 1
            depth = torch.maximum(depth, deep.clamp(0, 1))
        above = [f.plane.height(centres.numpy()) > _band(f, cell) for f in ground if f.grid is grid]
        if above:
            near = inside if sight is None else grown(grid, _skin(grid, sight.sampler)).contains(centres)
            free = near & torch.from_numpy(np.logical_and.reduce(above))
            depth[free] = depth[free].clamp_min(_RIM)
    dark = None if sight is None else sight.dark.occupied(centres)
    for foothold in ground:
        height, band = torch.from_numpy(foothold.plane.height(centres.numpy())), _band(foothold, cell)
        off = ((height.abs() - 2 * foothold.plane.noise) / band).clamp(0, 1)
        here = (height < band) & foothold.holds(centres)
        if dark is not None:  # a table's legs are no mist
            here &= (height > -band) | dark
        depth[here] = torch.maximum(depth[here], _RIM * off[here])
    if sight is not None:
        depth[~sight.possible.occupied(centres)] = 1.0
    return torch.where(taken.contains(centres), 0.0, depth) if taken.grids else depth


def _skin(grid: OccupancyGrid, sampler: OccupancySampler) -> float:
    """How far around an object the old field may show the object's own skin, world units; no further than its rim is
    deep, since around what is small or far away a cell holds much else."""
    width = sampler.width(sampler.contraction.reach(grid.tight_aabb().mean(0)))
    return min(_BESIDE * float(width), rim(grid))


def _band(foothold: Foothold, cell: float) -> float:
    return max(_BAND * cell, 2 * foothold.plane.noise)


class HelperOccupancy(OccupancyTrainer):
    """The helper's occupancy grid in training: the engine's, never outside the region, nor where nothing can be.

    A price on what is shown there would not do: where that is most of the region, it empties the helper before a small
    thing begins to show.
    """

    def __init__(self, helper: HashField, draw: torch.Generator, nothing: Tensor) -> None:
        """``nothing``: (R**3,) bool, in which cells nothing can be."""
        allowed = (helper.sampler.grid.reshape(-1) > 0) & ~nothing
        helper.looking_where(allowed.to(torch.uint8).reshape(helper.sampler.grid.shape))
        super().__init__(helper, _CULL_FROM, allowed, doubt=0.0, draw=draw)

    def finish(self) -> None:
        """The grid to show: opaque cells next to what training rays saw. Few photos see little of a surface; a view
        between them must find no holes in it."""
        cells, helper, s = self.allowed.nonzero()[:, 0], self.model, self.model.sampler
        helper.train()  # ask everywhere, not only where training looked last
        with torch.no_grad():
            points = (s.points_in(cells, jitter=i > 0, draw=self.draw) for i in range(_PROBES))
            sigma = torch.stack([helper.density(x) for x in points]).amax(0)
        opaque = torch.zeros_like(s.grid)
        opaque.view(-1)[cells] = (-torch.expm1(-sigma * s.step) > _OPACITY).to(torch.uint8)
        seen = (self.weight > _WEIGHT).reshape(1, 1, *s.grid.shape).float()
        near = functional.max_pool3d(seen, 5, stride=1, padding=2)[0, 0] > 0
        helper.looking_where(opaque * near)
        helper.eval()
