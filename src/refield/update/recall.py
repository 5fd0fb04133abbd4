"""What earlier visits know about a place: an object that came with a visit and leaves again uncovers what was there.

A second move of the same object has nothing to learn (§11.3.2): the field without that object's arrival shows the
ground it stood on, and an object that is back where it was is the field without its move. Layers: the update wrapped
outermost is 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.warp import Move, inside_box, outline
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.pose import transform
from refield.update.composite import DILATION, UpdatedField, layers_of, some_of
from refield.update.learnt import Earlier, Origin
from refield.update.region import Region, carved, forgotten, grown, move_out

_SAME = 0.5  # of one grid's nodes that lie in the other
_BACK = 0.06  # of an object's mean side: so near to its old place it may be back there; the photos decide
_TAUGHT = 2.0  # samples around an object that stood there, within which a helper has not learnt much


def earlier_of(field: Field, change: SceneChange, dilation: float) -> tuple[Field, Earlier]:
    """What earlier visits know of a change, and the field without the moves that it takes back.

    Only proposed: whoever asks compares with the photos.
    """
    base = field
    undone: list[Origin] = []
    left: list[Origin] = []
    for k, o in enumerate(change.objects):
        steps, base = _taken_back(base, k, o)
        undone += steps
    for k, o in enumerate(change.objects):
        brought = None if o.kind == "added" or k in {u.object for u in undone} else _brought(base, o.grid)
        if brought is not None:
            left.append(Origin(k, *brought[:2]))
    places = move_out(replace(change, objects=tuple(change.objects[p.object] for p in left)), dilation)
    ground = ground_of(base, tuple(left))
    return base, Earlier(tuple(undone), tuple(left), places, ground, _unknown(ground))


def _unknown(field: Field | None) -> Region:
    """Where something stood while every helper learnt, at a place that the fitted field does not know either."""
    grids: list[OccupancyGrid] = []
    for update in () if field is None else layers_of(field):
        if not isinstance(update, UpdatedField):
            break
        if not update.untaught.grids:
            continue
        was = carved(update.change, _TAUGHT * update.pretrained.sampler.step)
        for stood in update.untaught.grids:
            x = stood.nodes()
            both = stood.contains(x) & was.contains(x)
            if both.any():
                grids.append(OccupancyGrid(stood.aabb, both.float()))
    return Region(tuple(grids))


def ground_of(field: Field, left: tuple[Origin, ...]) -> Field | None:
    """A field without the arrivals of objects that left; None if none did. Layers are those of ``field``."""
    if not left:
        return None
    ground = field
    for place in sorted(left, key=lambda p: -p.layer):  # the innermost first: an edit may take a whole layer away
        ground = without(ground, place, departed=True)
    return ground


def without(field: Field, origin: Origin, *, departed: bool) -> Field:
    """A field as if an object of an earlier change had not arrived; if not ``departed``, as if it had not changed.

    Raises:
        ValueError: ``field`` has no such layer.
    """
    if not isinstance(field, UpdatedField):
        raise ValueError("the field has not had so many changes")
    if origin.layer:
        inner = without(field.pretrained, replace(origin, layer=origin.layer - 1), departed=departed)
        return field.but(pretrained=inner)
    own = origin.index
    o = field.change.objects[own]
    moving = [k for k, q in enumerate(field.change.objects) if q.new_from_old is not None and k not in field.skipped]
    shading = tuple(s for k, s in zip(moving, field.shading) if k != own)
    bare = _bare_of(field, o)
    region = replace(field.region, grids=tuple(g for g in field.region.grids if not _among(g, bare)))
    kept = Region(tuple(g for g in field.bare.grids if not _among(g, bare)))
    if departed and o.kind == "moved":
        gone = ObjectChange("removed", o.grid, masks=o.masks, confidence=o.confidence, note=o.note)
        objects = tuple(gone if k == own else q for k, q in enumerate(field.change.objects))
        change = replace(field.change, objects=objects)
        assert o.new_from_old is not None  # it moved
        stood = grown(o.grid.moved(o.new_from_old), _TAUGHT * field.pretrained.sampler.step)
        learnt = replace(field.learnt, region=_unshaded(region, o), bare=kept, shading=shading)
        taken = replace(field.taken, untaught=Region((*field.untaught.grids, stood)))
        return field.but(change=change, learnt=learnt, taken=taken)
    skipped = field.skipped | {own}
    if len(skipped) == len(field.change.objects):
        return field.pretrained
    ours = [p for p in field.earlier.left if p.object == own]
    earlier = replace(field.earlier, left=tuple(p for p in field.earlier.left if p.object != own))
    if ours:
        earlier = replace(earlier, places=_less(earlier.places, o.grid, kept))
    else:
        region = _less(region, o.grid, kept)
    learnt = replace(field.learnt, region=_unshaded(region, o), bare=kept, shading=shading)
    return field.but(learnt=learnt, earlier=earlier, taken=replace(field.taken, skipped=skipped))


def _changed(field: Field) -> Iterator[tuple[int, int, ObjectChange]]:
    """What changed before and was not taken back, with its layer and index, the latest change first."""
    for layer, update in enumerate(layers_of(field)):
        if not isinstance(update, UpdatedField):
            return
        yield from ((layer, i, o) for i, o in enumerate(update.change.objects) if i not in update.skipped)


def _brought(field: Field, place: OccupancyGrid) -> tuple[int, int, ObjectChange] | None:
    """The object that an earlier change brought to a place, with its layer and index."""
    came = (c for c in _changed(field) if (now := c[2].grid_now) is not None and _part_in(place, now) > _SAME)
    return next(came, None)


def _removed_from(field: Field, place: OccupancyGrid) -> tuple[int, int, ObjectChange] | None:
    """The object that an earlier change took from a place, likewise."""
    gone = (c for c in _changed(field) if c[2].kind == "removed")
    return next((c for c in gone if min(_part_in(place, c[2].grid), _part_in(c[2].grid, place)) > _SAME), None)


def _taken_back(field: Field, k: int, o: ObjectChange) -> tuple[list[Origin], Field]:
    """The earlier changes that object ``k`` takes back, since it is where it once was, or not at all; in the order in
    which they are to be taken out, each counted on the field without those before it. And the field without them.
    """
    if o.kind == "added":
        found = _removed_from(field, o.grid)
        steps = [] if found is None else [Origin(k, *found[:2])]
        return steps, without(field, steps[0], departed=False) if steps else field
    steps, base, at, total = [], field, o.grid, o.new_from_old
    while (found := _brought(base, at)) is not None:
        layer, index, q = found
        steps.append(Origin(k, layer, index))
        base = without(base, steps[-1], departed=False)
        if q.new_from_old is None:
            return (steps, base) if o.kind == "removed" else ([], field)
        at, total = q.grid, None if total is None else total @ q.new_from_old
        if total is not None and _near_identity(total, at, field.sampler.step):
            return steps, base
    return [], field


def _near_identity(new_from_old: Tensor, grid: OccupancyGrid, step: float) -> bool:
    """Whether a motion leaves an object about where it was."""
    corners = torch.cartesian_prod(*outline(grid).T.double())
    off = (transform(new_from_old, corners) - corners).norm(dim=-1)
    box = grid.tight_aabb()
    return float(off.max()) < max(_BACK * float((box[1] - box[0]).mean()), 2 * step)


def _part_in(grid: OccupancyGrid, other: OccupancyGrid) -> float:
    """The part of a grid's occupied nodes that lies in another."""
    x = some_of(grid)
    return float(other.contains(x).float().mean()) if len(x) else 0.0


