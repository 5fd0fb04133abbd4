"""How the light on unchanged surfaces changed: shadows that left, came, or moved along with an object.

A shadow changes the colour of a surface by a factor, and nothing of its geometry. `Relighting` is that factor on a
lattice, 1 where nothing is known against it. It is fitted in closed form from the new photos and kept only where
pixels that were left out of a fit confirm it. Letters: P pixels, C lattice nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from refield.field import kernels
from refield.field.kernels import onward
from refield.field.kernels.onward import NO_LIGHTS, Lights
from refield.field.sampling import OccupancySampler
from refield.field.warp import inside_box


@dataclass(frozen=True)
class Relighting:
    """Colour factors on a lattice in a world box."""

    aabb: Tensor
    """(2, 3) float32, corner to corner of the nodes"""
    log_gain: Tensor
    """(X, Y, Z, 3) float32, natural logarithm of the factor of each channel"""

    def cells(self, sampler: OccupancySampler) -> Tensor:
        """Cells of a sampler's grid in which some factor is not 1, (R, R, R) uint8, and perhaps some beside them."""
        out = torch.zeros_like(sampler.grid)
        lit = (self.log_gain != 0).any(-1)
        reach = functional.max_pool3d(lit[None, None].float(), 3, 1, 1)[0, 0] > 0  # what is between nodes has of both
        spacing = (self.aabb[1] - self.aabb[0]) / (torch.tensor(lit.shape) - 1)
        out.view(-1)[sampler.cells(self.aabb[0] + reach.nonzero() * spacing)] = 1
        cells = sampler.cells_in(self.aabb)  # which may be narrower than the lattice's
        node = ((sampler.points_in(cells, jitter=False) - self.aabb[0]) / spacing).round().long()
        inside = ((node >= 0) & (node < torch.tensor(lit.shape))).all(-1)
        i, j, k = node[inside].unbind(-1)
        out.view(-1)[cells[inside]] |= reach[i, j, k].to(out.dtype)
        return out

    def cropped(self) -> Relighting | None:
        """The same without most of what has no effect; None if nothing has any."""
        lit = (self.log_gain != 0).any(-1).nonzero()
        if len(lit) == 0:
            return None
        size = torch.tensor(self.log_gain.shape[:3])
        first, last = (lit.amin(0) - 1).clamp_min(0), (lit.amax(0) + 1).minimum(size - 1)
        spacing = (self.aabb[1] - self.aabb[0]).double() / (size - 1)
        box = self.aabb[0].double() + torch.stack([first, last]) * spacing
        (i, j, k), (l, m, n) = first.tolist(), (last + 1).tolist()
        return Relighting(box.float(), self.log_gain[i:l, j:m, k:n].contiguous())

    def applied(self, x: Tensor, rgb: Tensor) -> Tensor:
        """World points (S, 3), colours (S, 3) -> colours in the new light (S, 3) in [0, 1], as they are outside of the
        box."""
        asked = x.requires_grad or rgb.requires_grad
        relight = onward.relight if torch.is_grad_enabled() and asked else kernels.relight
        return relight(x, rgb, self._lights)

    @cached_property
    def _lights(self) -> Lights:
        return lights_of([self])


def lights_of(lights: Sequence[Relighting]) -> Lights:
    """One light after the other, as kernels take them."""
    if not lights:
        return NO_LIGHTS
    shapes = torch.tensor([light.log_gain.shape[:3] for light in lights])
    firsts = torch.cat([shapes.new_zeros(1), shapes.prod(-1).cumsum(0)[:-1]])
    boxes = torch.stack([light.aabb.float() for light in lights])
    return Lights(boxes, shapes, firsts, torch.cat([light.log_gain.reshape(-1, 3).float() for light in lights]))


@dataclass(frozen=True)
class Sightings:
    """The same surface points in the new photos and in the old field."""

    x: Tensor
    """(P, 3) world"""
    photo: Tensor
    """(P, 3) in [0, 1], in the old exposure"""
    rendered: Tensor
    """(P, 3) in [0, 1]"""
    fold: Tensor
    """(P,) int64: the group that a pixel belongs to when one group after the other is left out of the fit"""

    def __getitem__(self, chosen: Tensor) -> Sightings:
        return Sightings(self.x[chosen], self.photo[chosen], self.rendered[chosen], self.fold[chosen])

    def in_patches(self, side: float) -> Sightings:
        """The same with world cubes of this side as groups, each between cubes of the other groups."""
        patch = (self.x / side).floor().long()
        return replace(self, fold=(patch * torch.tensor([1, 3, 5])).sum(-1).remainder(_PATCH_FOLDS))


_PATCH_FOLDS = 4
_COARSER = (4, 2, 1)  # lattice spacings of the pyramid, in the finest
_HOLD = 2.0  # how many pixels' worth of evidence each level grants to the coarser one
_LESS, _SOME = 0.9, 1e-6  # so much less is a squared error that a factor explains, of one that is any at all
_NODES = 2, 96  # cells of a lattice along a side, at least and at most
_MOST = 3.0  # factors are held within [1 / this, this]


