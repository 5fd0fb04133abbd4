"""Where a NeRFacto field is looked at: a few intervals a ray, narrowed down by small density networks (§10.1).

A ray is measured in s in [0, 1]: distance up to one core radius, disparity beyond, each for half of it. Intervals
that are even in s are put to a first proposal network; what it takes to be visible is cut finer, and so on (mip-NeRF
360, Sec. 3). Letters: N rays, K intervals on each, dense: no ray has fewer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from refield.field.volrend import Samples, weights
from refield.scene.capture import Rays

Density = Callable[[Tensor], Tensor]
"""World points (S, 3) -> sigma (S,), per world unit"""
Inside = Callable[[Tensor], Tensor]
"""World points (S, 3) -> whether they are inside of something, (S,) bool"""


def spacing(u: Tensor) -> Tensor:
    """Distance in core radii, u >= 0, any shape -> [0, 1): u / 2 up to 1, from there 1 - 1 / (2 u)."""
    return torch.where(u < 1, u / 2, 1 - 1 / (2 * u.clamp_min(1.0)))


def unspacing(g: Tensor) -> Tensor:
    """Inverse of :func:`spacing`."""
    return torch.where(g < 0.5, 2 * g, 1 / (2 - 2 * g.clamp_min(0.5)))


@dataclass(frozen=True)
class Span:
    """The part of every ray that is looked at."""

    near: float
    """core radii"""
    far: float
    """core radii"""
    radius: float
    """of the core cube, world units"""
    even: bool = False
    """s is even in distance, all the way"""

    def distance(self, s: Tensor) -> Tensor:
        """s in [0, 1], any shape -> distance along the unit direction, world units."""
        if self.even:
            return self.radius * (self.near + s * (self.far - self.near))
        near, far = spacing(s.new_tensor([self.near, self.far])).unbind()
        return self.radius * unspacing(near + s * (far - near))

    def samples(self, edges: Tensor) -> Samples:
        """Intervals between the edges (N, K + 1) in s -> N * K packed samples."""
        t = self.distance(edges)
        n, k = edges.shape[0], edges.shape[1] - 1
        offsets = torch.arange(n + 1, device=edges.device) * k
        return Samples(t[:, :-1].reshape(-1), t[:, 1:].reshape(-1), offsets)


@dataclass(frozen=True)
class Histogram:
    """How much of each ray's light comes from each interval."""

    edges: Tensor
    """(N, K + 1) ascending, in s; constants"""
    weights: Tensor
    """(N, K) of Eq. 1"""


@dataclass(frozen=True)
class Plan:
    """How the intervals are narrowed down."""

    span: Span
    counts: tuple[int, ...]
    """intervals a ray: for each proposal network in order, then for the field"""
    anneal: float = 1.0
    """proposals' weights are raised to this power before they are drawn from; 0 draws evenly"""
    padding: float = 0.01
    """added to every weight, so that no place is ruled out for good"""


def propose(
    rays: Rays,
    densities: Sequence[Density],
    plan: Plan,
    jitter: bool = False,
    draw: torch.Generator | None = None,
) -> tuple[tuple[Histogram, ...], Tensor]:
    """What each proposal network says of N rays, and the edges (N, K + 1) in s at which the field is to be asked.

    Gradients reach the densities through the histograms' weights, never the edges. Jitter is drawn of ``draw``, by
    default of torch's own generator.
    """
    told: list[Histogram] = []
    edges = even_edges(len(rays), plan.counts[0], jitter, rays.origins.device, draw)
    for density, following in zip(densities, plan.counts[1:], strict=True):
        samples = plan.span.samples(edges)
        x, _ = samples.positions(rays)
        w = weights(density(x), samples).reshape(len(rays), edges.shape[1] - 1)
        told.append(Histogram(edges, w))
        edges = resampled(told[-1], following, jitter, plan.anneal, plan.padding, draw)
    return tuple(told), edges


def even_edges(
    rays: int, count: int, jitter: bool, device: torch.device | None = None, draw: torch.Generator | None = None
) -> Tensor:
    """Edges (N, count + 1) of equal intervals of [0, 1]; jittered, each ray's lie up to half an interval off."""
    edges = torch.linspace(0, 1, count + 1, device=device)
    if not jitter:
        return edges.expand(rays, -1).contiguous()
    middle = (edges[1:] + edges[:-1]) / 2
    lower = torch.cat([edges[:1], middle])[:-1]
    return _closed(lower + (middle - lower) * torch.rand(rays, 1, device=device, generator=draw))


def resampled(
    told: Histogram,
    count: int,
    jitter: bool,
    anneal: float = 1.0,
    padding: float = 0.01,
    draw: torch.Generator | None = None,
) -> Tensor:
    """Edges (N, count + 1) in s, ascending, at equal steps of the histogram's cumulated weight; without gradient.

    One shift a ray jitters them all, so that no two come to lie closer than the histogram says.
    """
    w = told.weights.detach().clamp_min(0) ** anneal + padding
    summed = w.cumsum(-1)
    cdf = torch.cat([torch.zeros_like(w[:, :1]), summed / summed[:, -1:]], -1)
    shift = torch.rand(len(w), 1, device=w.device, generator=draw) if jitter else w.new_full((len(w), 1), 0.5)
    u = (torch.arange(count, device=w.device) + shift) / count
    after = torch.searchsorted(cdf, u, right=True).clamp(1, w.shape[1])
    c0, c1 = cdf.gather(1, after - 1), cdf.gather(1, after)
    e0, e1 = told.edges.gather(1, after - 1), told.edges.gather(1, after)
    share = ((u - c0) / (c1 - c0).clamp_min(1e-12)).clamp(0, 1)
    return _closed(torch.minimum(e0 + share * (e1 - e0), e1))  # rounding must not carry an edge past the next


def _closed(edges: Tensor) -> Tensor:
    """One more edge, at the far end of every ray: (N, K) -> (N, K + 1).

    The last interval is then hundreds of core radii long and opaque from the start: the background, if there is no
    other. Where rays end earlier the field learns to be opaque right before each camera (13 to 20 dB on the scene of
    the tests, against 31); on photos of a room the two are the same.
    """
    return torch.cat([edges, torch.ones_like(edges[:, :1])], -1)


def emptied(density: Density, inside: Inside) -> Density:
    """The same density, but for where there is none."""

    def left(x: Tensor) -> Tensor:
        sigma = density(x)
        return torch.where(inside(x), torch.zeros_like(sigma), sigma)

    return left


def annealing(step: int, slope: float, steps: int) -> float:
    """mip-NeRF 360, Eq. 18: the exponent of the proposals' weights, from 0 at the first step to 1 after ``steps``."""
    x = min(max(step / steps, 0.0), 1.0) if steps > 0 else 1.0
    return slope * x / ((slope - 1) * x + 1)
