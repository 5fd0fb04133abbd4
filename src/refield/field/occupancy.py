"""Keeping the occupancy grid of a field in training: which cells may hold something, and which are ever seen."""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.pixels import PixelBank
from refield.field.radiance import HashField
from refield.field.render import CHUNK
from refield.field.volrend import weights

_EVERY = 16  # steps between updates
_OPACITY = 5e-2  # a cell is kept if a sample in it would be more opaque than this
_WEIGHT = 5e-3  # and if some ray gives it at least this much of its colour: hidden cells cost half of all samples
_DECAY = 0.8
_BACKGROUND = 5.0  # core radii; a cell that no ray ever crossed is taken for empty, unless it is further out


class OccupancyTrainer:
    """Two running maxima a cell: the opacity of a sample in it, and the weight that rays gave it.

    Both follow the training samples themselves; cells that are not sampled are probed at random, so that what was
    taken for empty can come back.
    """

    def __init__(self, model: HashField, cull_from: int = 128, allowed: Tensor | None = None) -> None:
        """``allowed`` (R**3,) bool: cells that may hold something at all; all by default."""
        self.model, self.cull_from = model, cull_from
        cells = model.sampler.resolution**3
        self.allowed = torch.ones(cells, dtype=torch.bool) if allowed is None else allowed
        self.opacity = torch.zeros(cells)
        self.weight = torch.full((cells,), 16 * _WEIGHT)  # the benefit of the doubt
        self.recent_weight = torch.full((cells,), -1.0)  # since the last update; -1: no sample fell here
        self.recent_sigma = torch.zeros(cells)
        distance = torch.cat([model.sampler.distance(c) for c in torch.arange(cells).split(1 << 20)])
        self.visited = distance > _BACKGROUND
        self.lengths = torch.cat([model.sampler.step_at(c) for c in torch.arange(cells).split(1 << 20)])

    def observe(self, step: int, x: Tensor, w: Tensor, sigmas: Tensor) -> None:
        """After each step: samples' positions (S, 3), weights (S,), densities (S,). Renews the grid every 16 steps."""
        cells = self.model.sampler.cells(x)
        kernels.scatter_max(w, cells, self.recent_weight)
        kernels.scatter_max(sigmas, cells, self.recent_sigma)
        if step % _EVERY == _EVERY - 1:
            self._update(step)

    def _update(self, step: int) -> None:
        seen = self.recent_weight >= 0
        self.visited |= seen
        opacity = -torch.expm1(-self.recent_sigma * self.lengths)
        self.opacity = torch.where(seen, torch.maximum(self.opacity * _DECAY, opacity), self.opacity)
        self.weight = torch.where(seen, torch.maximum(self.weight * _DECAY, self.recent_weight), self.weight)
        self.recent_weight.fill_(-1.0)
        self.recent_sigma.zero_()
        cells = self._cells_to_probe(step)
        self.opacity[cells] = torch.maximum(self.opacity[cells] * _DECAY, self._probe(cells))
        keep = self.opacity > min(_OPACITY, float(self.opacity.mean()))
        if step >= self.cull_from:
            # a few hidden cells get another chance, since geometry still changes
            again = torch.rand(len(self.weight)) < 0.01
            self.weight[again] = self.weight[again].clamp_min(4 * _WEIGHT)
            keep &= self.weight > _WEIGHT
        if step >= 4 * self.cull_from:
            keep &= self.visited
        self._set(keep)

    def _cells_to_probe(self, step: int) -> Tensor:
        n = len(self.opacity)
        return torch.randint(n, (n // 8 if step < 4 * _EVERY else n // 32,))

    def _probe(self, cells: Tensor) -> Tensor:
        with torch.no_grad():
            parts = [self.model.density(self.model.sampler.points_in(c)) for c in cells.split(1 << 16)]
        return -torch.expm1(-torch.cat(parts) * self.lengths[cells])

    def _set(self, keep: Tensor) -> None:
        keep = keep & self.allowed
        self.model.looking_where(keep.to(torch.uint8).reshape(self.model.sampler.grid.shape))

    def settle(self, pixels: PixelBank, rays: int = 200_000) -> None:
        """The final grid: every opaque cell that some training ray sees. Leaves the model in training mode.

        Where no ray ever went the density is whatever the networks make of it: haze before a new camera.
        """
        everything = torch.arange(len(self.opacity))
        opaque = self.opacity > _OPACITY / 4
        for _ in range(2):
            for cells in everything[opaque].split(1 << 18):
                self.opacity[cells] = torch.maximum(self.opacity[cells], self._probe(cells))
        keep = self.opacity > min(_OPACITY, float(self.opacity.mean()))
        self._set(keep)
        seen = torch.zeros_like(self.weight)
        chosen = torch.randperm(len(pixels))[:rays]
        with torch.no_grad():
            for part in chosen.split(CHUNK):
                r = pixels.rays(part)
                samples = self.model.samples(r, jitter=True)
                x, _ = samples.positions(r)
                kernels.scatter_max(weights(self.model.density(x), samples), self.model.sampler.cells(x), seen)
        seen = torch.maximum(seen, torch.where(self.visited, self.weight, 0))
        self._set(keep & (seen > _WEIGHT / 2))
