"""The part of each training ray that training cannot change, composited once.

The old field is frozen, so along a ray everything outside the helper's region keeps its density and colour. Eq. 1 is
associative: a run of samples acts on the ray as one segment with their summed optical depth and composited colour.
A ray becomes a few such segments, with the helper's samples between them: exact, and two orders of magnitude fewer
samples. Letters: N rays, K segments of all rays, ``offsets`` (N + 1,) their prefix sums, S samples of a batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.kernels.reference import offsets_of, order_key, places_in_order
from refield.field.radiance import Field
from refield.field.render import CHUNK, visible_samples
from refield.field.sampling import OccupancySampler
from refield.field.volrend import Samples
from refield.scene.capture import Rays
from refield.update.composite import UpdatedField
from refield.update.ground import Foothold


@dataclass(frozen=True)
class FreezeConfig:
    """What of the old field is shown, beside and beneath what is learnt."""

    unseen: bool = True
    """nothing that no old photo saw, and nothing new where old photos looked through; the paper has all of it shown"""


@dataclass(frozen=True)
class Segments:
    """Packed segments of N rays, near to far on each."""

    t_mid: Tensor
    """(K,) where the segment's light comes from, mean distance along the ray"""
    optical_depth: Tensor
    """(K,) minus the logarithm of its transmittance"""
    rgb: Tensor
    """(K, 3) its own colour, as if it were opaque"""
    offsets: Tensor
    """(N + 1,) int64"""

    def __getitem__(self, chosen: Tensor) -> Segments:
        """The segments of the chosen rays (B,), in their order."""
        counts = self.offsets.diff()[chosen]
        offsets = offsets_of(counts)
        within = torch.arange(int(offsets[-1])) - torch.repeat_interleave(offsets[:-1], counts)
        rows = torch.repeat_interleave(self.offsets[:-1][chosen], counts) + within
        return Segments(self.t_mid[rows], self.optical_depth[rows], self.rgb[rows], offsets)

    def before(self, t: Tensor) -> Segments:
        """Without what lies beyond a distance (N,) on each ray."""
        kept, ids = self.t_mid <= t[self.ray_ids], self.ray_ids
        counts = torch.bincount(ids[kept], minlength=len(t))
        offsets = offsets_of(counts)
        return Segments(self.t_mid[kept], self.optical_depth[kept], self.rgb[kept], offsets)

    @staticmethod
    def joined(parts: Sequence[Segments]) -> Segments:
        """Those of one set of rays after another's."""
        counts = torch.cat([p.offsets.diff() for p in parts])
        return Segments(
            torch.cat([p.t_mid for p in parts]),
            torch.cat([p.optical_depth for p in parts]),
            torch.cat([p.rgb for p in parts]),
            offsets_of(counts),
        )

    @property
    def ray_ids(self) -> Tensor:
        """(K,) int64"""
        return torch.repeat_interleave(torch.arange(len(self.offsets) - 1), self.offsets.diff())


def fixed_along(frozen: UpdatedField, region: OccupancySampler, rays: Rays, ground: Sequence[Foothold]) -> Segments:
    """What is fixed along rays. Nothing beyond the ground that an object stood on: nobody has ever looked through it,
    and where the old field's inside shows as through a mist, a helper needs not become solid."""
    fixed = composite_once(frozen, region, rays)
    met = torch.full((len(rays),), torch.inf)  # where a textured plane hides what is beyond it, and has to stay
    for plane in frozen.region.planes:
        met = torch.where(plane.hit(rays), torch.minimum(met, plane.met(rays) - plane.depth), met)
    for foothold in ground:
        entered = foothold.entered(rays)
        fixed = fixed.before(torch.where(met < entered, torch.inf, entered))
    return fixed


def composite_once(field: Field, region: OccupancySampler, rays: Rays) -> Segments:
    """Everything that ``field`` shows along N rays, cut into segments where ``region`` lets other samples in.

    ``field`` must be empty inside the region, but for what stays fixed there (objects that moved in).
    """
    with torch.no_grad():
        parts = [_composite_chunk(field, region, rays[i : i + CHUNK]) for i in range(0, max(len(rays), 1), CHUNK)]
    return Segments.joined(parts)


def _composite_chunk(field: Field, region: OccupancySampler, rays: Rays) -> Segments:
    samples = visible_samples(field, rays)
    sigmas, rgbs = field(*samples.positions(rays))
    some = sigmas > 0
    mid = (samples.t_starts + samples.t_ends)[some] / 2
    ray = samples.ray_ids[some]
    tau = (sigmas * (samples.t_ends - samples.t_starts))[some]
    # samples with no place for the helper between them share a segment
    gate = region(rays)
    before = torch.searchsorted(order_key(gate.ray_ids, (gate.t_starts + gate.t_ends) / 2), order_key(ray, mid))
    starts = torch.ones(len(ray), dtype=torch.bool)
    starts[1:] = (ray[1:] != ray[:-1]) | (before[1:] != before[:-1])
    first = starts.nonzero()[:, 0]
    bounds = torch.cat([first, first.new_tensor([len(ray)])])
    w = kernels.weights(tau, torch.zeros_like(tau), torch.ones_like(tau), bounds)
    summed = kernels.accumulate(w, torch.cat([rgbs[some], mid[:, None], torch.ones_like(mid)[:, None]], -1), bounds)
    opacity = summed[:, 4].clamp_min(1e-12)
    depth = tau.new_zeros(len(first)).index_add_(0, starts.cumsum(0) - 1, tau)
    counts = torch.bincount(ray[first], minlength=len(rays))
    offsets = offsets_of(counts)
    return Segments(summed[:, 3] / opacity, depth, summed[:, :3] / opacity[:, None], offsets)


@dataclass(frozen=True)
class Woven:
    """Segments and helper samples of one batch in one row, ray by ray, near to far."""

    samples: Samples
    """Segments have unit length, so that their optical depth is their density."""
    optical_depth: Tensor
    """(S + K,)"""
    rgb: Tensor
    """(S + K, 3)"""
    t_mid: Tensor
    """(S + K,)"""

    @property
    def weights(self) -> Tensor:
        """Eq. 1's, (S + K,), differentiable."""
        return kernels.weights(
            self.optical_depth, torch.zeros_like(self.t_mid), torch.ones_like(self.t_mid), self.samples.ray_offsets
        )


def weave(fixed: Segments, samples: Samples, sigmas: Tensor, rgbs: Tensor) -> Woven:
    """Put the helper's samples (S,) of the same rays between the fixed segments (Eq. 4)."""
    mid = (samples.t_starts + samples.t_ends) / 2
    own, other = places_in_order(samples.ray_ids, mid, fixed.ray_ids, fixed.t_mid)
    n = len(own) + len(other)
    tau = sigmas * (samples.t_ends - samples.t_starts)
    t_mid = mid.new_zeros(n).index_copy(0, own, mid).index_copy(0, other, fixed.t_mid)
    lengths = mid.new_zeros(n).index_copy(0, own, samples.t_ends - samples.t_starts)
    offsets = fixed.offsets + samples.ray_offsets
    return Woven(
        Samples(t_mid - lengths / 2, t_mid + lengths / 2, offsets),
        mid.new_zeros(n).index_copy(0, own, tau).index_copy(0, other, fixed.optical_depth),
        mid.new_zeros(n, 3).index_copy(0, own, rgbs).index_copy(0, other, fixed.rgb),
        t_mid,
    )
