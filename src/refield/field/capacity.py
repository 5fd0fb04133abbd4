"""How large a field has to be for its photos: where its core lies, how fine its cells are, how many entries it has.

Everything follows from the pixels' footprints at what is seen there: a cell that is finer than a pixel learns nothing,
a coarser one blurs. Letters: P places that photos show, with their footprints, the side of a pixel there, world units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from refield.field.encoding import Contraction
from refield.field.render import render_many
from refield.field.radiance import Field
from refield.scene.capture import Capture, Frame, camera_rays, Rays

_PLACES = 20_000
_MOST_PLACES_A_PHOTO = 500
_FINE = 0.8  # of the places are shown as fine as the photos
_RADII = torch.logspace(math.log10(0.1), math.log10(4.0), 33)  # of the cameras' distance, that are tried
_PIXELS_PER_ENTRY = 60
"""pixels per entry of a level's table: more learn nothing new about it, fewer have collisions among themselves"""


@dataclass(frozen=True)
class Seen:
    """Places that photos show."""

    places: Tensor
    """(P, 3) world"""
    footprints: Tensor
    """(P,) side of a pixel there, world units"""

    @staticmethod
    def by_points(capture: Capture) -> Seen:
        """The reconstruction's points, as often as training photos have them in the picture."""
        points = capture.points[:: max(1, len(capture.points) // _MOST_PLACES_A_PHOTO)]
        places, footprints = [], []
        for frame in capture.train:
            inverse = torch.linalg.inv(frame.world_from_cam).float()
            local = points @ inverse[:3, :3].T + inverse[:3, 3]
            uv, z = frame.camera.project(local)
            size = torch.tensor([frame.camera.width, frame.camera.height])
            shown = (z > 0) & ((uv > 0) & (uv < size)).all(-1)
            places.append(points[shown])
            footprints.append(z[shown] / frame.camera.fx)
        return Seen(torch.cat(places), torch.cat(footprints))

    @staticmethod
    def by_field(field: Field, frames: tuple[Frame, ...]) -> Seen:
        """What a first field shows from where the photos were taken."""
        each = max(min(_PLACES // len(frames), _MOST_PLACES_A_PHOTO), 1)
        g = torch.Generator().manual_seed(0)
        lines, angles = [], []
        for f in frames:
            size = torch.tensor([f.camera.width, f.camera.height])
            lines.append(camera_rays(f.camera, f.world_from_cam, torch.rand(each, 2, generator=g) * size))
            angles.append(torch.full((each,), 1 / f.camera.fx))
        rays = Rays(torch.cat([r.origins for r in lines]), torch.cat([r.directions for r in lines]))
        found = render_many(field, rays)
        solid = (found.opacity > 0.5) & found.depth.isfinite()
        distance = found.depth[solid]
        places = rays.origins[solid] + rays.directions[solid] * distance[:, None]
        return Seen(places, distance * torch.cat(angles)[solid])


def fitting_core(seen: Seen, centre: Tensor, distance: float) -> tuple[Contraction, float]:
    """The core cube for which the fewest cells a side are needed, and how many: so that 80 % of the places have cells
    no larger than a pixel there. ``distance``: of the cameras from ``centre`` (3,), in which radii are tried."""
    reach = (seen.places - centre).abs().amax(-1)
    best, radius = math.inf, 0.6 * distance
    for r in (_RADII * distance).tolist():
        cells = float((4 * r * stretch(reach / r) / seen.footprints).quantile(_FINE))
        if cells < best:
            best, radius = cells, r
    return Contraction(centre, radius), best


def stretch(m: Tensor) -> Tensor:
    """How much larger than in the core cells are at a distance of ``m`` core radii: m^2 outwards, m / (2 - 1 / m) along
    both other axes; their geometric mean."""
    m = m.clamp_min(1.0)
    return (m**2 * (m / (2 - 1 / m)) ** 2) ** (1 / 3)


def log2_table(pixels: int, least: int, most: int) -> int:
    """Entries of a level's table that so many pixels can fill, as a power of two."""
    return int(min(max(round(math.log2(max(pixels, 1) / _PIXELS_PER_ENTRY)), least), most))
