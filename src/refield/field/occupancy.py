"""Keeping the occupancy grid of a field in training: which cells may hold something, and which are ever seen."""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.encoding import large_zeros
from refield.field.parts import Parts
from refield.field.pixels import Pixels
from refield.field.radiance import HashField
from refield.field.render import CHUNK
from refield.field.volrend import weights

EVERY, _OFTEN_UNTIL = 16, 512  # steps between renewals of the grid; later every second one is left out
_OPACITY = 5e-2  # a cell is kept if a sample in it would be more opaque than this
_WEIGHT = 5e-3  # and if some ray gives it at least this much of its colour: hidden cells cost half of all samples
DECAY = 0.8
_LAST, _EACH = 200_000, 4  # rays that say at the end what is seen, at most, and for each pixel
_PROBED_AT_FIRST, _PROBED = 16, 64  # one in so many cells, each time
# Core radii; from the core to here cameras stand (see `place_contraction`). What is there must show itself: with the
# benefit of the doubt a photo's background is learnt as haze before the cameras opposite, and new views meet it
_CAMERAS = 2.0
# A sample's opacity; once surfaces have become sharp, what is thinner than this where cameras stand is haze: for the
# cameras opposite it is a part of their background, for a new camera it lies before everything. So is a part of a cell
# anywhere that is thinner than this from side to side: surfaces find room in what is left
_HAZE = 0.3
_BACKGROUND = 5.0  # core radii; a cell that no ray ever crossed is taken for empty, unless it is further out


