"""The field that a fit begins with: where it lies and how fine it is follow from the cameras, and from what a first
look shows around them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from refield.field.encoding import Contraction
from refield.field.radiance import Field, HashField
from refield.field.render import render_many
from refield.field.sampling import RESOLUTION, OccupancySampler
from refield.scene.capture import Capture, Frame, Rays, camera_rays, centres

if TYPE_CHECKING:
    from refield.field.fit import FitConfig

COLOUR_IN, DIRECTED = 3, 15  # which parameter takes in directions, and in how many columns, but for a constant
_CORE = 0.6  # of the cameras' distance from its centre
_HELD, _LARGEST = 0.75, 4.0  # see `around`
_PLACES = 20_000  # that a first field is asked for


def new_field(capture: Capture, config: FitConfig, seed: int, core: Contraction | None = None) -> HashField:
    """Random weights, in the shape and the place that suit the photos; ``core``: see `around`."""
    usual = place_contraction(capture)
    contraction = usual if core is None else core
    shape = config.field
    if config.finest_auto:
        shape = replace(shape, finest=finest_for(capture.train, usual, shape.log2_table))
    # About two pixels, but half a cell of the occupancy grid at least: with more samples a ray fewer rays are seen in
    # the same time. On real photographs a third as long cost 2 dB.
    cells = max(2 / shape.finest, 0.5 / RESOLUTION)
    grid = torch.ones(RESOLUTION, RESOLUTION, RESOLUTION, dtype=torch.uint8)
    model = HashField(shape, OccupancySampler(contraction, grid, 4 * contraction.radius * cells), seed)
    if config.photos.exposures:  # see `PhotoModel.plain`
        with torch.no_grad():
            model.networks[COLOUR_IN - 1][:, -DIRECTED:] = 0
    return model


def opened(start: HashField) -> HashField:
    """A copy of a field that looks everywhere, its weights free: things may have come to where nothing was."""
    model = HashField.from_state(*start.state()).requires_grad_(True)
    model.sampler = replace(model.sampler, per_step=1.0)
    model.looking_where(torch.ones_like(model.sampler.grid))
    return model


def place_contraction(capture: Capture) -> Contraction:
    """Where the core cube goes: around what the cameras look at, reaching half-way to them.

    The centre is the least-squares meeting point of the optical axes, held to what the cameras have before them where
    the axes hardly meet (a forward-facing capture): the points of the reconstruction, or else their own spread.
    """
    eyes = centres(capture.frames)
    axes = torch.stack([f.world_from_cam[:3, 2] for f in capture.frames])
    eye = torch.eye(3, dtype=torch.float64)
    across = eye - axes[:, :, None] * axes[:, None, :]
    spread = (eyes - eyes.mean(0)).norm(dim=-1).mean().clamp_min(1e-6)
    ahead = _depth_of_points(capture, eyes, axes)
    guess = (eyes + axes * (spread if ahead is None else ahead)).mean(0)
    hold = 1e-3 * len(eyes)
    centre = torch.linalg.solve(across.sum(0) + hold * eye, (across @ eyes[:, :, None]).sum(0)[:, 0] + hold * guess)
    if ahead is not None and float(((centre - eyes) * axes).sum(-1).median()) < 0.3 * ahead:
        centre = guess  # the axes cross by chance, among the cameras or behind them
    distance = (eyes - centre).norm(dim=-1).median()
    return Contraction(centre.float(), float(distance) * _CORE)


def stand_outside(core: Contraction, frames: Sequence[Frame]) -> bool:
    """Whether most cameras stand outside of the core's sphere, and look into it: of one that `around` made larger, they
    are a part."""
    return float((centres(frames).float() - core.centre.cpu()).norm(dim=-1).median()) > core.radius


def around(core: Contraction, first: Field, frames: Sequence[Frame]) -> Contraction:
    """The core with three quarters in it of what the photos show, going by a first field; four times as large at most,
    and never smaller.

    Outside of the core cells grow with the square of the distance, and so do blur and haze: left-out photos of two real
    scenes whose walls or houses lay there gained 1 and 2 dB. Much larger ones lose it again (see docs/results.md).
    """
    g = torch.Generator().manual_seed(0)
    each = max(_PLACES // len(frames), 1)
    sizes = torch.tensor([(f.camera.width, f.camera.height) for f in frames])
    lines = [
        camera_rays(f.camera, f.world_from_cam, torch.rand(each, 2, generator=g) * size)
        for f, size in zip(frames, sizes)
    ]
    rays = Rays(torch.cat([r.origins for r in lines]), torch.cat([r.directions for r in lines]))
    device = first.sampler.grid.device
    with device:
        shown = render_many(first, Rays(rays.origins.to(device), rays.directions.to(device)))
    opacity, depth = shown.opacity.cpu(), shown.depth.cpu()
    solid = (opacity > 0.5) & depth.isfinite()
    if not solid.any():
        return core
    reach = core.reach(rays.origins[solid] + rays.directions[solid] * depth[solid, None])
    return replace(core, radius=core.radius * min(max(float(reach.quantile(_HELD)), 1.0), _LARGEST))


def _depth_of_points(capture: Capture, centres: Tensor, axes: Tensor, most: int = 5000) -> Tensor | None:
    """How far before the cameras the reconstruction's points usually lie; None without points."""
    points = capture.points[:: max(1, len(capture.points) // most)].double()
    depths = ((points[None] - centres[:, None]) * axes[:, None]).sum(-1)
    return depths[depths > 0].median() if len(points) >= 20 and (depths > 0).any() else None


def finest_for(frames: tuple[Frame, ...], contraction: Contraction, log2_table: int) -> int:
    """Cells a side so that the finest is about a pixel wide where the axes meet, within what a table can hold.

    A surface crosses about n^2 of a level's n^3 cells. Past n = 2.5 sqrt(entries) collisions cost more than detail
    gives: on real photographs 1253 cells came out 1.8 dB below 600 at 2^16 entries.
    """
    distances = torch.stack([(f.centre.float() - contraction.centre).norm() / f.camera.fx for f in frames])
    wanted = 4 * contraction.radius / float(distances.median())
    return int(min(max(wanted, 256), 2.5 * 2 ** (log2_table / 2)))
