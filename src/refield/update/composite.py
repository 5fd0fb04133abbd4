"""The updated field: the old one, looked up where things were, and a helper where they no longer are (Eqs. 4, 5).

Who answers for a point: an object that moved in (Eq. 3), else the helper inside its region, else an earlier state that
knows what is there (`refield.update.recall`), else the old field in the new light. Without a helper the old objects are
cut out: nothing is left inside them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace

import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_camera
from refield.field.sampling import OccupancySampler
from refield.field.source import Source
from refield.field.volrend import Rendering, Samples
from refield.field.warp import Move, inside_box, moves_of
from refield.scene.capture import Rays
from refield.scene.change import OccupancyGrid, SceneChange
from refield.scene.notebook import SIDE, drawn, facts, strip
from refield.scene.pose import rotate
from refield.update.cells import Cells, cells_of
from refield.update.learnt import NOTHING_EARLIER, NOTHING_LEARNT, NOTHING_TAKEN, Earlier, Learnt, TakenBack
from refield.update.marching import Marching
from refield.update.paper.field import PaperField
from refield.update.region import Region, carved, finer, move_out
from refield.update.routing import SKIN, Routing

DILATION = 2.0
"""M_out is the object's grid, its box this many times as large (§10.1.3: 2 to 3)."""

_DEPTH = 10.0  # optical depth of a sample of what changed that lies in a textured plane
_NODES = 500  # of a grid, that are asked instead of all
_WHOLE = 0.8  # of them must be the same move's, for an object to be the one that it moved


