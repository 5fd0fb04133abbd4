"""The updated field: the old one, looked up where things were, and a helper where they no longer are (Eqs. 4, 5).

Who answers for a point: an object that moved in (Eq. 3), else the helper inside its region, else an earlier state that
knows what is there (`refield.update.recall`), else the old field in the new light. Without a helper the old objects are
cut out: nothing is left inside them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from refield.field.nerfacto import NerfactoField
from refield.field.nerfstudio import NerfstudioField
from refield.field.outlook import Outlook
from refield.field.radiance import Field, HashField
from refield.field.render import parted, render_camera, visible_samples
from refield.field.sampling import OccupancySampler
from refield.field.source import Source
from refield.field.volrend import Rendering, Samples, interleaved
from refield.field.warp import Move, inside_box, leaving, looked_up, moves_of, owners
from refield.scene.capture import Rays
from refield.scene.change import OccupancyGrid, SceneChange
from refield.scene.inside import in_boxes, spans
from refield.scene.notebook import SIDE, drawn, facts, strip
from refield.scene.pose import rotate, transform
from refield.update.learnt import (
    NOTHING_EARLIER,
    NOTHING_LEARNT,
    NOTHING_TAKEN,
    NOWHERE,
    Earlier,
    Learnt,
    TakenBack,
)
from refield.update.region import Region, carved, finer, grown, move_out
from refield.update.textured import TexturedPlane
from refield.update.view import View, boxes_around, lights_of

DILATION = 2.0
"""M_out is the object's grid, its box this many times as large (§10.1.3: 2 to 3)."""

SKIN = 1.5
"""How much further than its grid a moved object reaches, in samples of the old field"""
SKIN_VACATED = 1.0
"""the same where something left that was solid"""

