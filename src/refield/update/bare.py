"""The parts of a moved object that no old photo saw and a new one does: a face it lay on before it was tipped over.

The old field has nothing there to take along, so these parts are the helper's (they go before what moved in).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from refield.field.radiance import Field
from refield.field.render import visible_samples
from refield.field.source import Source
from refield.field.warp import Move, outline
from refield.scene.capture import Frame, Rays, centres
from refield.scene.change import OccupancyGrid, SceneChange
from refield.scene.pose import transform
from refield.update.composite import UpdatedField
from refield.update.region import Region

_EYES = 24  # old cameras asked, spread over all
_NODES = 40  # a side of the lattice, at most
_LEAST = 0.01  # of the object's outer nodes; fewer are the ragged edge of what was seen
_CLEAR = 1.0  # optical depth up to which a point counts as seen


def bare_skin(cut: UpdatedField, old: tuple[Frame, ...], change: SceneChange) -> Region:
    """Where moved objects show, at their new places, what was never seen of them; an empty region if nowhere.

    ``cut`` is the old field with the objects moved.
    """
    spread = old[:: max(1, len(old) // _EYES)]
    eyes = centres(spread).float(), centres(change.frames).float()
    grids = [_of_one(cut, move, source, *eyes) for move, source in zip(cut.moves, cut.sources)]
    return Region(tuple(g for g in grids if g is not None))


def _of_one(
    cut: UpdatedField, move: Move, source: Source | None, old_eyes: Tensor, new_eyes: Tensor
) -> OccupancyGrid | None:
    step = cut.sampler.step
    lattice, outer = _outer_nodes(move.grid, step)
    x = lattice.nodes()[outer]
    if source is None:
        unseen = ~_seen_by(cut.pretrained, old_eyes, x, step)
    else:  # the photos showed it where it stood when they were taken
        unseen = ~_seen_by(source.field, old_eyes, transform(source.then_from_now, x), step)
    shown = torch.zeros_like(unseen)
    if unseen.any():
        shown[unseen] = _seen_by(cut, new_eyes, transform(move.new_from_old, x[unseen]), step)
    if float(shown.float().mean()) < _LEAST:
        return None
    found = torch.zeros_like(lattice.values)
    found[outer] = shown.float()
    cell = float((lattice.aabb[1] - lattice.aabb[0])[0]) / (lattice.values.shape[0] - 1)
    reach = 2 * max(1, round(2 * step / cell)) + 1  # the skin is as deep outside as inside
    grown = functional.max_pool3d(found[None, None], reach, 1, reach // 2)[0, 0]
    return OccupancyGrid(lattice.aabb, grown).moved(move.new_from_old)


def _outer_nodes(grid: OccupancyGrid, step: float) -> tuple[OccupancyGrid, Tensor]:
    """A coarse cubic lattice around the object, and its nodes just outside the surface, (X, Y, Z) bool."""
    box = outline(grid)
    cell = max(step / 2, float((box[1] - box[0]).max()) / _NODES)
    lo = box[0] - 4 * step
    shape = ((box[1] + 4 * step - lo) / cell).ceil().long() + 1
    lattice = OccupancyGrid(torch.stack([lo, lo + (shape - 1) * cell]), torch.zeros(*shape.tolist()))
    inside = grid.contains(lattice.nodes())[None, None].float()
    thick = 2 * max(1, round(step / cell)) + 1
    near = functional.max_pool3d(inside, thick, 1, thick // 2)[0, 0] > 0
    return lattice, near & (inside[0, 0] == 0)


def _seen_by(field: Field, eyes: Tensor, x: Tensor, step: float) -> Tensor:
    """Whether anything but haze stands between a point (P, 3) and each eye (C, 3), for any eye; (P,) bool."""
    seen = torch.zeros(len(x), dtype=torch.bool)
    for eye in eyes:
        rows = (~seen).nonzero()[:, 0]
        if len(rows) == 0:
            break
        d = x[rows] - eye
        distance = d.norm(dim=-1)
        rays = Rays(eye.expand(len(rows), 3).contiguous(), d / distance[:, None])
        with torch.no_grad():
            samples = visible_samples(field, rays)
            at, _ = samples.positions(rays)
            before = samples.t_ends < (distance - 1.5 * step)[samples.ray_ids]
            tau = torch.where(before, field.density(at) * (samples.t_ends - samples.t_starts), 0.0)
        depth = torch.zeros(len(rows)).index_add_(0, samples.ray_ids, tau)
        seen[rows] = depth < _CLEAR
    return seen
