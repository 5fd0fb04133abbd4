"""The texture of the ground that objects stood on, by least squares over the new photos' pixels that show it.

Each pixel is a linear equation in four texels, so nothing has to be learnt and one photo is enough; where there are
several, they also say how far the plane is off. Where none shows the ground, its gradients are the old field's (Pérez
et al. 2003, Poisson image editing): the old texture goes on in the light that there is beside it. Where nothing ever
showed it, its own pattern does (`pattern.continued`). Texels on which the photos do not agree are not known: there is
no such plane there, or something stands on it. They are the helper's.

Letters: (U, V) texels, N pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from refield.field.radiance import Field
from refield.field.render import CHUNK, render_many, visible_samples
from refield.field.sampling import OccupancySampler
from refield.field.volrend import weights
from refield.field.warp import outline
from refield.scene.capture import Rays
from refield.scene.change import OccupancyGrid
from refield.scene.planes import Plane
from refield.update.composite import UpdatedField
from refield.update.cut import Known
from refield.update.ground import Foothold, GroundConfig
from refield.update.helper import step_near
from refield.update.pattern import continued
from refield.update.region import Region
from refield.update.supervision import Lessons
from refield.update.texture import Guide, fitted
from refield.update.textured import TexturedPlane

Array = NDArray[Any]
_TEXEL = 0.5  # pixels of the nearest new photo
_SIDE = 640  # texels at most
_CLEAR = 0.1  # opacity of what may be in front of the ground
_ON = 1.5  # samples of the old field; so near to a plane its surface is the plane's
_APART = 4  # texels; so far apart a photo's pixels may be on the ground
_FEWEST = 100  # pixels
_SOME = 6  # of a photo's pixels, whose mean says how a place looks in it
_DISPUTED = 0.12  # of a colour channel in [0, 1]; so different a place may not look in two photos
_DEEP, _WIDE = 2.0, 1.5  # what is opaque, at least: samples of the old field, cells of its occupancy grid
_GRAZING = 0.1  # sine of the angle at which a ray is taken to meet a plane at least


def textured_of(
    known: Known, ground: Sequence[Foothold], dark: OccupancySampler, config: GroundConfig, pixel: float
) -> tuple[TexturedPlane, ...]:
    """The texture of the ground that objects stood on, and of what is beside these places and the new ones, within
    the config's reach; the rest as of `textured_planes`."""
    cut = known.cut
    places = [o.grid for o in cut.to_learn.objects] + [m.grid.moved(m.new_from_old) for m in cut.moves]
    around = Region(tuple(g.dilated(config.reach) for g in places) + cut.earlier.unknown.grids)
    arrived = tuple(g for o in cut.change.objects if (g := o.grid_now) is not None)
    unsure, taught = Region(arrived + cut.bare.grids), known.sparse.taught
    return textured_planes(ground, around, cut, dark, unsure, taught, pixel, patterned=config.patterned)


def textured_planes(
    ground: Sequence[Foothold],
    around: Region,
    cut: UpdatedField,
    dark: OccupancySampler,
    unsure: Region,
    new: Lessons,
    pixel: float,
    *,
    patterned: bool = True,
) -> tuple[TexturedPlane, ...]:
    """The planes of ``ground`` with what the photos show of them, in the region ``around``.

    Args:
        cut: the field before, without what left and with what moved.
        dark: looks where no old photo did; what the field before shows there, inside of things, is no ground.
        unsure: where something stands now; what a ray through it shows is not the ground.
        new: pixels of the new photos.
        pixel: side of a new photo's pixel there, world units.
        patterned: they go on where no photo shows them; else they end there.
    """
    planes = {id(f.plane): f.plane for f in ground}.values()
    found = [
        _textured([f for f in ground if f.plane is p], p, place, cut, dark, unsure, new, pixel, patterned)
        for p in planes
        for place in _apart(around)
    ]
    return tuple(t for t in found if t is not None)