_DEPTH = 10.0  # optical depth of a sample of what changed that lies in a textured plane
_SOLID = 0.05  # opacity of a sample that was not empty before
_LAYER = 10  # nodes of a grid that make a layer
_NODES = 500  # of a grid, that are asked instead of all
_WHOLE = 0.8  # of them must be the same move's, for an object to be the one that it moved
_PROBES = 8  # points a cell looked up when the sampler is recomputed: a moved surface crosses cells at any angle


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
        self._was = carved(change, SKIN * pretrained.sampler.step) if self.untaught.grids else NOWHERE
        self.helper, self.light, self.shading, self.bare = learnt.helper, learnt.light, learnt.shading, learnt.bare
        self.why_stopped = ""
        """what ended the helper's training, in words; empty if it was not trained here"""
        self.notes: tuple[str, ...] = ()
        """what was left out when it was trained, and what it costs, in words"""
        self.region = region = self._usual_region() if learnt.region is None else learnt.region
        self.sampler_step = pretrained.sampler.step
        self.moves: tuple[Move, ...] = moves_of(_part(change, self.skipped))
        self._shells, self._inner_shells = (
            tuple(Move(grown(m.grid, skin * self.sampler_step), m.new_from_old) for m in self.moves)
            for skin in (SKIN, SKIN_VACATED)
        )
        self._ups = tuple(self._up_of(move, shell) for move, shell in zip(self.moves, self._shells))
        self.outlooks = tuple(None if eyes is None else Outlook.from_eyes(eyes, m.grid) for m in self.moves)
        self.sources = tuple(source_of(pretrained, m.grid) for m in self.moves)
        self.boxes = tuple(m.box_now for m in self._shells) + region.boxes + earlier.places.boxes
        self._opaque = _DEPTH / finer(pretrained.sampler).step  # density of a plane whose texture is known
        self._base: HashField | NerfactoField | NerfstudioField | None = _base_of(pretrained)
        self._own, self._nothing = self._told_cells(pretrained.sampler)
        earlier_told = pretrained._told if isinstance(pretrained, UpdatedField) else self._own
        self._told: Tensor = self._own | earlier_told
        """(R, R, R) uint8: cells whose centre is answered for by a move, a helper or nobody, at this visit or before"""
        none = pretrained.sampler.grid.new_zeros(0, dtype=torch.long)
        self.unseen: Tensor = pretrained.unseen if isinstance(pretrained, UpdatedField) else none
        """flat indices of the sampler's cells that are not shown, see `unshown`"""
        if sampler is None:
            sampler = self._without_unseen(pretrained.sampler.refreshed(self.density, self.boxes, probes=_PROBES))
        self.sampler = sampler
        small = self._small_cells(pretrained.sampler)
        earlier_small = pretrained._small if isinstance(pretrained, UpdatedField) else small
        self._small: Tensor = small | earlier_small
        self._said = _widened(self._own) | small
        self._retold = _widened(self._told) | self._small
        before = pretrained._marched if isinstance(pretrained, UpdatedField) else ()
        self._split_of: tuple[Tensor, tuple[OccupancySampler, OccupancySampler]] | None = None
        self._view_of: tuple[Tensor, View] | None = None
        self._changed_of: tuple[Tensor, tuple[OccupancySampler, tuple[Tensor, ...]]] | None = None
        self._marched: tuple[Tensor, ...] = tuple(_by_cells(self.sampler, b) for b in self.boxes) + before

    def _usual_region(self) -> Region:
        rest, step = self.to_learn, self.pretrained.sampler.step
        region = carved(rest, SKIN * step) if self.helper is None else move_out(rest, DILATION)
        return Region(region.grids + self.earlier.unknown.grids)

    @property
    def learnt(self) -> Learnt:
        """What its visit learnt, the region found."""
        return Learnt(self.helper, self.region, self.light, self.shading, self.bare)

    def __repr__(self) -> str:
        return f"UpdatedField({self._changed_here}; before: {self.pretrained!r})"

    @property
    def _changed_here(self) -> str:
        return ", ".join(f"{count} {kind}" for kind, count in Counter(o.kind for o in self.change.objects).items())

    def _repr_html_(self) -> str:
        rows: list[tuple[str, object]] = [("this change", self._changed_here), ("before", self.pretrained)]
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
        out.sampler = out._without_unseen(self.sampler)
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
            pretrained or self.pretrained,
            change or self.change,
            learnt or self.learnt,
            eyes=self.eyes,
            earlier=self.earlier if earlier is None else earlier,
            taken=taken or self.taken,
        ).unshown(self.unseen)
        out.why_stopped = self.why_stopped
        return out

    def _without_unseen(self, sampler: OccupancySampler) -> OccupancySampler:
        grid = sampler.grid.clone()
        grid.view(-1)[self.unseen] *= self._told.view(-1)[self.unseen]
        grid.view(-1)[self._nothing] = 0
        return replace(sampler, grid=grid)

    def samples(self, rays: Rays, jitter: bool = False) -> Samples:
        """Where to evaluate the field along rays; nothing behind the first opaque surface that never changed.

        Cells that changed at this visit or an earlier one are all looked at; elsewhere the field is that of the
        first visit, and marching through its density network ends a ray, or its proposal networks say where to look:
        behind what is no longer there, too (§10.1.2).
        """
        if self._base is None or not self._marched:
            return visible_samples(self.pretrained, rays, jitter) if not self.boxes else self.sampler(rays, jitter)
        if isinstance(self._base, NerfactoField | NerfstudioField):
            known = self._base.samples(
                rays, jitter, without=replace(self.sampler, grid=self._retold, fine=None).occupied
            )
            mid, d = known.positions(rays)
            start = mid - d * ((known.t_ends - known.t_starts) / 2)[:, None]
            # an interval that begins where a surface was seen may reach beneath it
            unshown = self._unshown
            known = known.only(~(unshown.occupied(mid) & unshown.occupied(start)))
        else:
            known = self._split[0].visible(rays, self._base.density_net, jitter)
        return interleaved(known, self._retold_samples(rays, jitter))

    @property
    def _unshown(self) -> OccupancySampler:
        """Looks into the cells alone that are not shown."""
        grid = torch.zeros_like(self.sampler.grid)
        grid.view(-1)[self.unseen] = 1 - self._told.view(-1)[self.unseen]
        return replace(self.sampler, grid=grid, fine=None)

    @property
    def rendered(self) -> Callable[[Rays, int], Rendering] | None:
        """Shows N rays, without gradients, so many at once; None if the field of the first visit is no hash field."""
        view = self._view
        if view is None or not isinstance(self.pretrained, UpdatedField):
            return None if view is None else view.rendered
        return lambda rays, chunk: parted(*self.unchanged(rays), rays, chunk, lambda rest: view.rendered(rest, chunk))

    @property
    def _view(self) -> View | None:
        if not isinstance(self._base, HashField) or not self._marched:
            return None
        if self._view_of is None or self._view_of[0] is not self.sampler.grid:
            known, told = self._split
            gone = ((self._base.sampler.grid > 0) & (known.grid == 0)).to(torch.uint8)
            lights = [layer.light for layer in layers_of(self) if layer.light is not None]
            view = View(self._base, gone, told, boxes_around(told, self._marched), lights_of(lights[::-1]), self)
            self._view_of = self.sampler.grid, view
        return self._view_of[1]

    def unchanged(self, rays: Rays) -> tuple[Field, Tensor]:
        """The field before, and which of N rays show what it shows, (N,) bool: they meet no cell in which this visit
        says anything, be it that nothing is there or that the light is another."""
        cells, boxes = self._changed
        same = torch.ones(len(rays), dtype=torch.bool, device=rays.origins.device)
        if boxes:
            enter, leave = spans(rays, torch.stack(boxes))
            near = (leave > 0).nonzero()[:, 0]
            same[near] = cells.first(rays[near], enter[near], leave[near]).isinf()
        return self.pretrained, same

    @property
    def _changed(self) -> tuple[OccupancySampler, tuple[Tensor, ...]]:
        """Looks into the cells in which this visit says anything; and world boxes (2, 3) that hold them all. Kept,
        since marching remembers a grid."""
        if self._changed_of is None or self._changed_of[0] is not self.sampler.grid:
            grid = self._said | (self.sampler.grid != self.pretrained.sampler.grid).to(torch.uint8)
            boxes = list(self.boxes)
            if self.light is not None:
                grid |= self.light.cells(self.sampler)
                boxes.append(self.light.aabb)
            if len(self.unseen):
                x = self.sampler.points_in(self.unseen, jitter=False)
                boxes.append(torch.stack([x.amin(0), x.amax(0)]))
            cells = finer(replace(self.sampler, grid=grid, fine=None))
            self._changed_of = self.sampler.grid, (cells, tuple(_by_cells(self.sampler, b) for b in boxes))
        return self._changed_of[1]

    @property
    def _split(self) -> tuple[OccupancySampler, OccupancySampler]:
        """The sampler of what never changed and that of the rest, which is finer; kept, since marching remembers a
        grid."""
        if self._split_of is None or self._split_of[0] is not self.sampler.grid:
            grid, told = self.sampler.grid, self._retold
            parts = replace(self.sampler, grid=grid * (1 - told)), finer(replace(self.sampler, grid=grid * told))
            self._split_of = grid, parts
        return self._split_of[1]

    def _retold_samples(self, rays: Rays, jitter: bool) -> Samples:
        """All samples in cells that changed; only the rays that come near any are marched, and no further."""
        exits = torch.stack([leaving(rays, box) for box in self._marched]).amax(0)
        near = (exits > 0).nonzero()[:, 0]
        far = float(exits.max()) / self.sampler.contraction.radius if len(near) else 0.0
        _, told = self._split
        found = replace(told, far=min(far, told.far))(rays[near], jitter)
        counts = near.new_zeros(len(rays)).index_copy(0, near, found.ray_offsets.diff())
        return Samples(found.t_starts, found.t_ends, torch.cat([counts.new_zeros(1), counts.cumsum(0)]))

    def _told_cells(self, sampler: OccupancySampler) -> tuple[Tensor, Tensor]:
        """(R, R, R) uint8: cells whose centre is answered for by a move, a helper or nobody, at this visit. And those
        (flat indices) in which the state that knows an earlier place shows nothing."""
        empty = [sampler.grid.new_zeros(0, dtype=torch.long)]
        grid = torch.zeros_like(sampler.grid)
        for box in self.boxes:
            cells = sampler.cells_in(box)
            x = sampler.points_in(cells, jitter=False)
            to = self._route(x)
            told = to.owner >= 0
            for rows in (to.helper, to.ground, to.textured):
                told[rows] = True
            grid.view(-1)[cells[told]] = 1
            if self.earlier.ground is not None:
                empty.append(cells[to.ground[~self.earlier.ground.sampler.occupied(x[to.ground])]])
        return grid, torch.cat(empty).unique()

    def _small_cells(self, sampler: OccupancySampler) -> Tensor:
        """(R, R, R) uint8: cells that hold some of what this visit says, be it so small that their centres lie beside
        it."""
        x = [transform(move.new_from_old, move.grid.occupied()) for move in self._shells]
        x += [grid.occupied() for grid in (*self.region.grids, *self.earlier.places.grids)]
        x += [plane.nodes[plane.known.reshape(-1)] for plane in self.region.planes]
        grid = torch.zeros_like(sampler.grid)
        grid.view(-1)[sampler.cells(torch.cat(x)) if x else []] = 1
        return grid

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        flat = x.reshape(-1, 3)
        to = self._route(flat)
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
        to = self._route(flat, along)
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

    def _route(self, x: Tensor, d: Tensor | None = None) -> _Routed:
        """Who answers for world points (S, 3) and directions (S, 3); which, where only densities are asked for, may be
        left out."""
        held, d = d is not None, torch.zeros_like(x) if d is None else d
        owner = torch.full(x.shape[:1], -1, dtype=torch.long, device=x.device)
        near = self._near(x.detach()).nonzero()[:, 0]
        if len(near) == 0:
            return _Routed(x, d, owner, torch.arange(len(x), device=x.device), near, near, (), ())
        mover = self.arrived(x[near])
        owner[near] = mover
        free = mover < 0
        if self.untaught.grids:
            free &= ~self.untaught.contains(x[near]) | self._was.contains(x[near])
        planes, textured = [], torch.zeros_like(free)
        for plane in self.region.planes:
            mine = free & ~textured & plane.contains(x[near])
            planes.append((plane, near[mine]))
            textured |= mine
        helped = free & ~textured & self.region.contains(x[near])
        grounded = (mover < 0) & ~textured & ~helped & self.earlier.places.contains(x[near])
        at, along = looked_up(x[near], d[near], mover, [m.old_from_new for m in self.moves])
        sourced = []
        for i, (outlook, source) in enumerate(zip(self.outlooks, self.sources)):
            mine = (mover == i).nonzero()[:, 0]
            if source is not None:
                then = transform(source.then_from_now, at[mine])
                held_there = source.grid.contains(then)
                sourced.append(_Sourced(source, near[mine[held_there]], then[held_there]))
                mine = mine[~held_there]
            if held and outlook is not None:
                along = along.index_copy(0, mine, outlook.held(at[mine], along[mine]))
        asked, turned = x.index_copy(0, near, at), d.index_copy(0, near, along)
        old = torch.ones(len(x), dtype=torch.bool, device=x.device)
        old[near] = ~(helped | grounded | textured)
        for found in sourced:
            old[found.rows] = False
        return _Routed(
            asked, turned, owner, old.nonzero()[:, 0], near[helped], near[grounded], tuple(sourced), tuple(planes)
        )

    def arrived(self, x: Tensor) -> Tensor:
        """Which move each world point (S, 3) is answered by, (S,) int64, -1 for none.

        A fitted surface is a step or so thick: the moved object takes its skin along, to places that were empty and
        are nobody else's; less of it to where something left, since ground is being learnt there. What was solid
        stays (the ground beside it), but for what is right beneath it: a ray that enters the object above its lower
        edge takes its first sample there.
        """
        owner = owners(x, self.moves)
        skin = torch.where(owner < 0, owners(x, self._shells), -1)
        rows = (skin >= 0).nonzero()[:, 0]
        if len(rows):
            at = x[rows].detach()
            free = ~self._was_solid(at) | (self._vacated(at) & (owners(at, self._inner_shells) >= 0))
            for i, (move, up) in enumerate(zip(self.moves, self._ups)):
                if up is not None:
                    free |= (skin[rows] == i) & move.arrived(at + up)
            owner[rows[free]] = skin[rows[free]]
        return torch.where(self.bare.contains(x), -1, owner) if self.bare.grids else owner

    def _was_solid(self, x: Tensor) -> Tensor:
        """Whether something was at world points (S, 3) before, (S,) bool."""
        return self.pretrained.density(x) * self.sampler_step > _SOLID

    def _vacated(self, x: Tensor) -> Tensor:
        """Whether world points (S, 3) are around where something left, now or at an earlier visit, (S,) bool."""
        return self.region.contains(x) | self.earlier.places.contains(x)

    def _up_of(self, move: Move, shell: Move) -> Tensor | None:
        """(3,) world: a sample's length away from what a moved object stands on now; None if on nothing.

        What is solid in its skin is a layer of that: the normal is the direction in which it is thinnest.
        """
        skin = shell.grid.nodes().reshape(-1, 3)
        skin = skin[shell.grid.contains(skin) & ~move.grid.contains(skin)]
        at = transform(move.new_from_old, skin)
        with torch.no_grad():
            touched = at[self._was_solid(at) & ~self._vacated(at)].double()
        if len(touched) < _LAYER:
            return None
        normal = torch.linalg.eigh(torch.cov(touched.T)).eigenvectors[:, 0]
        middle = transform(move.new_from_old, move.grid.occupied().double().mean(0)[None])[0]
        side = torch.sign(normal @ (middle - touched.mean(0)))
        return (side * self.sampler_step * normal).float()

    def _near(self, x: Tensor) -> Tensor:
        return in_boxes(x, torch.stack(self.boxes)) if self.boxes else torch.zeros_like(x[:, 0], dtype=torch.bool)

    def _relit(self, asked: Tensor, rgb: Tensor, owner: Tensor) -> Tensor:
        """Colours of the old field (S, 3), asked for at (S, 3), in the new light; ``owner`` (S,) is -1 for what did
        not move."""
        for i, light in enumerate((self.light, *self.shading), start=-1):
            if light is not None:
                mine = (owner == i).nonzero()[:, 0]
                rgb = rgb.index_copy(0, mine, light.applied(asked[mine], rgb[mine]))
        return rgb


