"""Which of the things that were is which of the things that are (§10.2.2), by trying: a pose that explains the photos.

Objects are placed one after the other, the best first; what a placed object explains is taken off the photos before the
next is looked for. So two newcomers whose hulls run together are told apart by what fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from refield.estimate.detect import Mask
from refield.estimate.hull import Hull, HullConfig, votes
from refield.estimate.lattice import Lattice, Voxels, components, grown
from refield.estimate.look import Array, View
from refield.estimate.objects import Old
from refield.estimate.past import Past
from refield.estimate.pose_change import PoseChange, RefineConfig, object_alone, refine, refiner
from refield.estimate.register import Candidate, RegisterConfig, Target, register
from refield.field.radiance import Field
from refield.scene.pose import transform
from refield.vision import pixels


@dataclass(frozen=True)
class AssociateConfig:
    """When a pose is believed."""

    fits: float = 0.62
    """worst registration score that is refined"""
    explains: float = 0.5
    """part of the object's pixels that the moved object must explain"""
    gains: float = 0.15
    """by how much more than the old rendering did"""
    try_refined: int = 2
    """candidates a pair that are refined"""


@dataclass(frozen=True)
class Placed:
    """An old object found at its new place."""

    index: int
    """which old object"""
    change: PoseChange


def arrivals(hull: Hull, past: Sequence[Past], olds: Sequence[Old], allowed: Voxels, config: HullConfig) -> Voxels:
    """Voxels that newcomers may fill: in every seeing view's unexplained change, and empty once the old are gone."""
    points = hull.lattice.centres.reshape(-1, 3)
    seen = [(replace(p.view, depth=p.depth), p.changed.mask & ~p.explained) for p in past]
    inside, against = votes(points, [(v, pixels.dilate(m, config.margin)) for v, m in seen], config)
    sure, _ = votes(points, [(v, pixels.dilate(p.open, 1)) for (v, _), p in zip(seen, past)], config)
    air = ~hull.solid.reshape(-1)
    for old in olds:
        air |= old.lattice.holds(grown(old.voxels, 1), points)
    needed = min(2, len(past))
    found = (inside >= needed) & (sure >= needed) & (against == 0) & air
    return found.reshape(hull.lattice.shape) & allowed


def shadow_of(view: View, lattice: Lattice, voxels: Voxels) -> Mask:
    """Pixels that voxels project to."""
    out = np.zeros(view.shape, bool)
    uv, _, inside = view.project(lattice.centres[voxels])
    ij = uv[inside].astype(np.int64)
    out[ij[:, 1], ij[:, 0]] = True
    return pixels.close(out, 5)


def target_of(past: Sequence[Past], lattice: Lattice, voxels: Voxels) -> Target:
    """A component of the arrivals as a place to register an object to."""
    wanted = []
    for p in past:
        here = shadow_of(p.view, lattice, voxels)
        never = ~pixels.dilate(p.changed.mask | p.changed.light, 3)
        wanted.append(np.where(p.open & here, 1.0, 0.0).astype(np.float32) - never.astype(np.float32))
    return Target(lattice.centres[voxels].mean(0), tuple(wanted))


def best_fit(
    field: Field, old: Old, olds: Sequence[Old], past: Sequence[Past], targets: Sequence[Target], up: Array,
    configs: tuple[AssociateConfig, RegisterConfig, RefineConfig], extra: Sequence[Tensor] = (),
) -> tuple[float, PoseChange | None]:
    """The pose change that best explains the photos with one old object, and its registration score."""
    believe, search, fine = configs
    found: list[Candidate] = []
    for target in targets:
        found += register(old.cloud, past, target, up, search, extra)
    found.sort(key=lambda c: c.score)
    best: PoseChange | None = None
    for candidate in found[: believe.try_refined]:
        if candidate.score > believe.fits or (best is not None and candidate.score > found[0].score + 0.15):
            break
        ready = refiner(field, old, past, olds, candidate.new_from_old, fine)
        if not ready.crops:
            continue
        change = refine(ready, candidate.new_from_old)
        if best is None or change.explained > best.explained + 0.02:
            best = change
    if best is not None and (best.explained < believe.explains or best.explained < best.before + believe.gains):
        best = None
    return (found[0].score if found else 2.0), best


def take_off(field: Field, past: Sequence[Past], old: Old, change: PoseChange) -> list[Past]:
    """The photos once a placed object is accounted for: its pixels are explained, and it stands in front."""
    out = []
    for p in past:
        view = p.view
        _, depth, opacity = object_alone(field, old.grid(), view.rays, change.new_from_old, 56)
        shown = ((opacity > 0.5).numpy() & (depth.numpy() <= p.depth.ravel() + 0.5 * old.radius)).reshape(view.shape)
        shown = pixels.dilate(shown, 2)
        mask = p.changed.mask & ~shown
        front = np.where(shown, np.minimum(p.depth, depth.numpy().reshape(view.shape)), p.depth)
        out.append(replace(p, changed=replace(p.changed, mask=mask), depth=front))
    return out


def moved_noticeably(old: Old, change: PoseChange, pixel: float) -> bool:
    """Whether any part of the object moved by more than about a pixel."""
    points = old.cloud.points.astype(np.float64)
    import torch

    moved = transform(change.new_from_old, torch.from_numpy(points)).numpy()
    return bool(np.linalg.norm(moved - points, axis=-1).max() > 1.2 * pixel)


def newcomers(voxels: Voxels, past: Sequence[Past], lattice: Lattice, config: HullConfig) -> list[Voxels]:
    """Components of the arrivals that explain changed pixels which nothing else does."""
    out = []
    thick = grown(components_core(voxels), 2, voxels) if voxels.any() else voxels
    for part in components(thick, config.smallest):
        shares = []
        for p in past:
            here = shadow_of(p.view, lattice, part) & p.known
            if here.sum() >= 6:
                shares.append(float((here & p.open).sum() / here.sum()))
        if len(shares) >= min(2, len(past)) and float(np.median(shares)) > 0.6:
            out.append(part)
    return out


def components_core(voxels: Voxels) -> Voxels:
    """Voxels that survive an erosion: thin sheets left between masks do not."""
    from scipy import ndimage

    return ndimage.binary_erosion(voxels, np.ones((3, 3, 3), bool), iterations=1)
