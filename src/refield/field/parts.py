"""Which parts of the occupied cells hold anything, found while a field is trained: the occupancy grid, four times as
fine, where rays look often enough to know."""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.kernels.masks import ASKED, ASKED_NOW, SHOWN_NOW
from refield.field.radiance import HashField

_SAMPLES = 32  # in training, a cell is probed for so many; each of its 64 parts costs some hundredth of a sample
_ALL = -1  # parts


class Parts:
    """What samples found in each cell's 4^3 parts.

    A part that rays passed through and in which nothing is opaque is left out. What was not asked yet stays: so cells
    that cost the most samples are known first. What the field shows has to find room in the parts that are left, and
    surfaces become thinner by it: a field that was not trained so needs all its parts.
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
        """Ask the unknown parts of some of the cells (S,) in which samples were, the more samples the sooner."""
        unknown = cells[self._known[cells, ASKED] != _ALL]
        if len(unknown) == 0:
            return
        some = unknown[torch.randint(len(unknown), (len(cells) // _SAMPLES + 1,), device=cells.device)].unique()
        asked = ~self._known[some, ASKED]
        self._known[some, SHOWN_NOW] |= self._probed(some, opacity) & asked
        self._known[some, ASKED_NOW] |= asked

    def narrowed(self, grid: Tensor, tried: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The grid (R, R, R) uint8 without cells that are empty in all parts, and the masks (R, R, R) int64 of the
        others. The cells ``tried`` (K,) are shown whole: what was left out may hold something by now."""
        fine = kernels.narrow(self._known, grid)
        if tried is not None:
            fine.view(-1)[tried] = _ALL
        return grid * (fine != 0), fine

    def _probed(self, cells: Tensor, opacity: float) -> Tensor:
        """The masks (K,) of parts that are more opaque than that, going by a random point of each."""
        r, device = self.model.sampler.resolution, cells.device
        side = torch.arange(4, device=device)
        corner = torch.stack([cells // (r * r), cells // r % r, cells % r], -1)[:, None] * 4
        quarter = (corner + torch.cartesian_prod(side, side, side)).reshape(-1, 3)
        unit = (quarter + torch.rand(quarter.shape, device=device)) / (4 * r)
        sigma = self.model.sigma(kernels.hash_density(unit, self.model.density_net))
        found = self.opacity(cells.repeat_interleave(64), sigma) > opacity
        return (found.reshape(-1, 64).long() << torch.arange(64, device=device)).sum(1)
