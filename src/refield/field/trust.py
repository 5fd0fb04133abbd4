"""How far each part of each photo is to be believed: what passed through single photos is no part of the scene.

A photo is remembered patch by patch, the scene place by place, cells of a coarse grid: how large the errors are in the
patch, and how large those of all photos are that end in the cells that the patch shows. A person who walked through one
photo makes its patch worse than the wall behind is in all others; fine texture, a bad pose of the whole scene or a
mirror makes both worse alike. So the bound is the photos' own: patches further above the middle of all, in the
logarithm of that ratio, than `_OUTLYING` of its robust deviations, count for the less the further they are.

Letters: F photos, K patches, N rays.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from refield.field.pixels import Pixels

_SIDE = 24  # patches along a photo's longer side
_OUTLYING = 3.0  # robust standard deviations
_SEEN = 8.0  # rays in and around a patch, or at a place, from which their mean error says something
_FADE = 0.99  # of what is known is kept each time when the bound is renewed
_EVERY = 32  # steps between such times
_AROUND = ((0.25, 0.5, 0.25), (0.5, 1.0, 0.5), (0.25, 0.5, 0.25))  # what a patch's neighbours say counts for it


class PhotoTrust:
    """Running means of squared errors, and what follows from them for the next step's rays."""

    def __init__(self, bank: Pixels, places: int) -> None:
        """``places``: where rays may end."""
        sizes = torch.tensor([(f.camera.width, f.camera.height) for f in bank.frames])
        patch = sizes.amax(-1).div(_SIDE, rounding_mode="floor").clamp_min(1)
        across, down = (-(-sizes // patch[:, None])).amax(0).tolist()
        self._width, self._patch = sizes[:, 0], patch
        self._bank = bank
        self._patches = torch.zeros(len(sizes), down, across, 3)  # rays, their errors, what their places let expect
        self._places = torch.zeros(places, 2)  # rays, their errors
        self.trust = torch.ones(len(sizes) * down * across)
        """(K,)"""
        self._steps = 0

    def patches(self, pixels: Tensor, owner: Tensor) -> Tensor:
        """The patch of each pixel (N,) of photos ``owner`` (N,)."""
        place, width, patch = self._bank.place_of(pixels), self._width[owner], self._patch[owner]
        row, column = (place // width) // patch, (place % width) // patch
        _, down, across, _ = self._patches.shape
        return (owner * down + row) * across + column

    def learn(self, patches: Tensor, place: Tensor, errors: Tensor) -> None:
        """Note the errors (N, 3) of rays in their patches (N,), and at the places where they end (N,); -1: nowhere."""
        ends = (place >= 0).float()
        place, error = place.clamp_min(0), errors.square().mean(-1)
        known = self._places[place]
        expected = known[:, 1] / known[:, 0].clamp_min(1)
        told = ends * (known[:, 0] >= _SEEN)
        ones = torch.ones_like(error)
        self._places.index_add_(0, place, torch.stack([ones, error], -1) * ends[:, None])
        noted = torch.stack([ones, error, expected], -1) * told[:, None]
        self._patches.view(-1, 3).index_add_(0, patches, noted)
        self._steps += 1
        if self._steps % _EVERY == 0:
            self._renew()

    def _renew(self) -> None:
        kernel = torch.tensor(_AROUND)[None, None]
        sums = self._patches.permute(0, 3, 1, 2).flatten(0, 1)[:, None]
        rays, error, expected = conv2d(sums, kernel, padding=1).view(len(self._patches), 3, -1).unbind(1)
        known = (rays >= _SEEN).reshape(-1)
        if int(known.sum()) >= 2:
            ratio = (error.clamp_min(1e-12) / expected.clamp_min(1e-12)).log().reshape(-1)
            middle = ratio[known].median()
            deviation = 1.4826 * (ratio[known] - middle).abs().median()
            over = (ratio - middle) / (_OUTLYING * deviation).clamp_min(1e-6)
            self.trust.copy_(torch.where(known & (over > 1), over.clamp_min(1) ** -4, 1.0))
        self._patches *= _FADE
        self._places *= _FADE
