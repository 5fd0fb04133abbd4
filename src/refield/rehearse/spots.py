"""Where something can stand: seen by enough photos, on a plane that holds it up, with free space above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.rehearse.surfaces import Surfaces, View
from refield.scene.pose import rigid

_CANDIDATES = 400
_FEWEST_OLD = 1 / 3
"""of the old photos see a spot"""
_MISSED_NEW = 1
"""of the new photos, at most, does not"""
_INSET = 0.1  # of a picture's sides: a spot nearer to the border does not count as seen
_SPARE = 1.15  # of an object's size is kept free
_DUST = 0.02  # of the points over a spot may be the field's noise


@dataclass(frozen=True)
class Site:
    """A place at which things can be put, and how large they are there."""

    surfaces: Surfaces
    up: Tensor
    """(3,) float64: of the plane, or of the scene"""
    offset: float | None
    """of the plane along ``up``; None: there is none, things float"""
    even: float
    """how far from the plane its own points lie, world units"""
    centres: NDArray[np.float64]
    """(S, 3) candidate spots, on the plane or in the air"""
    width: float
    """of the picture at their distance, by its shorter side, world units"""

    @property
    def floating(self) -> bool:
        return self.offset is None


Groups = tuple[list[View], list[View], list[View]]
"""the views of the photos before, after and to measure by"""


def sites_of(surfaces: Surfaces, up: Tensor, groups: Groups, seed: int) -> list[Site]:
    """The planes on which enough photos see enough places, the one with the most first; and the air."""
    rng = np.random.default_rng([seed, 7])
    found = []
    for plane in surfaces.planes:
        even = max(3 * plane.noise, 1e-9)
        on = surfaces.points[np.abs(plane.height(surfaces.points)) < even].astype(np.float64)
        if len(on) == 0:
            continue
        normal = torch.from_numpy(plane.normal.astype(np.float64))
        normal = normal / normal.norm()
        on = on[rng.choice(len(on), min(_CANDIDATES, len(on)), replace=False)]
        on -= (on @ normal.numpy() - plane.offset)[:, None] * normal.numpy()
        spots, width = _well_seen(on, surfaces, groups)
        if len(spots):
            found.append(Site(surfaces, normal, plane.offset, even, spots, width))
    found.sort(key=lambda site: -len(site.centres))
    return [*found, _in_the_air(surfaces, up, groups, rng)]


def _well_seen(spots: NDArray[np.float64], surfaces: Surfaces, groups: Groups) -> tuple[NDArray[np.float64], float]:
    """Those of the spots (S, 3) that enough photos see, best first; and how wide a picture is there."""
    at = torch.from_numpy(spots)
    seen = [torch.stack([view.sees(at, surfaces.noise, _INSET) for view in group]) for group in groups]
    before, after, evaluation = (s.sum(0) for s in seen)
    enough = (before >= _FEWEST_OLD * len(groups[0])) & (after >= len(groups[1]) - _MISSED_NEW) & (evaluation >= 1)
    order = before[enough].argsort(descending=True)
    chosen = at[enough][order]
    if len(chosen) == 0:
        return chosen.numpy(), 0.0
    views = [view for group in groups for view in group]
    widths = [
        (chosen - v.frame.centre).norm(dim=-1) * min(v.camera.width / v.camera.fx, v.camera.height / v.camera.fy)
        for v in views
    ]
    return chosen.numpy(), float(torch.stack(widths).median())


def _in_the_air(surfaces: Surfaces, up: Tensor, groups: Groups, rng: np.random.Generator) -> Site:
    """Free places in front of the surfaces, in the middle of what the photos show."""
    start = torch.stack([view.frame.centre for view in surfaces.views]).numpy()
    goal = surfaces.points[rng.choice(len(surfaces.points), 20 * _CANDIDATES)].astype(np.float64)
    part = rng.uniform(0.3, 0.9, (len(goal), 1))
    spots = start[rng.integers(len(start), size=len(goal))] * (1 - part) + goal * part
    spots, width = _well_seen(spots, surfaces, groups)
    return Site(surfaces, up.double(), None, 0.0, spots[:_CANDIDATES], width)


def upright(site: Site, degrees: float) -> Tensor:
    """(3, 3) float64: z is the site's up, turned about it."""
    across = torch.linalg.svd(site.up[None])[2][1]
    beside = torch.linalg.cross(site.up, across)
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    x = c * across + s * beside
    return torch.stack([x, torch.linalg.cross(site.up, x), site.up], -1)


def is_free(site: Site, spot: NDArray[np.float64], radius: float, height: float) -> bool:
    """Whether a thing of this radius and height finds room at a spot and, where there is a plane, stands firm."""
    offset = site.surfaces.points - spot
    up = site.up.numpy()
    above = offset @ up
    beside = np.linalg.norm(offset - above[:, None] * up, axis=-1)
    within = beside < _SPARE * radius
    if site.floating:
        blocked = within & (np.abs(above) < _SPARE * height / 2)
        views = site.surfaces.views
        across = 2 * radius / site.width * min(views[0].depth.shape)  # pixels that a surface there would fill
        return bool(blocked.sum() <= _DUST * across**2 * len(views) * site.surfaces.kept)
    over = within & (above > 2 * site.even) & (above < _SPARE * height)
    ground = within & (np.abs(above) <= site.even)
    if over.sum() > _DUST * ground.sum() or ground.sum() < 12:
        return False
    frame = upright(site, 0.0).numpy()
    quarters = (offset[ground] @ frame[:, 0] > 0) * 2 + (offset[ground] @ frame[:, 1] > 0)
    return bool(np.bincount(quarters, minlength=4).min() >= 0.1 * ground.sum())  # not half over an edge


def pose_at(site: Site, spot: NDArray[np.float64], rotation: Tensor, lift: float) -> Tensor:
    """(4, 4) float64: a thing turned so, its middle ``lift`` over the spot, or at it in the air."""
    return rigid(rotation, torch.from_numpy(spot) + (0.0 if site.floating else lift) * site.up)
