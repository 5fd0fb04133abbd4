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
_OPACITY = 1e-2  # a cell is kept if a sample in it would be more opaque than this
_WEIGHT = 2e-3  # and if some ray gives it at least this much of its colour: hidden cells cost half of all samples
_DECAY_OPACITY, _DECAY_WEIGHT = 0.95, 0.9


class OccupancyTrainer:
    """Two running maxima a cell: the opacity of a sample in it, and the weight that rays gave it."""

    def __init__(self, model: HashField, cull_from: int = 256) -> None:
        self.model, self.cull_from = model, cull_from
        cells = model.sampler.resolution**3
        self.opacity = torch.zeros(cells)
        self.weight = torch.ones(cells)  # the benefit of the doubt
        self.recent = torch.full((cells,), -1.0)  # since the last update; -1: no sample fell here
        self.lengths = torch.cat([model.sampler.step_at(c) for c in torch.arange(cells).split(1 << 20)])

    def observe(self, step: int, x: Tensor, w: Tensor) -> None:
        """After each step: sample positions (S, 3) and their weights (S,). Updates the grid every 16 steps."""
        kernels.scatter_max(w, self.model.sampler.cells(x), self.recent)
        if step % _EVERY == _EVERY - 1:
            self._update(step)

    def _update(self, step: int) -> None:
        self.opacity *= _DECAY_OPACITY
        cells = self._cells_to_probe(step)
        self.opacity[cells] = torch.maximum(self.opacity[cells], self._probe(cells))
        seen = self.recent >= 0
        self.weight = torch.where(seen, torch.maximum(self.weight * _DECAY_WEIGHT, self.recent), self.weight)
        self.recent.fill_(-1.0)
        keep = self.opacity > min(_OPACITY, float(self.opacity.mean()))
        if step >= self.cull_from:
            # a few hidden cells get another chance, since geometry still changes
            again = torch.rand(len(self.weight)) < 0.01
            self.weight[again] = self.weight[again].clamp_min(4 * _WEIGHT)
            keep &= self.weight > _WEIGHT
        self._set(keep)

    def _cells_to_probe(self, step: int) -> Tensor:
        n = len(self.opacity)
        if step < 4 * _EVERY:
            return torch.randint(n, (n // 4,))
        occupied = self.model.sampler.grid.reshape(-1).nonzero()[:, 0]
        some = occupied[torch.randint(len(occupied), (min(n // 32, len(occupied)),))] if len(occupied) else occupied
        return torch.cat([torch.randint(n, (n // 32,)), some])

    def _probe(self, cells: Tensor) -> Tensor:
        with torch.no_grad():
            parts = [self.model.density(self.model.sampler.points_in(c)) for c in cells.split(1 << 16)]
        return -torch.expm1(-torch.cat(parts) * self.lengths[cells])

    def _set(self, keep: Tensor) -> None:
        self.model.looking_where(keep.to(torch.uint8).reshape(self.model.sampler.grid.shape))

    def settle(self, pixels: PixelBank, rays: int = 200_000) -> None:
        """The final grid: every opaque cell that some training ray sees. Leaves the model in training mode."""
        everything = torch.arange(len(self.opacity))
        opaque = self.opacity > _OPACITY / 4
        for _ in range(2):
            for cells in everything[opaque].split(1 << 18):
                self.opacity[cells] = torch.maximum(self.opacity[cells], self._probe(cells))
        keep = self.opacity > _OPACITY
        self._set(keep)
        seen = torch.zeros_like(self.weight)
        chosen = torch.randperm(len(pixels))[:rays]
        with torch.no_grad():
            for part in chosen.split(CHUNK):
                r = pixels.rays(part)
                samples = self.model.sampler(r, jitter=True)
                x, _ = samples.positions(r)
                kernels.scatter_max(weights(self.model.density(x), samples), self.model.sampler.cells(x), seen)
        self._set(keep & (seen > _WEIGHT / 2))
