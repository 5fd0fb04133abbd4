"""Volume rendering of packed samples (Eq. 1).

Letters: N rays, S samples of all rays in one flat array, ``ray_offsets`` (N + 1,) their prefix sums;
ray i owns samples ``ray_offsets[i] : ray_offsets[i + 1]``, near to far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from refield.field import kernels
from refield.field.kernels.cpu.simd import JIT
from refield.field.kernels.reference import offsets_of, seen, to_be_seen
from refield.scene.capture import Rays
from refield.scene.images import png

_Samples = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]

OPAQUE = 0.9
"""of the light has to end in what is taken for a surface"""


@dataclass(frozen=True)
class Samples:
    """Intervals along rays, packed. Distances are along the unit direction, world units."""

    t_starts: Tensor
    """(S,) float32"""
    t_ends: Tensor
    """(S,) float32"""
    ray_offsets: Tensor
    """(N + 1,) int64"""

    def __len__(self) -> int:
        return self.t_starts.shape[0]

    @property
    def ray_ids(self) -> Tensor:
        """The ray of each sample, (S,) int64."""
        counts = self.ray_offsets[1:] - self.ray_offsets[:-1]
        return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)

    def only(self, which: Tensor) -> Samples:
        """Some of them, of the same rays: rows in order, or (S,) bool."""
        counts = torch.bincount(self.ray_ids[which], minlength=len(self.ray_offsets) - 1)
        return Samples(self.t_starts[which], self.t_ends[which], offsets_of(counts))

    def positions(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """World midpoints (S, 3) and directions (S, 3)."""
        ids = self.ray_ids
        d = rays.directions[ids]
        mid = (self.t_starts + self.t_ends) / 2
        return rays.origins[ids] + d * mid[:, None], d


@dataclass(frozen=True, repr=False)
class Rendering:
    """What a set of rays, or a view, looks like. Leading shape (N,) or (H, W)."""

    rgb: Tensor
    """(..., 3) float32 in [0, 1], on a black background"""
    depth: Tensor
    """(...,) float32 mean distance along the unit direction of what stops the light, but for the last 5 % of it; 0
    where nothing does. A surface's, where nearly all is stopped there."""
    opacity: Tensor
    """(...,) float32 in [0, 1]"""

    def surface(self, opaque: float = OPAQUE) -> Tensor:
        """The depth where more than this part of the light is stopped, (...,); inf where no surface is."""
        return torch.where(self.opacity > opaque, self.depth, torch.inf)

    def reshape(self, *shape: int) -> Rendering:
        return Rendering(self.rgb.reshape(*shape, 3), self.depth.reshape(shape), self.opacity.reshape(shape))

    def __repr__(self) -> str:
        return f"Rendering({' x '.join(map(str, self.depth.shape))})"

    def _repr_png_(self) -> bytes | None:
        """A view, for notebooks; None for rays that make none."""
        return png(self.rgb) if self.rgb.dim() == 3 else None

    @staticmethod
    def joined(parts: Sequence[Rendering]) -> Rendering:
        """Those of one set of rays after the other, one at least."""
        return Rendering(*(torch.cat([getattr(p, k) for p in parts]) for k in ("rgb", "depth", "opacity")))


def depths_around(depth: Tensor) -> tuple[Tensor, Tensor]:
    """A picture's depths (H, W) -> the least and the greatest of each pixel and its neighbours, (H, W) each."""
    rows = depth[None, None]
    return -functional.max_pool2d(-rows, 3, 1, 1)[0, 0], functional.max_pool2d(rows, 3, 1, 1)[0, 0]


def weights(sigmas: Tensor, samples: Samples) -> Tensor:
    """w_i = T_i (1 - exp(-sigma_i delta_i)), T_i = exp(-sum_{j<i} sigma_j delta_j); (S,), differentiable (Eq. 1)."""
    return kernels.weights(sigmas, samples.t_starts, samples.t_ends, samples.ray_offsets)


def accumulate_rgb(w: Tensor, rgbs: Tensor, samples: Samples) -> tuple[Tensor, Tensor]:
    """Weights (S,), colours (S, 3) -> colour (N, 3) on black, opacity (N,)."""
    summed = kernels.accumulate(w, torch.cat([rgbs, torch.ones_like(w)[:, None]], -1), samples.ray_offsets)
    return summed[:, :3], summed[:, 3]


def composite(sigmas: Tensor, rgbs: Tensor, samples: Samples) -> Rendering:
    """Eq. 1: sigmas (S,), rgbs (S, 3) -> Rendering of N rays, differentiable."""
    w = weights(sigmas, samples)
    values = to_be_seen(w, sigmas, rgbs, samples.t_starts, samples.t_ends)
    return Rendering(*seen(kernels.accumulate(w, values, samples.ray_offsets)))


def interleaved(a: Samples, b: Samples) -> Samples:
    """Two sets of samples of the same rays as one, near to far on each ray."""
    offsets = a.ray_offsets + b.ray_offsets
    if offsets.device.type != "cpu":
        starts, ray = torch.cat([a.t_starts, b.t_starts]), torch.cat([a.ray_ids, b.ray_ids])
        order = torch.argsort(ray.double() + starts.double() / (1 + starts.double()))
        return Samples(starts[order], torch.cat([a.t_ends, b.t_ends])[order], offsets)
    both = Samples(torch.empty(int(offsets[-1])), torch.empty(int(offsets[-1])), offsets)
    parts = [tuple(t.numpy() for t in (s.t_starts, s.t_ends, s.ray_offsets)) for s in (a, b, both)]
    _interleave(*parts)
    return both


@njit(parallel=True, **JIT)
def _interleave(a: _Samples, b: _Samples, both: _Samples) -> None:
    """Starts, ends and offsets of each; ``both`` has its offsets."""
    for r in prange(len(both[2]) - 1):
        i, j = a[2][r], b[2][r]
        for k in range(both[2][r], both[2][r + 1]):
            if j >= b[2][r + 1] or (i < a[2][r + 1] and a[0][i] <= b[0][j]):
                both[0][k], both[1][k] = a[0][i], a[1][i]
                i += 1
            else:
                both[0][k], both[1][k] = b[0][j], b[1][j]
                j += 1
