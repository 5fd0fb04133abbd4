"""Where an updated field is asked along rays: what never changed as the first visit's field knows best, what changed by
the cells that hold it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from refield.field.kernels.reference import offsets_of
from refield.field.nerfacto import NerfactoField
from refield.field.nerfstudio import NerfstudioField
from refield.field.radiance import Field, HashField
from refield.field.render import parted, visible_samples
from refield.field.sampling import OccupancySampler
from refield.field.volrend import Rendering, Samples, interleaved
from refield.field.warp import leaving
from refield.scene.capture import Rays
from refield.scene.inside import spans
from refield.update.cells import Cells
from refield.update.light import Relighting, lights_of
from refield.update.region import finer
from refield.update.view import View, boxes_around

if TYPE_CHECKING:
    from refield.update.composite import UpdatedField

_MARGIN = 2.5  # cells, by which boxes grow: one whose centre is outside may hold a corner that is inside

Base = HashField | NerfactoField | NerfstudioField


class Marching:
    """Of one update, whose sampler does not change any more: what is looked up once is kept, since marching remembers
    a grid."""

    def __init__(self, field: UpdatedField, cells: Cells, before: Marching | None) -> None:
        """``before``: of the field before, if that is an update as well."""
        self.field, self.cells = field, cells
        first = field.pretrained if isinstance(field.pretrained, Base) else None
        self.base: Base | None = first if before is None else before.base
        """the field of the first visit, if it is one of those that know where to look"""
        earlier = () if before is None else before.boxes
        self.boxes: tuple[Tensor, ...] = tuple(_by_cells(field.sampler, b) for b in field.boxes) + earlier
        """(2, 3) each, world: hold all that changed"""
        self.lights: tuple[Relighting, ...] = (() if before is None else before.lights) + (
            () if field.light is None else (field.light,)
        )
        """on what never changed, one after the other"""
        self.updated_before = before is not None

    def samples(self, rays: Rays, jitter: bool = False) -> Samples:
        """Where to evaluate the field along rays; nothing behind the first opaque surface that never changed.

        Cells that changed at this visit or an earlier one are all looked at; elsewhere the field is that of the
        first visit, and marching through its density network ends a ray, or its proposal networks say where to look:
        behind what is no longer there, too (§10.1.2).
        """
        if self.base is None or not self.boxes:
            field = self.field
            return field.sampler(rays, jitter) if field.boxes else visible_samples(field.pretrained, rays, jitter)
        if isinstance(self.base, NerfactoField | NerfstudioField):
            known = self.base.samples(
                rays, jitter, without=replace(self.field.sampler, grid=self.cells.retold, fine=None).occupied
            )
            mid, d = known.positions(rays)
            start = mid - d * ((known.t_ends - known.t_starts) / 2)[:, None]
            # an interval that begins where a surface was seen may reach beneath it
            unshown = self._unshown
            known = known.only(~(unshown.occupied(mid) & unshown.occupied(start)))
        else:
            known = self.split[0].visible(rays, self.base.density_net, jitter)
        return interleaved(known, self._told_samples(rays, jitter))

    @property
    def _unshown(self) -> OccupancySampler:
        """Looks into the cells alone that are not shown."""
        grid = torch.zeros_like(self.field.sampler.grid)
        grid.view(-1)[self.field.unseen] = 1 - self.cells.told.view(-1)[self.field.unseen]
        return replace(self.field.sampler, grid=grid, fine=None)

    @property
    def rendered(self) -> Callable[[Rays, int], Rendering] | None:
        """Shows N rays, without gradients, so many at once; None if the field of the first visit is no hash field."""
        view = self._view
        if view is None or not self.updated_before:
            return None if view is None else view.rendered
        return lambda rays, chunk: parted(*self.unchanged(rays), rays, chunk, lambda rest: view.rendered(rest, chunk))

    @cached_property
    def _view(self) -> View | None:
        if not isinstance(self.base, HashField) or not self.boxes:
            return None
        known, told = self.split
        gone = ((self.base.sampler.grid > 0) & (known.grid == 0)).to(torch.uint8)
        lights = lights_of([small for light in self.lights if (small := light.cropped()) is not None])
        return View(self.base, gone, told, boxes_around(told, self.boxes), lights, self.field)

    def unchanged(self, rays: Rays) -> tuple[Field, Tensor]:
        """The field before, and which of N rays show what it shows, (N,) bool: they meet no cell in which this visit
        says anything, be it that nothing is there or that the light is another."""
        cells, boxes = self._changed
        same = torch.ones(len(rays), dtype=torch.bool, device=rays.origins.device)
        if boxes:
            enter, leave = spans(rays, torch.stack(boxes))
            near = (leave > 0).nonzero()[:, 0]
            same[near] = cells.first(rays[near], enter[near], leave[near]).isinf()
        return self.field.pretrained, same

    @cached_property
    def _changed(self) -> tuple[OccupancySampler, tuple[Tensor, ...]]:
        """Looks into the cells in which this visit says anything; and world boxes (2, 3) that hold them all."""
        field, sampler = self.field, self.field.sampler
        grid = self.cells.said | (sampler.grid != field.pretrained.sampler.grid).to(torch.uint8)
        boxes = list(field.boxes)
        if field.light is not None:
            grid |= field.light.cells(sampler)
            boxes.append(field.light.aabb)
        if len(field.unseen):
            x = sampler.points_in(field.unseen, jitter=False)
            boxes.append(torch.stack([x.amin(0), x.amax(0)]))
        return finer(replace(sampler, grid=grid, fine=None)), tuple(_by_cells(sampler, b) for b in boxes)

    @cached_property
    def split(self) -> tuple[OccupancySampler, OccupancySampler]:
        """The sampler of what never changed and that of the rest, which is finer."""
        sampler, told = self.field.sampler, self.cells.retold
        return replace(sampler, grid=sampler.grid * (1 - told)), finer(replace(sampler, grid=sampler.grid * told))

    def _told_samples(self, rays: Rays, jitter: bool) -> Samples:
        """All samples in cells that changed; only the rays that come near any are marched, and no further."""
        exits = torch.stack([leaving(rays, box) for box in self.boxes]).amax(0)
        near = (exits > 0).nonzero()[:, 0]
        far = float(exits.max()) / self.field.sampler.contraction.radius if len(near) else 0.0
        _, told = self.split
        found = replace(told, far=min(far, told.far))(rays[near], jitter)
        counts = near.new_zeros(len(rays)).index_copy(0, near, found.ray_offsets.diff())
        return Samples(found.t_starts, found.t_ends, offsets_of(counts))


def _by_cells(sampler: OccupancySampler, box: Tensor) -> Tensor:
    """A world box (2, 3) grown by two and a half of the sampler's cells."""
    margin = _MARGIN * float(sampler.width(sampler.contraction.reach(box)).max())
    return torch.stack([box[0] - margin, box[1] + margin])
