"""What arrived: voxels that newcomers may fill, and which of them are believed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from refield.estimate.detect import Mask
from refield.estimate.ground import Ground
from refield.estimate.hull import votes
from refield.estimate.lattice import Lattice, Voxels, components, grown
from refield.estimate.light import Ratio
from refield.estimate.look import Array, View
from refield.estimate.objects import Old
from refield.estimate.past import Past
from refield.scene.pose import invert, transform
from refield.vision import pixels


def arrivals(ground: Ground, past: Sequence[Past], olds: Sequence[Old]) -> Voxels:
    """Voxels that newcomers may fill: in every seeing view's unexplained change, and empty once the old are gone."""
    hull, config = ground.hull, ground.carving
    points = hull.lattice.centres.reshape(-1, 3)
    seen = [(p.changed.witness(p.depth), p.changed.mask & ~p.explained) for p in past]
    inside, against = votes(points, [(v, pixels.dilate(m, config.margin)) for v, m in seen], config)
    sure, _ = votes(points, [(v, pixels.dilate(p.open, 1)) for (v, _), p in zip(seen, past)], config)
    air = ~hull.solid.reshape(-1)
    for old in olds:
        air |= old.lattice.holds(grown(old.voxels, 1), points)
    needed = min(2, len(past))
    found = (inside >= needed) & (sure >= needed) & (against == 0) & air
    return found.reshape(hull.lattice.shape) & ground.free


def newcomers(ground: Ground, voxels: Voxels, past: Sequence[Past]) -> list[Voxels]:
    """Components of the arrivals that explain changed pixels which nothing else does."""
    lattice = ground.hull.lattice
    core = ndimage.binary_erosion(voxels, np.ones((3, 3, 3), bool))  # not the thin sheets left between masks
    thick = grown(core, 2, voxels) if core.any() else core
    out: list[Voxels] = []
    taken = [~p.open for p in past]
    for part in components(thick, ground.carving.smallest):
        shares = []
        shadows = [shadow_of(p.view, lattice, part) for p in past]
        for here, gone, p in zip(shadows, taken, past):
            if (here & ~gone).sum() >= ground.detect.smallest * here.size * 2:
                shares.append(float((here & ~gone).sum() / (here & p.known).sum()))
        enough = len(shares) >= min(2, len(past)) and float(np.median(shares)) > ground.believe.arrived
        if enough and not _only_light(ground, part, past):
            out.append(part)
            taken = [t | pixels.dilate(s, 1) for t, s in zip(taken, shadows)]
    return out


def remarkable(
    ground: Ground, parts: Sequence[Voxels], past: Sequence[Past], places: Sequence[tuple[Old, Tensor]]
) -> list[Voxels]:
    """Would-be newcomers that are no scraps at the edges of objects."""
    large = [p for p in parts if _substantial(ground, p, past)]
    return [p for p in large if not any(_rim_of(ground, p, old, place) for old, place in places)]


def _substantial(ground: Ground, part: Voxels, past: Sequence[Past]) -> bool:
    """Whether a would-be newcomer is large enough in some photo; what is left over at the edge of others is not."""
    shadows = [shadow_of(p.view, ground.hull.lattice, part) & p.open for p in past]
    return max(float(s.mean()) for s in shadows) >= ground.believe.smallest


def _rim_of(ground: Ground, part: Voxels, old: Old, new_from_old: Tensor) -> bool:
    """Whether a small would-be newcomer hugs an object's old or new place: a contact shadow, the rest of an outline."""
    lattice = ground.hull.lattice
    points = torch.from_numpy(lattice.centres[part])
    if len(points) * lattice.cell**3 > 0.2 * old.volume:
        return False
    back = transform(invert(new_from_old), points).numpy()
    reach = max(2, round(0.35 * old.radius / old.lattice.cell))
    near = ndimage.distance_transform_edt(~np.pad(old.voxels, reach)) <= reach
    ijk = np.floor((back - old.lattice.low) / old.lattice.cell).astype(int) + reach
    inside = ((ijk >= 0) & (ijk < near.shape)).all(-1)
    return float(near[tuple(ijk[inside].T)].sum()) > 0.5 * len(points)


def _only_light(ground: Ground, part: Voxels, past: Sequence[Past]) -> bool:
    """Whether a would-be newcomer lies flat on what holds things up and only darkens or brightens it."""
    points = ground.hull.lattice.centres[part]
    extent = float((points.max(0) - points.min(0)).max())
    low = max(5 * ground.hull.lattice.cell, 0.3 * extent)
    if not any((plane.above(points) <= low).mean() >= 0.95 for plane in ground.planes):
        return False
    alike, shown = 0, 0
    for p in past:
        here = shadow_of(p.view, ground.hull.lattice, part) & p.open
        alike += int((here & Ratio.of(p.view, p.rgb, ground.detect).even_and_grey).sum())
        shown += int(here.sum())
    return alike > 0.5 * shown


def fresh(past: Sequence[Past], lattice: Lattice, part: Voxels) -> float:
    """Part of a newcomer's pixels that nothing else explains, the median over photos that show any."""
    shadows = [(shadow_of(p.view, lattice, part), p.open) for p in past]
    shares = [float((here & left).sum() / here.sum()) for here, left in shadows if here.any()]
    return float(np.median(shares)) if shares else 0.0


def shadow_of(view: View, lattice: Lattice, voxels: Voxels, depth: Array | None = None) -> Mask:
    """Pixels that voxels project to; with the ``depth`` (H, W) of what stands there, those that it does not hide."""
    out = np.zeros(view.shape, bool)
    uv, distance, inside = view.project(lattice.centres[voxels])
    if depth is not None:
        inside = inside & (distance < view.lookup(depth, uv, inside) + lattice.cell)
    ij = uv[inside].astype(np.int64)
    out[ij[:, 1], ij[:, 0]] = True
    return pixels.close(out, 5)
