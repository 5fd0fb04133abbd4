"""T refined by what the field shows (§9.3, §10.2.3).

Eqs. 13 and 14 render the photos' rays through the old field with every sample moved back by T, so that a ray that meets
the object where it is now sees what the field knows of it where it was. The gradient of Eq. 15 is taken by autograd
through the field: `HashField`, `NerfactoField` and fields updated from them hand it on to positions and directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refield.estimate.detect import Mask
from refield.estimate.look import View
from refield.field.radiance import Field
from refield.field.render import visible_samples
from refield.field.volrend import composite
from refield.scene.capture import Rays
from refield.scene.pose import exp, invert, rigid, rotate, transform
from refield.vision import pixels


@dataclass(frozen=True)
class RefineConfig:
    """Adam on δT."""  # §10.2.3

    rate: float = 0.001
    """learning rate; radians, and world units in which the paper's scenes are about 2 wide"""
    steps: int = 500
    """at most"""
    patience: int = 100
    """steps without a better state after which it ends"""
    rays: int = 4096
    """of all photos together, drawn evenly from the interest regions"""
    dilations: int = 10
    """of matched pixels, with a 3 x 3 kernel: the interest regions"""
    keeps: float = 0.5
    """part of the features that agreed at the start and must at the end. Where a side of the object stands in another
    light than before, other places can look more like it than its own"""
    seed: int = 0
    """of the rays drawn"""


@dataclass(frozen=True)
class Refined:
    """The best state that was met."""

    new_from_old: Tensor
    """(4, 4) float64"""
    loss: float
    """Eq. 15, a ray's mean; colours in [0, 1]"""
    before: float
    """the same at the start"""
    steps: int
    """that were made"""


@dataclass(frozen=True)
class Targets:
    """Rays of the photos, and what the photos show there."""

    rays: Rays
    colours: Tensor
    """(N, 3) in [0, 1]"""


def refine(field: Field, targets: Targets, start: Tensor, config: RefineConfig) -> Refined:
    """Improve T (4, 4) from ``start``: T = start · δT, δT in SO(3) x R³, zero at first (Eq. 15).

    The rays are drawn once and not at every step. Losses of different rays cannot be compared, and both the patience
    and the best state rest on comparing them.
    """
    if len(targets.rays) == 0:
        return Refined(start, 0.0, 0.0, 0)
    delta = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([delta], lr=config.rate)
    best, lowest, first, at, step = start, float("inf"), 0.0, 0, 0
    for step in range(config.steps + 1):
        pose = start @ turned_and_shifted(delta)
        loss = (moved_colours(field, targets.rays, pose) - targets.colours).square().sum(-1).mean()
        now = float(loss.detach())
        first = now if step == 0 else first
        if now < lowest:
            best, lowest, at = pose.detach().clone(), now, step
        if step - at >= config.patience or step == config.steps:
            break
        (delta.grad,) = torch.autograd.grad(loss, [delta])
        adam.step()
    return Refined(best, lowest, first, step)


def turned_and_shifted(delta: Tensor) -> Tensor:
    """δT (4, 4) of a shift and a rotation vector (6,): on SO(3) x R³ the two do not mix, as they would on SE(3)."""
    turn = exp(torch.cat([torch.zeros_like(delta[3:]), delta[3:]]))[:3, :3]
    return rigid(turn, delta[:3])


def moved_colours(field: Field, rays: Rays, new_from_old: Tensor) -> Tensor:
    """Eqs. 13 and 14: the colour of rays (N,) through the field moved by T, (N, 3), differentiable in T (4, 4)."""
    old_from_new = invert(new_from_old)
    with torch.no_grad():
        there = Rays(transform(old_from_new, rays.origins), rotate(old_from_new, rays.directions))
        samples = visible_samples(field, there)
    x, d = samples.positions(rays)
    sigmas, rgbs = field(transform(old_from_new, x), rotate(old_from_new, d))
    return composite(sigmas, rgbs, samples).rgb


def interest(features: Sequence[tuple[View, Mask]], masks: Sequence[Mask], config: RefineConfig) -> Targets:
    """Rays drawn evenly from the interest regions (iNeRF): features' pixels (H, W) of each photo, dilated.

    Only pixels of the object's ``masks`` (H, W) count (§9.3): around it the moved field shows what does not move.
    """
    chosen = [np.flatnonzero(pixels.dilate(f, config.dilations) & m) for (_, f), m in zip(features, masks)]
    origins, directions, colours = [torch.zeros(0, 3)], [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    for (view, _), index in zip(features, chosen):
        at = torch.from_numpy(index)
        origins.append(view.rays.origins[at])
        directions.append(view.rays.directions[at])
        colours.append(torch.from_numpy(view.photo.reshape(-1, 3))[at])
    every = Targets(Rays(torch.cat(origins), torch.cat(directions)), torch.cat(colours))
    if len(every.rays) <= config.rays:
        return every
    g = torch.Generator().manual_seed(config.seed)
    drawn = torch.randperm(len(every.rays), generator=g)[: config.rays]
    return Targets(every.rays[drawn], every.colours[drawn])