class UpdatedField:
    """A Field of the scene after a change. The old field and the change are shared, not copied."""

    def __init__(
        self,
        pretrained: Field,
        change: SceneChange,
        learnt: Learnt = NOTHING_LEARNT,
        *,
        eyes: Tensor | None = None,
        earlier: Earlier = NOTHING_EARLIER,
        taken: TakenBack = NOTHING_TAKEN,
        sampler: OccupancySampler | None = None,
    ) -> None:
        """What a visit adds to the old field.

        Args:
            learnt: from the new photos.
            eyes: (C, 3) centres of the old cameras: moved objects are not asked along directions that none of them
                looked along.
            earlier: what earlier visits know; objects of the change that it names as undone are as the old field shows
                them.
            taken: what later visits took back.
            sampler: where to look; found anew where things changed unless it is given.
        """
        self.pretrained, self.change, self.eyes = pretrained, change, eyes
        self.earlier, self.taken = earlier, taken
        self.skipped, self.untaught = taken.skipped | {origin.object for origin in earlier.undone}, taken.untaught
        self.helper, self.light, self.shading, self.bare = learnt.helper, learnt.light, learnt.shading, learnt.bare
        self.why_stopped = ""
        """what ended the helper's training, in words; empty if it was not trained here"""
        self.notes: tuple[str, ...] = ()
        """what was left out when it was trained, and what it costs, in words"""
        self.region = self._usual_region() if learnt.region is None else learnt.region
        self.moves: tuple[Move, ...] = moves_of(_part(change, self.skipped))
        self.sources = tuple(source_of(pretrained, m.grid) for m in self.moves)
        self.routing = Routing(self)
        self.boxes = self.routing.boxes
        self._opaque = _DEPTH / finer(pretrained.sampler).step  # density of a plane whose texture is known
        before = pretrained if isinstance(pretrained, UpdatedField) else None
        cells_before = None if before is None else before._cells
        self._cells: Cells = cells_of(self.routing, earlier.ground, pretrained.sampler, cells_before)
        none = pretrained.sampler.grid.new_zeros(0, dtype=torch.long)
        self.unseen: Tensor = none if before is None else before.unseen
        """flat indices of the sampler's cells that are not shown, see `unshown`"""
        if sampler is None:
            sampler = self._without_unseen(pretrained.sampler.refreshed(self.density, self.boxes))
        self._look_where(sampler)

    def _look_where(self, sampler: OccupancySampler) -> None:
        self.sampler = sampler
        before = self.pretrained._marching if isinstance(self.pretrained, UpdatedField) else None
        self._marching: Marching = Marching(self, self._cells, before)

    def _usual_region(self) -> Region:
        rest, step = self.to_learn, self.pretrained.sampler.step
        region = carved(rest, SKIN * step) if self.helper is None else move_out(rest, DILATION)
        return Region(region.grids + self.earlier.unknown.grids)

    @property
    def learnt(self) -> Learnt:
        """What its visit learnt, the region found."""
        return Learnt(self.helper, self.region, self.light, self.shading, self.bare)

    def __repr__(self) -> str:
        return f"UpdatedField({self.change.kinds}; before: {self.pretrained!r})"

    def _repr_html_(self) -> str:
        rows: list[tuple[str, object]] = [("this change", self.change.kinds), ("before", self.pretrained)]
        rows += [("note", note) for note in (self.why_stopped, *self.notes) if note]
        pictures = []
        for frame in self.change.frames[:1]:
            camera = frame.camera.within(SIDE * SIDE)
            for name, field in (("before", self.pretrained), ("after", self)):
                pictures.append(
                    (f"{frame.name}, {name}", drawn(render_camera(field, camera, frame.world_from_cam).rgb))
                )
        return facts("UpdatedField", rows) + strip(pictures)

    @property
    def to_learn(self) -> SceneChange:
        """The change without the objects about which an earlier visit knows everything."""
        return _part(self.change, self.skipped | {origin.object for origin in self.earlier.left})

    def unshown(self, cells: Tensor) -> UpdatedField:
        """The same field, empty in those of its sampler's cells (flat indices) that nothing new answers for; so are the
        fields that later visits make of it."""
        out = copy(self)
        out.unseen = torch.cat([self.unseen, cells]).unique()
        out._look_where(out._without_unseen(self.sampler))
        return out

    def but(
        self,
        *,
        pretrained: Field | None = None,
        change: SceneChange | None = None,
        learnt: Learnt | None = None,
        earlier: Earlier | None = None,
        taken: TakenBack | None = None,
    ) -> UpdatedField:
        """The same update with other parts, as of the constructor; where to look is found anew."""
        out = UpdatedField(
            self.pretrained if pretrained is None else pretrained,
            self.change if change is None else change,
            self.learnt if learnt is None else learnt,
            eyes=self.eyes,
            earlier=self.earlier if earlier is None else earlier,
            taken=self.taken if taken is None else taken,
        ).unshown(self.unseen)
        out.why_stopped = self.why_stopped
        return out

    def _without_unseen(self, sampler: OccupancySampler) -> OccupancySampler:
        grid = sampler.grid.clone()
        grid.view(-1)[self.unseen] *= self._cells.told.view(-1)[self.unseen]
        grid.view(-1)[self._cells.empty] = 0
        return replace(sampler, grid=grid)

    def samples(self, rays: Rays, jitter: bool = False) -> Samples:
        """Where to evaluate the field along rays, see `refield.update.marching`."""
        return self._marching.samples(rays, jitter)

    @property
    def rendered(self) -> Callable[[Rays, int], Rendering] | None:
        """Shows N rays, without gradients, so many at once; None if the field of the first visit is no hash field."""
        return self._marching.rendered

    def unchanged(self, rays: Rays) -> tuple[Field, Tensor]:
        """The field before, and which of N rays show what it shows, (N,) bool: they meet no cell in which this visit
        says anything, be it that nothing is there or that the light is another."""
        return self._marching.unchanged(rays)

    def arrived(self, x: Tensor) -> Tensor:
        """Which move each world point (S, 3) is answered by, (S,) int64, -1 for none."""
        return self.routing.arrived(x)

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        flat = x.reshape(-1, 3)
        to = self.routing.of(flat)
        sigma = flat.new_zeros(len(flat)).index_copy(0, to.old, self.pretrained.density(to.asked[to.old]))
        for found in to.sourced:
            sigma = sigma.index_copy(0, found.rows, found.source.density(found.x))
        for field, rows in ((self.helper, to.helper), (self.earlier.ground, to.ground)):
            if field is not None and len(rows):
                sigma = sigma.index_copy(0, rows, field.density(flat[rows]))
        for plane, rows in to.planes:
            sigma = sigma.index_copy(0, rows, self._opaque * plane.opaque(flat[rows]))
        return sigma.reshape(x.shape[:-1])

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3) and unit directions (..., 3) -> sigma (...,) and rgb (..., 3) in [0, 1] (Eq. 5)."""
        flat, along = x.reshape(-1, 3), d.reshape(-1, 3)
        to = self.routing.of(flat, along)
        s, c = self.pretrained(to.asked[to.old], to.turned[to.old])
        c = self._relit(to.asked[to.old], c, to.owner[to.old])
        sigma = flat.new_zeros(len(flat)).index_copy(0, to.old, s)
        rgb = torch.zeros_like(flat).index_copy(0, to.old, c)
        for found in to.sourced:
            rows = found.rows
            s, c = found.source(found.x, rotate(found.source.then_from_now, to.turned[rows]))
            c = self._relit(to.asked[rows], c, to.owner[rows])
            sigma, rgb = sigma.index_copy(0, rows, s), rgb.index_copy(0, rows, c)
        if self.helper is not None and len(to.helper):
            s, c = self.helper(flat[to.helper], along[to.helper])
            sigma, rgb = sigma.index_copy(0, to.helper, s), rgb.index_copy(0, to.helper, c)
        if self.earlier.ground is not None and len(to.ground):
            s, c = self.earlier.ground(flat[to.ground], along[to.ground])
            c = self._relit(flat[to.ground], c, to.owner[to.ground])
            sigma, rgb = sigma.index_copy(0, to.ground, s), rgb.index_copy(0, to.ground, c)
        for plane, rows in to.planes:
            sigma = sigma.index_copy(0, rows, self._opaque * plane.opaque(flat[rows]))
            rgb = rgb.index_copy(0, rows, plane.colours(flat[rows], along[rows]))
        return sigma.reshape(x.shape[:-1]), rgb.reshape(x.shape)

    def _relit(self, asked: Tensor, rgb: Tensor, owner: Tensor) -> Tensor:
        """Colours of the old field (S, 3), asked for at (S, 3), in the new light; ``owner`` (S,) is -1 for what did
        not move."""
        for i, light in enumerate((self.light, *self.shading), start=-1):
            if light is not None:
                mine = (owner == i).nonzero()[:, 0]
                rgb = rgb.index_copy(0, mine, light.applied(asked[mine], rgb[mine]))
        return rgb


def some_of(grid: OccupancyGrid) -> Tensor:
    """Some hundreds of a grid's occupied nodes, spread over it, (K, 3) world."""
    x = grid.occupied()
    return x[:: max(1, len(x) // _NODES)]


def source_of(field: Field, grid: OccupancyGrid) -> Source | None:
    """Where a field that has had updates looks up the object that ``grid`` holds; None if it does not move it as a
    whole, or has learnt parts of it since."""
    if not isinstance(field, UpdatedField):
        return None
    x = some_of(grid)
    to = field.routing.of(x)
    owner = to.owner.clone()
    owner[to.helper] = owner[to.ground] = owner[to.textured] = -2
    i = int(owner.mode().values) if len(x) else -2
    if i == -2 or float((owner == i).float().mean()) < _WHOLE:
        return None
    still = torch.eye(4, dtype=torch.float64)
    if i == -1:
        found, light, pose = source_of(field.pretrained, grid), field.light, still
    else:
        if any(bool(inside_box(bare.aabb.mean(0), field.moves[i].box_now)) for bare in field.bare.grids):
            return None
        found = field.sources[i] or Source(
            field.pretrained, field.routing.shells[i].grid, still, field.routing.outlooks[i]
        )
        light, pose = field.shading[i] if i < len(field.shading) else None, field.moves[i].new_from_old
    if found is None:
        return None
    lights = found.lights if light is None else (*found.lights, (found.now_from_then, light))
    return replace(found, now_from_then=pose @ found.now_from_then, lights=lights)


def layers_of(field: Field) -> Iterator[UpdatedField | PaperField]:
    """The updates that a field has had, by either route, the latest first."""
    while isinstance(field, UpdatedField | PaperField):
        yield field
        field = field.pretrained


def _part(change: SceneChange, without: frozenset[int]) -> SceneChange:
    """A change without some of its objects."""
    kept = tuple(o for i, o in enumerate(change.objects) if i not in without)
    return change if len(kept) == len(change.objects) else replace(change, objects=kept)