@dataclass(frozen=True)
class _Sourced:
    """Points that an object's source answers for."""

    source: Source
    rows: Tensor
    """(K,) int64"""
    x: Tensor
    """(K, 3) where the source has them"""


@dataclass(frozen=True)
class _Routed:
    """Who answers for S points."""

    asked: Tensor
    """(S, 3) world: where the old field is asked"""
    turned: Tensor
    """(S, 3) unit: along what"""
    owner: Tensor
    """(S,) int64: the move that brought what is there; -1 for none"""
    old: Tensor
    """rows, int64, that the old field answers for"""
    helper: Tensor
    """rows of the helper; of nobody where there is none"""
    ground: Tensor
    """rows of the earlier state that knows the place"""
    sourced: tuple[_Sourced, ...]
    """what moved before, and is looked up where it first was"""
    planes: tuple[tuple[TexturedPlane, Tensor], ...]
    """planes whose texture is known, each with its rows"""

    @property
    def textured(self) -> Tensor:
        """rows of all planes"""
        return torch.cat([self.helper[:0], *(rows for _, rows in self.planes)])


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
    to = field._route(x)
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
        found = field.sources[i] or Source(field.pretrained, field._shells[i].grid, still, field.outlooks[i])
        light, pose = field.shading[i] if i < len(field.shading) else None, field.moves[i].new_from_old
    if found is None:
        return None
    lights = found.lights if light is None else (*found.lights, (found.now_from_then, light))
    return replace(found, now_from_then=pose @ found.now_from_then, lights=lights)


