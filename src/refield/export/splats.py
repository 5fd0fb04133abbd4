"""Surfaces as Gaussian splats: flat discs on them, as large as they are apart, and a far dome of what lies beyond.

Written as 3DGS ``.ply`` and ``.spz`` by gsply. Colours do not depend on where they are seen from (degree 0).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from refield.export.seen import View
from refield.export.surface import Points, Surface, cells_of, mean_over

WIDE = 0.5
"""deviations of a disc, in distances between neighbours: wider is blurred, narrower has holes"""
_FLAT = 0.1  # of that is its thickness
_LARGEST = 3.0  # footprints: a lone point is no large disc
_OPACITY = 0.99
DOME = 40_000
"""splats on a whole sphere, 1.0 degree apart"""
_DOME_FAR = 30.0  # times as far away as the outermost camera is from the middle
_DOME_WIDE = 0.7
_DC = 0.28209479177387814  # the harmonic of degree 0
_SPZ_BITS = 23  # of a coordinate, beside its sign


@dataclass(frozen=True)
class Splats:
    """G Gaussians."""

    means: Tensor
    """(G, 3) float32, world"""
    scales: Tensor
    """(G, 3) float32: deviations along the three axes, world units; the last is the normal's"""
    quaternions: Tensor
    """(G, 4) float32, unit, w x y z: world from the splat's axes"""
    opacities: Tensor
    """(G,) float32 in [0, 1]"""
    rgb: Tensor
    """(G, 3) float32 in [0, 1]"""

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Tensor) -> Splats:
        return Splats(*(getattr(self, f.name)[index] for f in fields(self)))


def splats_of(surface: Surface, views: Sequence[View], around: int = DOME) -> Splats:
    """Discs on the surfaces, and the dome on which lies what the views show beyond them; ``around``: splats on a whole
    one."""
    discs, dome = discs_of(surface.points), _dome(surface, views, around)
    return Splats(*(torch.cat([getattr(discs, f.name), getattr(dome, f.name)]) for f in fields(Splats)))


def discs_of(points: Points) -> Splats:
    """One for each point."""
    wide = WIDE * torch.minimum(points.spacing, _LARGEST * points.footprint)
    return _discs(points.drawn, points.normal, wide, points.rgb)


def _discs(means: Tensor, normals: Tensor, wide: Tensor, rgb: Tensor) -> Splats:
    scales = torch.stack([wide, wide, wide * _FLAT], -1)
    return Splats(means, scales, _turned(normals), torch.full((len(means),), _OPACITY), rgb)


def _turned(normals: Tensor) -> Tensor:
    """Quaternions (P, 4) that take +z to the normals (P, 3)."""
    x, y, z = normals.unbind(-1)
    q = torch.stack([1 + z, -y, x, torch.zeros_like(x)], -1)
    upside_down = q.norm(dim=-1) < 1e-4
    q[upside_down] = q.new_tensor([0.0, 1.0, 0.0, 0.0])
    return functional.normalize(q, dim=-1)


def _dome(surface: Surface, views: Sequence[View], around: int) -> Splats:
    """What lies too far away for its distance to be known, around the middle of the cameras.

    It is so far out that it shows much the same from wherever photos were taken.
    """
    from scipy.spatial import cKDTree

    step = math.sqrt(4 * math.pi / around)
    way = _sphere(around)
    if len(surface.far_directions) == 0:
        way = way[:0]
        rgb = way
    else:
        cells = cells_of(surface.far_directions, torch.full((len(surface.far_directions),), step / 2))
        towards, shown_rgb = mean_over(surface.far_directions, cells), mean_over(surface.far_rgb, cells)
        distance, near = cKDTree(towards.numpy()).query(way.numpy(), 8, distance_upper_bound=2 * step)
        shown = torch.from_numpy(np.isfinite(distance).any(1))
        weight = torch.from_numpy(np.exp(-((distance / step) ** 2))).float()[shown][..., None]
        # what is missing of the eight has no weight; its number is one too many
        near = torch.from_numpy(near).clamp_max(len(towards) - 1)[shown]
        rgb = (weight * shown_rgb[near]).sum(1) / weight.sum(1)
        way = way[shown]
    at = torch.stack([view.centre for view in views])
    middle = at.mean(0)
    radius = _DOME_FAR * max(float((at - middle).norm(dim=-1).max()), float(torch.finfo(torch.float32).tiny))
    return _discs(middle + radius * way, -way, torch.full((len(way),), _DOME_WIDE * step * radius), rgb)


def _sphere(count: int) -> Tensor:
    """So many directions (count, 3), evenly spread: a spiral of golden angles."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * i / count, math.pi * (1 + math.sqrt(5)) * i
    r = (1 - z * z).sqrt()
    return torch.stack([r * turn.cos(), r * turn.sin(), z], -1).float()


def write_splats(folder: Path, name: str, splats: Splats) -> list[Path]:
    """``name.ply`` as 3DGS writes it, and ``name.spz`` (version 3); both in the world's own coordinates.

    SPZ keeps positions in steps: a four-millionth of the way to the farthest splat's coordinate, about, or finer.
    """
    import gsply

    data = gsply.GSData.from_arrays(
        means=splats.means.numpy(),
        scales=splats.scales.log().numpy(),
        quats=splats.quaternions.numpy(),
        opacities=torch.logit(splats.opacities).numpy(),
        sh0=((splats.rgb - 0.5) / _DC).numpy(),
        format="ply",  # logarithms and logits, whatever their values look like
    )
    ply, spz = folder / f"{name}.ply", folder / f"{name}.spz"
    gsply.plywrite(ply, data)
    gsply.write_spz(spz, data, fractional_bits=_bits(splats.means))
    return [ply, spz]


def _bits(means: Tensor) -> int:
    """Bits behind the point that leave room for the largest coordinate."""
    largest = float(means.abs().max()) if len(means) else 1.0
    whole = max(math.ceil(math.log2(max(largest, 1e-9) * 1.0001)), -1)
    return min(max(_SPZ_BITS - whole, 1), 23)
