"""The field that a fit begins with: where it lies and how fine it is follow from the cameras alone."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from refield.field.encoding import Contraction
from refield.field.radiance import HashField
from refield.field.sampling import RESOLUTION, OccupancySampler
from refield.scene.capture import Capture, Frame

if TYPE_CHECKING:
    from refield.field.fit import FitConfig

COLOUR_IN, DIRECTED = 3, 15  # which parameter takes in directions, and in how many columns, but for a constant


def new_field(capture: Capture, config: FitConfig, seed: int) -> HashField:
    """Random weights, in the shape and the place that suit the photos."""
    contraction = place_contraction(capture)
    shape = config.field
    if config.finest_auto:
        shape = replace(shape, finest=finest_for(capture.train, contraction, shape.log2_table))
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
    model.looking_where(torch.ones_like(model.sampler.grid))
    return model


def place_contraction(capture: Capture) -> Contraction:
    """Where the core cube goes: around what the cameras look at, reaching half-way to them.

    The centre is the least-squares meeting point of the optical axes, held to what the cameras have before them where
    the axes hardly meet (a forward-facing capture): the points of the reconstruction, or else their own spread.
    """
    centres = torch.stack([f.centre for f in capture.frames])
    axes = torch.stack([f.world_from_cam[:3, 2] for f in capture.frames])
    eye = torch.eye(3, dtype=torch.float64)
    across = eye - axes[:, :, None] * axes[:, None, :]
    spread = (centres - centres.mean(0)).norm(dim=-1).mean().clamp_min(1e-6)
    ahead = _depth_of_points(capture, centres, axes)
    guess = (centres + axes * (spread if ahead is None else ahead)).mean(0)
    hold = 1e-3 * len(centres)
    centre = torch.linalg.solve(across.sum(0) + hold * eye, (across @ centres[:, :, None]).sum(0)[:, 0] + hold * guess)
    if ahead is not None and float(((centre - centres) * axes).sum(-1).median()) < 0.3 * ahead:
        centre = guess  # the axes cross by chance, among the cameras or behind them
    distance = (centres - centre).norm(dim=-1).median()
    return Contraction(centre.float(), float(distance) * 0.6)


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