def _apart(region: Region) -> list[Region]:
    """Parts of a region that have nothing to do with each other: what moved far away needs no texels in between."""
    parts: list[tuple[OccupancyGrid, ...]] = []
    for grid in region.grids:
        box = outline(grid)
        touch = [any(bool(((box[0] < b[1]) & (b[0] < box[1])).all()) for b in Region(p).boxes) for p in parts]
        joined = [g for p, near in zip(parts, touch) if near for g in p]
        parts = [p for p, near in zip(parts, touch) if not near] + [(*joined, grid)]
    return [Region(p) for p in parts]


def _textured(
    ground: list[Foothold],
    plane: Plane,
    around: Region,
    cut: UpdatedField,
    dark: OccupancySampler,
    unsure: Region,
    new: Lessons,
    pixel: float,
    patterned: bool,
) -> TexturedPlane | None:
    blank = _blank(plane, around, cut, pixel)
    shape = tuple(blank.known.shape)
    nodes = blank.nodes
    inside = around.contains(nodes)
    under = cut.region.contains(nodes) | cut.region.contains(nodes + blank.clear * blank.normal)
    for foothold in ground:
        under |= foothold.holds(nodes)
    on, guide = _shown(cut.pretrained, blank, nodes)
    on &= ~dark.occupied(nodes + blank.clear * blank.normal)
    inside, under, beside = (m.reshape(shape) for m in (inside, inside & under, inside & on & ~under))
    new = new[replace(blank, known=inside).hit(new.rays).nonzero()[:, 0]]
    t = blank.met(new.rays)
    steep = -(new.rays.directions @ blank.normal).clamp(max=-_GRAZING)
    before, rgb = _in_front(cut, new.rays, t - _ON * blank.clear / steep)
    for grid in unsure.grids:
        before[grid.met_by(new.rays)] = 1.0
    x = new.rays.origins + t[:, None] * new.rays.directions
    free = before < _CLEAR
    # a plain piece of ground may have no surface in the old field; rays that come to it freely say that it is there
    whole = torch.from_numpy(ndimage.binary_fill_holes((beside | under).numpy()))
    under |= whole & inside & ~beside & torch.from_numpy(_among(blank.texels(x[free]).numpy(), shape))
    used = (free & blank.over(beside | under, x)).nonzero()[:, 0]
    if len(used) < _FEWEST:
        return None
    colours = ((new.rgb - rgb) / (1 - before)[:, None])[used]
    told = colours.double().numpy()
    found, places = fitted(blank, new.rays[used], told, Guide(guide.double().numpy(), beside.numpy()))
    seen = beside.numpy() | (under.numpy() & _among(places, shape))
    seen &= ~(disputed := _disputed(places, told, new.photo[used].numpy(), shape))
    if not seen.any():
        return None
    found = replace(found, known=torch.from_numpy(seen))
    # what hides the ground from all photos leaves a helper nothing to learn from
    hidden = under.numpy() & ndimage.binary_fill_holes(seen) & ~seen & ~disputed
    return _gone_on(found, hidden) if patterned and hidden.any() else found


def _gone_on(plane: TexturedPlane, hidden: Array) -> TexturedPlane:
    """The plane with its texture, and that of what is around, where nobody saw it: in texels (U, V) bool."""
    rgb = continued(plane.rgb.double().numpy(), plane.known.numpy(), hidden)
    return replace(plane, rgb=torch.from_numpy(rgb).float(), known=plane.known | torch.from_numpy(hidden))


def _blank(plane: Plane, around: Region, field: Field, pixel: float) -> TexturedPlane:
    """A plane without texture, as large as a region."""
    normal = torch.from_numpy(plane.normal).float()
    u = functional.normalize(torch.linalg.cross(normal, torch.eye(3)[int(normal.abs().argmin())]), dim=0)
    axes = torch.stack([u, torch.linalg.cross(normal, u)])
    flat = torch.cat([torch.cartesian_prod(*box.T) for box in around.boxes]) @ axes.T
    lo, hi = flat.amin(0), flat.amax(0)
    texel = max(_TEXEL * pixel, float((hi - lo).max()) / (_SIDE - 2))
    shape = [int(n) + 2 for n in ((hi - lo) / texel).ceil()]
    middle = around.box.mean(0)
    step, cells = step_near(field, middle), field.sampler
    depth = max(_DEEP * step, _WIDE * float(cells.width(cells.contraction.reach(middle))))
    origin = lo @ axes + plane.offset * normal
    none = torch.zeros(*shape, dtype=torch.bool)
    return TexturedPlane(normal, origin, axes, texel, depth, step, torch.zeros(*shape, 3), none)