class OccupancyTrainer:
    """Two running maxima a cell: the opacity of a sample in it, and the weight that rays gave it.

    Both follow the training samples themselves; cells that are not sampled are probed at random, so that what was
    taken for empty can come back.
    """

    def __init__(
        self,
        model: HashField,
        cull_from: int = 128,
        allowed: Tensor | None = None,
        doubt: float = 2 * _OPACITY,
        outside: bool = True,
        beside: Tensor | None = None,
        draw: torch.Generator | None = None,
    ) -> None:
        """``allowed`` (R**3,) bool: cells that may hold something at all; all by default. ``doubt``: the opacity that
        cells begin with, except where cameras stand. ``outside``: whether they stand around the core. ``beside``
        (R**3,) bool: cells right beside one of them. ``draw``: what is drawn at random is drawn of it; by default of
        torch's own."""
        self.model, self.cull_from, self.draw = model, cull_from, draw
        device = model.sampler.grid.device
        cells = model.sampler.resolution**3
        self.allowed = torch.ones(cells, dtype=torch.bool, device=device) if allowed is None else allowed
        self.rounds = 1  # renewals of the grid, from 1
        self.open = self.allowed.nonzero()[:, 0]
        self.sharp = False
        self.parts: Parts | None = None
        """of cells; from the first step on that says in which its samples were"""
        self.among_cameras = torch.zeros(cells, dtype=torch.bool, device=device)
        self.state = large_zeros(cells, 4).to(device)
        """see `kernels.reference.observe`"""
        self.state[:, 1] = 16 * _WEIGHT  # the benefit of the doubt
        for some in torch.arange(cells, device=device).split(1 << 20):
            self.state[some, 2] = model.sampler.step_at(some)
            distance = model.sampler.distance(some)
            self.among_cameras[some] = (distance > 1) & (distance < _CAMERAS) & outside
            if beside is not None:
                self.among_cameras[some] |= beside[some]
            self.state[some, 0] = torch.where(self.among_cameras[some], 0.0, doubt)
            self.state[some, 3] = torch.where(distance > _BACKGROUND, 0.0, -1.0)

    @property
    def weight(self) -> Tensor:
        """(R**3,) the most that some ray gave each cell of late."""
        return self.state[:, 1]

    def observe(self, step: int, cells: Tensor, w: Tensor, sigmas: Tensor, parts: Tensor | None = None) -> None:
        """After each step: samples' cells (S,), weights (S,), densities (S,), and in which part of its cell each was.
        Renews the grid every 16 or 32 steps."""
        kernels.observe(self.state, self.rounds, DECAY, cells, w, sigmas)
        if parts is not None and self.sharp:
            self.parts = self.parts or Parts(self.model)
            self._ask(self.parts, (cells, parts), w, sigmas)
        every = EVERY if step < _OFTEN_UNTIL else 2 * EVERY
        if step % every == every - 1:
            self.renew(step)

    def renew(self, step: int) -> None:
        """Look into some cells at random, and choose anew which are shown."""
        if len(self.open) == 0:
            return
        part = _PROBED_AT_FIRST if step < 4 * EVERY else _PROBED
        cells = self._some_open(len(self.open) // part + 1)
        self.state[cells, 0] = self.state[cells, 0] * DECAY  # cells may be drawn twice
        kernels.scatter_max(self._probe(cells), cells, self.state[:, 0])
        if step >= self.cull_from:
            # a few hidden cells get another chance, since geometry still changes
            again = self._some_open(len(self.open) // 100)
            self.state[again, 1] = self.state[again, 1].clamp_min(4 * _WEIGHT)
        self.sharp = step >= 4 * self.cull_from
        grid = self._kept(_WEIGHT if step >= self.cull_from else -1.0, self.sharp)
        self._show(grid, cells)
        self.rounds += 1

    def _some_open(self, count: int) -> Tensor:
        """So many of the open cells, drawn at random; one may be drawn twice."""
        return self.open[torch.randint(len(self.open), (count,), device=self.open.device, generator=self.draw)]

    def _probe(self, cells: Tensor) -> Tensor:
        """Opacity of a sample at a random point of each cell, (K,) -> (K,)."""
        r, model = self.model.sampler.resolution, self.model
        corner = torch.stack([cells // (r * r), cells // r % r, cells % r], -1)
        with torch.no_grad():
            unit = (corner + torch.rand(len(cells), 3, device=cells.device, generator=self.draw)) / r
            sigma = model.sigma(kernels.hash_density(unit, model.density_net))
        return -torch.expm1(-sigma * self.state[cells, 2])

    def _ask(self, known: Parts, places: tuple[Tensor, Tensor], w: Tensor, sigmas: Tensor) -> None:
        """Note which parts samples of weights (S,) and densities (S,) are a reason to look into; and probe some."""
        known.observe(*places, (known.opacity(places[0], sigmas) > _HAZE) & (w > _WEIGHT / 2))
        known.probe(places[0], _HAZE)

    def _show(self, grid: Tensor, tried: Tensor | None = None) -> None:
        """Look into the cells (R, R, R) uint8, as far as their parts are not known to be empty."""
        self.model.looking_where(*((grid,) if self.parts is None else self.parts.narrowed(grid, tried)))

    def _kept(self, weight: float, only_seen: bool) -> Tensor:
        """The cells that are opaque enough and have a weight above ``weight``, (R, R, R) uint8."""
        opacity = min(_OPACITY, float(self.state[:, 0].mean()))
        allowed = self.allowed
        if self.sharp:
            allowed = allowed & ~(self.among_cameras & (self.state[:, 0] < _HAZE))
        grid = kernels.keep(self.state, allowed, opacity, weight, only_seen)
        return grid.reshape(self.model.sampler.grid.shape)

    def settle(self, pixels: Pixels) -> None:
        """The final grid: every opaque cell that some training ray sees, without the parts that are known to be empty.

        Leaves the model in training mode.

        Where no ray ever went the density is whatever the networks make of it: haze before a new camera.
        """
        opaque = (self.state[:, 0] > _OPACITY / 4).nonzero()[:, 0]
        for _ in range(2):
            for cells in opaque.split(1 << 18):
                self.state[cells, 0] = torch.maximum(self.state[cells, 0], self._probe(cells))
        self._show(self._kept(-1.0, False))
        self.state[:, 1] = torch.where(self.state[:, 3] >= 0, self.state[:, 1], 0)
        for chosen in torch.randint(len(pixels), (min(_LAST, _EACH * len(pixels)),)).split(CHUNK):
            r = pixels.rays(chosen)
            with torch.no_grad():
                samples = self.model.samples(r, jitter=True)
                x, _ = samples.positions(r)
                sigmas = self.model.density(x)
                w = weights(sigmas, samples)
            cells, parts = self.model.sampler.places(x)
            kernels.scatter_max(w, cells, self.state[:, 1])
            if self.parts is not None:
                self._ask(self.parts, (cells, parts), w, sigmas)
        self._show(self._kept(_WEIGHT / 2, False))
