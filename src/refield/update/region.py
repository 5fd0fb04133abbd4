"""Where the old field no longer speaks: the move-out region M_out and its exceptions (§10.1.2, §10.1.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from refield.field.encoding import Contraction
from refield.field.render import CHUNK
from refield.field.sampling import OccupancySampler
from refield.field.warp import crossing, outline
from refield.scene.capture import Rays
from refield.scene.change import OccupancyGrid, SceneChange
from refield.update.textured import TexturedPlane

_FINER = 0.5  # length of the samples of what changed, in samples of the old field: about a pixel in place of two
_CELLS = 64, 160  # of a region's grid along a side, at least and, for memory, at most
_ROOM = 1.02  # how much larger than the region's box its space is


@dataclass(frozen=True)
class Region:
    """A union of grids in the world, and planes whose texture is known."""

    grids: tuple[OccupancyGrid, ...]
    planes: tuple[TexturedPlane, ...] = ()

    @cached_property
    def boxes(self) -> tuple[Tensor, ...]:
        """A (2, 3) world box around each grid and each plane."""
        return tuple(outline(g) for g in self.grids) + tuple(p.box for p in self.planes)

    @property
    def box(self) -> Tensor:
        """(2, 3) around them all. Raises ValueError if there is none."""
        if not self.boxes:
            raise ValueError("an empty region has no box")
        boxes = torch.stack(self.boxes)
        return torch.stack([boxes[:, 0].amin(0), boxes[:, 1].amax(0)])

    @property
    def around(self) -> list[Tensor]:
        """World boxes (2, 3) three times as large as its own."""
        return [torch.stack([2 * b[0] - b[1], 2 * b[1] - b[0]]) for b in self.boxes]

    def contains(self, x: Tensor) -> Tensor:
        """Whether world points (..., 3) are in its grids, (...,) bool."""
        flat = x.detach().reshape(-1, 3)
        found = torch.zeros(len(flat), dtype=torch.bool, device=x.device)
        for grid in self.grids:
            found |= grid.contains(flat)
        return found.reshape(x.shape[:-1])

    def sampler(self, step: float) -> OccupancySampler:
        """Looks everywhere in the region and nowhere else; its core cube is the region's bounding cube.

        Its cells are as wide as a sample is long, within what memory affords.
        """
        box = self.box
        space = Contraction(box.mean(0), float((box[1] - box[0]).max()) / 2 * _ROOM)
        resolution = int(min(max(4 * space.radius / step, _CELLS[0]), _CELLS[1]))
        empty = OccupancySampler(space, torch.zeros(resolution, resolution, resolution, dtype=torch.uint8), step)
        cells = empty.cells_in(box)
        grid = empty.grid.clone()
        grid.view(-1)[cells] = self.contains(empty.points_in(cells, jitter=False)).to(torch.uint8)
        return replace(empty, grid=grid)


def region_out(name: str, region: Region) -> dict[str, Tensor]:
    """A region's grids as named tensors."""
    out: dict[str, Tensor] = {}
    for i, grid in enumerate(region.grids):
        out |= {f"{name}.{i}.aabb": grid.aabb.clone(), f"{name}.{i}.values": grid.values.clone()}
    return out


def region_in(name: str, count: int, tensors: dict[str, Tensor]) -> Region:
    """Inverse of :func:`region_out`. Raises KeyError if a grid is missing."""
    keys = [f"{name}.{i}" for i in range(count)]
    return Region(tuple(OccupancyGrid(tensors[f"{k}.aabb"], tensors[f"{k}.values"]) for k in keys))


def finer(sampler: OccupancySampler) -> OccupancySampler:
    """A sampler that looks where another does, with the shorter samples of what changed.

    A surface is as thick as a sample is long, and in a thick one each of a few photos may have a layer of its own.
    """
    return replace(sampler, step=_FINER * sampler.step, per_step=1.0)


def forgotten(planes: Sequence[TexturedPlane], places: Region, but: Region) -> tuple[TexturedPlane, ...]:
    """Planes without what they know of some places, but for some others."""
    gone = [(places.contains(p.nodes) & ~but.contains(p.nodes)).reshape(p.known.shape) for p in planes]
    return tuple(replace(p, known=p.known & ~g) for p, g in zip(planes, gone) if (p.known & ~g).any())


def without_planes(sampler: OccupancySampler, planes: Sequence[TexturedPlane]) -> OccupancySampler:
    """A sampler that looks where another does, but not into cells of planes whose texture is known."""
    grid = sampler.grid.clone()
    for plane in planes:
        cells = grid.view(-1).nonzero()[:, 0]
        x = sampler.points_in(cells, jitter=False)
        grid.view(-1)[cells[plane.contains(x)]] = 0
    return replace(sampler, grid=grid)


def meets(sampler: OccupancySampler, rays: Rays) -> Tensor:
    """Whether each of N rays passes an occupied cell, (N,) bool. The sampler is one of `Region.sampler`."""
    space = sampler.contraction
    near, far = crossing(rays, torch.stack([space.centre - space.radius, space.centre + space.radius]))
    out = far > near  # the core cube, beyond which there is no region
    for rows in out.nonzero()[:, 0].split(CHUNK):
        out[rows] = sampler(rays[rows]).ray_offsets.diff() > 0
    return out


def move_out(change: SceneChange, factor: float) -> Region:
    """M_out: every object's grid, its box dilated ``factor`` times (§10.1.3; 2 to 3). An added object's is where it is.

    What moved in there is taken out of it where the region is used: move-in wins (§10.1.2).
    """
    return Region(tuple(o.grid.dilated(factor) if factor > 1 else o.grid for o in change.objects))


def carved(change: SceneChange, skin: float = 0.0) -> Region:
    """What was inside the objects that moved or left, and within ``skin`` (world units) of them: nothing of the old
    field is true there any more."""
    return Region(tuple(grown(o.grid, skin) for o in change.objects if o.kind != "added"))


def grown(grid: OccupancyGrid, reach: float) -> OccupancyGrid:
    """A grid grown by ``reach`` world units on every side."""
    box = grid.tight_aabb()
    return grid if reach == 0 else grid.dilated(1 + 2 * reach / float((box[1] - box[0]).mean()))