def _shown(field: Field, plane: TexturedPlane, nodes: Tensor) -> tuple[Tensor, Tensor]:
    """Whether a field shows a surface at points (N, 3) of a plane, and in what colours (N, 3).

    Asked from so near that what stands beside them is not in the way, and at 45°: more or less as photos are taken.
    """
    d = functional.normalize(plane.axes[0] - plane.normal, dim=0).expand(len(nodes), 3)
    from_plane = 2 * _ON * plane.clear * 2**0.5
    rays = Rays(nodes - from_plane * d, d)
    seen = render_many(field, rays)
    height = plane.height(rays.origins + seen.depth[:, None] * d)
    return (seen.opacity > 0.5) & (height.abs() < _ON * plane.clear), seen.rgb


def _in_front(field: Field, rays: Rays, limit: Tensor) -> tuple[Tensor, Tensor]:
    """What a field shows along N rays up to distances (N,): opacity (N,) and colour (N, 3)."""
    parts = [torch.zeros(0, 4)]
    with torch.no_grad():
        for some in torch.arange(len(rays)).split(CHUNK):
            samples = visible_samples(field, rays[some])
            sigmas, rgbs = field(*samples.positions(rays[some]))
            w, ids, mid = weights(sigmas, samples), samples.ray_ids, (samples.t_starts + samples.t_ends) / 2
            w = ((mid < limit[some][ids]) * w)[:, None]
            parts.append(torch.zeros(len(some), 4).index_add_(0, ids, torch.cat([w, w * rgbs], 1)))
    summed = torch.cat(parts)
    return summed[:, 0], summed[:, 1:]


def _hits(places: Array, shape: tuple[int, ...]) -> Array:
    """How many places (N, 2), in texels, fall into each texel, (U, V) float64."""
    counts = np.zeros(shape)
    np.add.at(counts, tuple(np.clip(places.round().astype(int), 0, np.array(shape) - 1).T), 1.0)
    return counts


def _disputed(places: Array, colours: Array, photo: Array, shape: tuple[int, ...]) -> Array:
    """Texels that do not look the same in all photos that show them, (U, V) bool.

    Means over some pixels are compared: a texture fine enough for one photo fits several that contradict each other.
    """
    blocks = tuple(-(-n // _APART) for n in shape)
    at = np.ravel_multi_index(tuple(np.clip(places.round().astype(int) // _APART, 0, np.array(blocks) - 1).T), blocks)
    least, most = np.full((*blocks, 3), np.inf), np.full((*blocks, 3), -np.inf)
    for k in np.unique(photo):
        mine = photo == k
        sums = [np.bincount(at[mine], w, math.prod(blocks)).reshape(blocks) for w in (None, *colours[mine].T)]
        count, *summed = (ndimage.convolve(s.astype(float), np.ones((3, 3)), mode="constant") for s in sums)
        some = count >= _SOME
        mean = np.stack(summed, -1)[some] / count[some, None]
        least[some], most[some] = np.minimum(least[some], mean), np.maximum(most[some], mean)
    apart = (most - least).max(-1) > _DISPUTED
    return np.kron(apart, np.ones((_APART, _APART), bool))[: shape[0], : shape[1]]


def _among(places: Array, shape: tuple[int, ...]) -> Array:
    """Texels that have places (N, 2) on all sides or close by, (U, V) bool: a closing."""
    if len(places) == 0:
        return np.zeros(shape, bool)
    near = np.pad(ndimage.distance_transform_edt(_hits(places, shape) == 0) <= _APART, _APART + 1)
    return (ndimage.distance_transform_edt(near) > _APART)[_APART + 1 : -_APART - 1, _APART + 1 : -_APART - 1]