def _bare_of(field: UpdatedField, o: ObjectChange) -> list[Tensor]:
    """The boxes of the bare parts that belong to where an object moved in."""
    if o.new_from_old is None:
        return []
    box = Move(o.grid, o.new_from_old).box_now
    return [g.aabb for g in field.bare.grids if bool(inside_box(g.aabb.mean(0, keepdim=True), box))]


def _among(grid: OccupancyGrid, boxes: list[Tensor]) -> bool:
    return any(torch.equal(grid.aabb, box) for box in boxes)


def _unshaded(region: Region, o: ObjectChange) -> Region:
    """A region without what its planes show around an object, whose shadow is on them; but where a helper would have to
    show it, which has not learnt what a plane does."""
    around = Region(tuple(g.dilated(DILATION) for g in (o.grid, o.grid_now) if g is not None))
    return replace(region, planes=forgotten(region.planes, around, Region(region.grids)))


def _less(region: Region, grid: OccupancyGrid, but: Region) -> Region:
    """A region without the grid that was made around an object's; ``but`` are never taken."""
    kept = [g.aabb for g in but.grids]
    centre = grid.tight_aabb().mean(0)
    own = [g for g in region.grids if not _among(g, kept)]
    if not own:
        return region
    nearest = min(own, key=lambda g: float((g.tight_aabb().mean(0) - centre).norm()))
    return replace(region, grids=tuple(g for g in region.grids if g is not nearest))
