"""The texture of the ground that objects stood on, by least squares over the new photos' pixels that show it.

Each pixel is a linear equation in four texels, so nothing has to be learnt and one photo is enough; where there are
several, they also say how far the plane is off. Where none shows the ground, its gradients are the old field's (Pérez
et al. 2003, Poisson image editing): the old texture goes on in the light that there is beside it. Texels on which the
photos do not agree are not known: there is no such plane there, or something stands on it. They are the helper's.

Letters: (U, V) texels, N pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import cg
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
from refield.update.ground import Foothold
from refield.update.helper import step_near
from refield.update.region import Region
from refield.update.supervision import Lessons
from refield.update.textured import TexturedPlane

Array = NDArray[Any]
_TEXEL = 0.5  # pixels of the nearest new photo
_SIDE = 640  # texels at most
_SMOOTH = 0.3  # weight of a difference between neighbouring texels, where a pixel has 1
_CLEAR = 0.1  # opacity of what may be in front of the ground
_ON = 1.5  # samples of the old field; so near to a plane its surface is the plane's
_APART = 4  # texels; so far apart a photo's pixels may be on the ground
_FEWEST = 100  # pixels
_SOME = 6  # of a photo's pixels, whose mean says how a place looks in it
_DISPUTED = 0.12  # of a colour channel in [0, 1]; so different a place may not look in two photos
_ROUNDS = 6  # of texture, trust and plane
_ROUGH, _FINE = 1e-3, 1e-4  # of what the equations miss at first; texels that no photo shows hardly count in it
_OFF = 0.5  # samples of the old field; so far off a plane may well be
_SPREAD = 3.0  # typical errors; as wrong as this is half trusted
_ERROR = (0.03, 0.05)  # what a typical error is at least and at most, of an RGB colour in [0, 1]
_DEEP, _WIDE = 2.0, 1.5  # what is opaque, at least: samples of the old field, cells of its occupancy grid
_GRAZING = 0.1  # sine of the angle at which a ray is taken to meet a plane at least


def textured_planes(
    ground: Sequence[Foothold],
    around: Region,
    cut: UpdatedField,
    dark: OccupancySampler,
    unsure: Region,
    new: Lessons,
    pixel: float,
) -> tuple[TexturedPlane, ...]:
    """The planes of ``ground`` with what the photos show of them, in the region ``around``.

    Args:
        cut: the field before, without what left and with what moved.
        dark: looks where no old photo did; what the field before shows there, inside of things, is no ground.
        unsure: where something stands now; what a ray through it shows is not the ground.
        new: pixels of the new photos.
        pixel: side of a new photo's pixel there, world units.
    """
    planes = {id(f.plane): f.plane for f in ground}.values()
    found = [
        _textured([f for f in ground if f.plane is p], p, place, cut, dark, unsure, new, pixel)
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
    seen = new[replace(blank, known=inside).hit(new.rays).nonzero()[:, 0]]
    t = blank.met(seen.rays)
    steep = -(seen.rays.directions @ blank.normal).clamp(max=-_GRAZING)
    hidden, rgb = _in_front(cut, seen.rays, t - _ON * blank.clear / steep)
    for grid in unsure.grids:
        hidden[grid.met_by(seen.rays)] = 1.0
    x = seen.rays.origins + t[:, None] * seen.rays.directions
    free = hidden < _CLEAR
    # a plain piece of ground may have no surface in the old field; rays that come to it freely say that it is there
    whole = torch.from_numpy(ndimage.binary_fill_holes((beside | under).numpy()))
    under |= whole & inside & ~beside & torch.from_numpy(_among(blank.texels(x[free]).numpy(), shape))
    used = (free & blank.over(beside | under, x)).nonzero()[:, 0]
    if len(used) < _FEWEST:
        return None
    colours = ((seen.rgb - rgb) / (1 - hidden)[:, None])[used]
    told = colours.double().numpy()
    found, places = _fitted(blank, seen.rays[used], told, _Guide(guide.double().numpy(), beside.numpy()))
    known = beside.numpy() | (under.numpy() & _among(places, shape))
    known &= ~_disputed(places, told, seen.photo[used].numpy(), shape)
    return replace(found, known=torch.from_numpy(known)) if known.any() else None


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


@dataclass(frozen=True)
class _Guide:
    """What the old field shows of a plane."""

    rgb: Array
    """(U * V, 3) float64"""
    known: Array
    """(U, V) bool"""


def _fitted(plane: TexturedPlane, rays: Rays, colours: Array, guide: _Guide) -> tuple[TexturedPlane, Array]:
    """The plane that shows colours (N, 3) best to rays that come to it, and where these do, (N, 2) texels.

    Least squares, reweighted as for Cauchy's errors, for the texture, and in turns with it a Gauss-Newton step for how
    far the plane is off: its height and its two tilts. Several photos say that, and a little the old field's texture.
    """
    shape = tuple(plane.known.shape)
    first = plane.texels(rays.origins + plane.met(rays)[:, None] * rays.directions).double().numpy()
    slide = (rays.directions @ plane.axes.T / (rays.directions @ plane.normal)[:, None]).double().numpy()
    levers = np.concatenate([np.ones((len(first), 1)), first / max(shape) - 0.5], 1)
    off, places, trust = np.zeros(3), first, np.ones(len(first))  # off: height in the middle and at the sides, texels
    mean = colours.mean(0)
    texture = np.where(guide.known.reshape(-1, 1), guide.rgb - mean, 0.0)
    smooth, wanted = _smoothness(guide)
    for k in range(_ROUNDS):
        rows = _bilinear(places, shape)
        exact = _FINE if k == _ROUNDS - 1 else _ROUGH
        texture = _solved(rows, colours - mean, trust, (smooth, wanted), texture, exact)
        error = rows @ texture + mean - colours
        size = np.linalg.norm(error, axis=1)
        typical = float(np.clip(np.median(size), *_ERROR))
        trust = 1 / (1 + (size / (_SPREAD * typical)) ** 2)
        if k < _ROUNDS - 1:
            gradients = [np.gradient(texture.reshape(*shape, 3), axis=axis) for axis in (0, 1)]
            across = np.stack(gradients, 2).reshape(-1, 6)
            by_height = np.einsum("na,nac->nc", slide, (rows @ across).reshape(-1, 2, 3))
            lever = (by_height[:, :, None] * levers[:, None, :]).reshape(-1, 3)
            pull = (lever * np.repeat(trust, 3)[:, None]).T
            stay = (typical * plane.texel / (_OFF * plane.clear)) ** 2
            off = off - np.linalg.solve(pull @ lever + stay * np.eye(3), pull @ error.reshape(-1) + stay * off)
            corner = plane.texel * (abs(off[0]) + abs(off[1]) / 2 + abs(off[2]) / 2)
            off *= min(1.0, plane.clear / max(corner, 1e-12))  # on plain ground anything fits
            places = first + slide * (levers @ off)[:, None]
    picture = torch.from_numpy((texture + mean).reshape(*shape, 3)).float().clamp(0, 1)
    return replace(_raised(plane, off), rgb=picture), places


def _raised(plane: TexturedPlane, off: Array) -> TexturedPlane:
    """A plane higher by off[0] texels in its middle; off[1] and off[2]: from a side to the one opposite."""
    tilt = torch.from_numpy(off[1:]).float() / max(plane.known.shape)
    axes = plane.axes + tilt[:, None] * plane.normal  # longer by half of the tilt's square, which is nothing
    normal = functional.normalize(torch.linalg.cross(axes[0], axes[1]), dim=0)
    up = plane.texel * float(off[0] - off[1:].sum() / 2)
    return replace(plane, origin=plane.origin + up * plane.normal, axes=axes, normal=normal)


def _bilinear(places: Array, shape: tuple[int, ...]) -> Any:
    """Sparse (N, U * V): the weights of the texels around each place (N, 2)."""
    corner = np.clip(np.floor(places).astype(np.int64), 0, np.array(shape) - 2)
    f = np.clip(places - corner, 0, 1)
    columns = [(corner[:, 0] + a) * shape[1] + corner[:, 1] + b for a in (0, 1) for b in (0, 1)]
    values = [(f[:, 0] if a else 1 - f[:, 0]) * (f[:, 1] if b else 1 - f[:, 1]) for a in (0, 1) for b in (0, 1)]
    parts = np.stack(values, 1).ravel(), np.stack(columns, 1).ravel(), np.arange(0, 4 * len(places) + 1, 4)
    return sparse.csr_array(parts, shape=(len(places), shape[0] * shape[1]))


def _smoothness(guide: _Guide) -> tuple[Any, Array]:
    """Normal equations for gradients as the guide's, 0 where it has none: (U * V, U * V) sparse, (U * V, 3)."""
    u, v = guide.known.shape
    lines = [sparse.diags_array([-np.ones(n - 1), np.ones(n - 1)], offsets=[0, 1], shape=(n - 1, n)) for n in (u, v)]
    across = [sparse.kron(lines[0], sparse.eye_array(v)), sparse.kron(sparse.eye_array(u), lines[1])]
    gradient = sparse.vstack(across).tocsr()
    both = abs(gradient) @ guide.known.reshape(-1).astype(float) > 1.5
    wanted = gradient.T @ (both[:, None] * (gradient @ guide.rgb))
    return _SMOOTH**2 * (gradient.T @ gradient), _SMOOTH**2 * wanted


def _solved(
    rows: Any, colours: Array, trust: Array, smoothness: tuple[Any, Array], start: Array, exact: float
) -> Array:
    """The texture (U * V, 3) that shows colours (N, 3), each trusted so far (N,), from ``start``; as exact as asked."""
    smooth, wanted = smoothness
    weighted = rows.multiply(trust[:, None]).tocsr()
    system = (rows.T @ weighted + smooth).tocsr()
    diagonal = sparse.diags_array(1 / system.diagonal())
    told = weighted.T @ colours + wanted
    found = [cg(system, told[:, c], x0=start[:, c], M=diagonal, rtol=exact, maxiter=1000)[0] for c in range(3)]
    return np.stack(found, 1)
