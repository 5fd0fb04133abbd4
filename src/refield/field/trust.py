"""How far each part of each photo is to be believed: what passed through single photos is no part of the scene.

A photo is remembered patch by patch, the scene cell by cell of the occupancy grid: how large the errors are in the
patch, and how large those of all photos are that end in the cells that the patch shows. A person who walked through one
photo makes its patch worse than the wall behind is in all others; fine texture, a bad pose of the whole scene or a
mirror makes both worse alike. So the bound is the photos' own: patches further above the middle of all, in the
logarithm of that ratio, than `_OUTLYING` of its robust deviations, count for the less the further they are.

Letters: F photos, K patches, N rays.
"""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field.pixels import PixelBank

_SIDE = 24  # patches along a photo's longer side
_OUTLYING = 3.0  # robust standard deviations
_SEEN = 8.0  # rays in a patch or a cell from which its mean error says something
_FADE = 0.99  # of what is known is kept each time when the bound is renewed
_EVERY = 32  # steps between such times


class PhotoTrust:
    """Running means of squared errors, and what follows from them for the next step's rays."""

    def __init__(self, bank: PixelBank, cells: int) -> None:
        sizes = torch.tensor([(f.camera.width, f.camera.height) for f in bank.frames])
        patch = sizes.amax(-1).div(_SIDE, rounding_mode="floor").clamp_min(1)
        across = -(-sizes // patch[:, None])
        counts = across[:, 0] * across[:, 1]
        self._width, self._patch, self._across = sizes[:, 0], patch, across[:, 0]
        self._begins = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        self._bank = bank
        self._patches = torch.zeros(int(counts.sum()), 3)  # rays, their errors, what their cells let expect
        self._cells = torch.zeros(cells, 2)  # rays, their errors
        self.trust = torch.ones(len(self._patches))
        """(K,)"""
        self._steps = 0

    def patches(self, pixels: Tensor, owner: Tensor) -> Tensor:
        """The patch of each pixel (N,) of photos ``owner`` (N,)."""
        place, width, patch = self._bank.place_of(pixels), self._width[owner], self._patch[owner]
        row, column = (place // width) // patch, (place % width) // patch
        return self._begins[owner] + row * self._across[owner] + column

    def learn(self, patches: Tensor, surface: Tensor, errors: Tensor) -> None:
        """Note the errors (N, 3) of rays in their patches (N,), and in the cells where they end (N,); -1: nowhere."""
        ends = surface >= 0
        patches, surface, error = patches[ends], surface[ends], errors[ends].square().mean(-1)
        known = self._cells[surface]
        expected = known[:, 1] / known[:, 0].clamp_min(1)
        told = (known[:, 0] >= _SEEN).float()
        ones = torch.ones_like(error)
        self._cells.index_add_(0, surface, torch.stack([ones, error], -1))
        self._patches.index_add_(0, patches, torch.stack([ones, error, expected], -1) * told[:, None])
        self._steps += 1
        if self._steps % _EVERY == 0:
            self._renew()

    def _renew(self) -> None:
        rays, error, expected = self._patches.unbind(-1)
        known = rays >= _SEEN
        if int(known.sum()) >= 2:
            ratio = (error.clamp_min(1e-12) / expected.clamp_min(1e-12)).log()
            middle = ratio[known].median()
            deviation = 1.4826 * (ratio[known] - middle).abs().median()
            over = (ratio - middle) / (_OUTLYING * deviation).clamp_min(1e-6)
            self.trust = torch.where(known & (over > 1), over.clamp_min(1) ** -4, torch.ones_like(over))
        self._patches *= _FADE
        self._cells *= _FADE