def layers_of(field: Field) -> Iterator[UpdatedField]:
    """The updates that a field has had, the latest first."""
    while isinstance(field, UpdatedField):
        yield field
        field = field.pretrained


def _part(change: SceneChange, without: frozenset[int]) -> SceneChange:
    """A change without some of its objects."""
    kept = tuple(o for i, o in enumerate(change.objects) if i not in without)
    return change if len(kept) == len(change.objects) else replace(change, objects=kept)


def _base_of(field: Field) -> HashField | NerfactoField | NerfstudioField | None:
    """The field of the first visit, if it is one of those that know where to look."""
    if isinstance(field, UpdatedField):
        return field._base
    return field if isinstance(field, HashField | NerfactoField | NerfstudioField) else None


def _widened(cells: Tensor) -> Tensor:
    """Cells (R, R, R) uint8 and those beside them: one whose centre is outside may hold a corner that is inside."""
    return functional.max_pool3d(cells[None, None].float(), 3, 1, 1)[0, 0].to(torch.uint8)


def _by_cells(sampler: OccupancySampler, box: Tensor) -> Tensor:
    """A world box (2, 3) grown by two and a half of the sampler's cells."""
    margin = 2.5 * float(sampler.width(sampler.contraction.reach(box)).max())
    return torch.stack([box[0] - margin, box[1] + margin])
