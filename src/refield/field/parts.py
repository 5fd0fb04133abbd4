"""Which parts of the occupied cells hold anything, found while a field is trained: the occupancy grid, four times as
fine, where rays look often enough to know."""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.kernels.masks import ASKED, ASKED_NOW, SHOWN_NOW
from refield.field.radiance import HashField

_PROBES = 2  # points in each part; beside a part that is opaque at one of them all are kept
_CELLS = 4096  # that are probed at once
_SAMPLES = 32  # in training, a cell is probed for so many; each of its 64 parts costs some hundredth of a sample
_ALL = -1  # parts
_WORTH = 8  # samples in a cell, of all that fall along the training rays in the end: it is worth to be probed


class Parts:
    """What samples found in each cell's 4^3 parts.

    A part that rays passed through and that is empty, as all beside it are, is left out. What was not asked yet stays:
    so cells that cost the most samples are known first.
    """

    def __init__(self, model: HashField) -> None:
        """Nothing is known yet. The sampler's step is the longest that will be taken."""
        self.model = model
        sampler = model.sampler
        cells, device = sampler.grid.numel(), sampler.grid.device
        self._known = torch.zeros(cells, 5, dtype=torch.int64, device=device)
        self._across = torch.empty(cells, device=device)  # of a part, or of a sample where that is longer; world units
        for some in torch.arange(cells, device=device).split(1 << 20):
            width = sampler.width(sampler.distance(some)) / 4
            self._across[some] = torch.maximum(width, sampler.step_at(some))

    def opacity(self, cells: Tensor, sigmas: Tensor) -> Tensor:
        """Across parts of cells (S,) whose densities are (S,)."""
        return -torch.expm1(-sigmas * self._across[cells])

    def observe(self, cells: Tensor, parts: Tensor, opaque: Tensor) -> None:
        """What samples in parts (S,) of cells (S,), int64, turned out to be, (S,) bool."""
        kernels.note(self._known, cells, parts, opaque)

    def probe(self, cells: Tensor, opacity: float) -> None:
        """Ask all parts of some of the cells (S,) in which samples were: the more samples, the sooner."""
        unknown = cells[self._known[cells, ASKED] != _ALL]
        if len(unknown) == 0:
            return
        some = unknown[torch.randint(len(unknown), (len(cells) // _SAMPLES + 1,), device=cells.device)].unique()
        self._known[some, SHOWN_NOW] |= self._probed(some, opacity, 1)
        self._known[some, ASKED_NOW] = _ALL

    def forget(self, cells: Tensor) -> None:
        """Take it that no part of cells (K,) was ever asked."""
        self._known[cells, ASKED] = 0

    def forget_all(self) -> None:
        self._known.zero_()

    def narrowed(self, grid: Tensor) -> tuple[Tensor, Tensor]:
        """The grid (R, R, R) uint8 without cells that are empty in all parts, and the masks (R, R, R) int64 of the
        others."""
        fine = kernels.narrow(self._known, grid)
        return grid * (fine != 0), fine

    def settled(self, grid: Tensor, opacity: float, samples: Tensor) -> tuple[Tensor, Tensor]:
        """As :func:`narrowed`, from what was opaque since all was forgotten, or is more so than ``opacity`` now.

        ``samples`` (R**3,) says how many fell into each cell. Those with few are left whole.
        """
        shown = grid.reshape(-1) > 0
        full = torch.where(shown, self._known[:, SHOWN_NOW] | _ALL * (samples < _WORTH), 0)
        for cells in (shown & (samples >= _WORTH)).nonzero()[:, 0].split(_CELLS):
            full[cells] |= self._probed(cells, opacity, _PROBES)
        fine = torch.where(grid > 0, kernels.spread(full.reshape(grid.shape)), 0)
        return grid * (fine != 0), fine

    def _probed(self, cells: Tensor, opacity: float, times: int) -> Tensor:
        """The masks (K,) of parts in which the field is more opaque than that at one of some random
        points."""
        r, device = self.model.sampler.resolution, cells.device
        side = torch.arange(4, device=device)
        corner = torch.stack([cells // (r * r), cells // r % r, cells % r], -1)[:, None] * 4
        quarter = (corner + torch.cartesian_prod(side, side, side)).reshape(-1, 3)
        found = torch.zeros(len(quarter), dtype=torch.bool, device=device)
        owner = cells.repeat_interleave(64)
        for _ in range(times):
            unit = (quarter + torch.rand(quarter.shape, device=device)) / (4 * r)
            sigma = self.model.sigma(kernels.hash_density(unit, self.model.density_net))
            found |= self.opacity(owner, sigma) > opacity
        return (found.reshape(-1, 64).long() << torch.arange(64, device=device)).sum(1)