def fit_light(seen: Sightings, box: Tensor, spacing: float, patch: float | None = None) -> Relighting | None:
    """Least-squares factors on a lattice of ``spacing`` (world units) in a world ``box`` (2, 3).

    None if no part of it is confirmed: each fold's pixels must be explained better by the factors fitted to the
    *other* folds than by none. What only one fold has seen no other can confirm; with ``patch``, its cubes of that
    side confirm each other.
    """
    inside = inside_box(seen.x, box)
    seen = seen[inside.nonzero()[:, 0]]
    kept = _confirmed(seen, box, spacing)
    if patch is not None:
        kept |= _seen_once(seen, box, spacing) & _confirmed(seen.in_patches(patch), box, spacing)
    if not kept.any():
        return None
    gain = _pyramid(seen, box, spacing)
    fade = _smoothed(_without_border(kept.float())[..., None])
    return Relighting(box, torch.log(gain) * fade)


def _seen_once(seen: Sightings, box: Tensor, spacing: float) -> Tensor:
    """Nodes (X, Y, Z) bool around which all pixels are of one fold."""
    shape, ones = _shape(box, spacing), torch.ones(len(seen.x), 1)
    count = torch.zeros(shape, dtype=torch.long)
    for fold in seen.fold.unique():
        own = seen.fold == fold
        count += _smoothed(_scatter(ones[own], seen.x[own], box, shape))[..., 0] > 0
    return count == 1


def _confirmed(seen: Sightings, box: Tensor, spacing: float) -> Tensor:
    """Nodes (X, Y, Z) bool around which the factors of the other folds lower a fold's error."""
    shape, folds = _shape(box, spacing), seen.fold.unique()
    if len(folds) < 2:
        return torch.zeros(shape, dtype=torch.bool)
    errors = []
    for fold in folds:
        out = seen.fold == fold
        gain = _pyramid(seen[~out], box, spacing)
        left_out = seen[out]
        factor = _gather(gain, left_out.x, box)
        before = (left_out.photo - left_out.rendered).square().sum(-1)
        after = (left_out.photo - (left_out.rendered * factor).clamp(0, 1)).square().sum(-1)
        errors.append(_scatter(torch.stack([before, after], -1), left_out.x, box, shape))
    before, after = _smoothed(sum(errors[1:], errors[0])).unbind(-1)
    return (after < _LESS * before) & (before > _SOME)


def _pyramid(seen: Sightings, box: Tensor, spacing: float) -> Tensor:
    """Factors (X, Y, Z, 3), each level held to the coarser one."""
    gain = None
    for coarser in _COARSER:
        shape = _shape(box, spacing * coarser)
        top = _scatter(seen.photo * seen.rendered, seen.x, box, shape)
        bottom = _scatter(seen.rendered.square(), seen.x, box, shape)
        hold = _HOLD * float(seen.rendered.square().mean())
        prior = torch.ones(*shape, 3) if gain is None else _resized(gain, shape)
        gain = ((top + hold * prior) / (bottom + hold)).clamp(1 / _MOST, _MOST)
    assert gain is not None
    return gain


def _shape(box: Tensor, spacing: float) -> tuple[int, int, int]:
    x, y, z = ((box[1] - box[0]) / spacing).ceil().long().clamp(*_NODES).tolist()
    return x + 1, y + 1, z + 1


def _corners(x: Tensor, box: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Rows (P, 8) of the flat lattice around each point, and trilinear weights (P, 8)."""
    size = torch.tensor(shape[:3])
    p = (x - box[0]) / (box[1] - box[0]) * (size - 1)
    base = p.floor().long().clamp_min(0).minimum(size - 2)
    f = p - base
    offsets = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    ijk = base[:, None] + offsets
    rows = (ijk[..., 0] * size[1] + ijk[..., 1]) * size[2] + ijk[..., 2]
    return rows, torch.where(offsets.bool(), f[:, None], 1 - f[:, None]).prod(-1)


def _scatter(values: Tensor, x: Tensor, box: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Values (P, C) shared out among the nodes around their points -> (X, Y, Z, C)."""
    rows, w = _corners(x, box, shape)
    flat = values.new_zeros(shape[0] * shape[1] * shape[2], values.shape[1])
    flat.index_add_(0, rows.reshape(-1), (w[..., None] * values[:, None]).reshape(-1, values.shape[1]))
    return flat.reshape(*shape, -1)


def _gather(lattice: Tensor, x: Tensor, box: Tensor) -> Tensor:
    """Trilinear values (P, C) of a lattice (X, Y, Z, C)."""
    rows, w = _corners(x, box, lattice.shape[:3])
    return (lattice.reshape(-1, lattice.shape[-1])[rows] * w[..., None]).sum(1)


def _resized(lattice: Tensor, shape: tuple[int, int, int]) -> Tensor:
    volume = lattice.permute(3, 0, 1, 2)[None]
    return functional.interpolate(volume, shape, mode="trilinear", align_corners=True)[0].permute(1, 2, 3, 0)


def _smoothed(lattice: Tensor) -> Tensor:
    """Mean of the 3 x 3 x 3 nodes around each, (X, Y, Z, C)."""
    volume = lattice.permute(3, 0, 1, 2)[None]
    return functional.avg_pool3d(volume, 3, 1, 1, count_include_pad=False)[0].permute(1, 2, 3, 0)


def _without_border(lattice: Tensor) -> Tensor:
    """Zero on the two outermost layers, so that the light passes into the unlit world without an edge."""
    out = torch.zeros_like(lattice)
    out[2:-2, 2:-2, 2:-2] = lattice[2:-2, 2:-2, 2:-2]
    return out
