"""The hot loops in plain torch: the truth that the fast twins are tested against, and the path of any other device.

Letters: S samples packed by ray, N rays, ``offsets`` (N + 1,); L levels, F features a level, C channels.
Every function here is differentiable by autograd where its twin is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from refield.field.kernels.masks import marked, part_of
from refield.field.kernels.masks import narrow as narrow
from refield.field.kernels.masks import note as note
from refield.scene.inside import trilinear

Rays3 = tuple[Tensor, Tensor, Tensor]
"""origins (N, 3), unit directions (N, 3), jitter (N,) in [0, 1) that shifts each ray's lattice"""
Space = tuple[Tensor, float]
"""centre (3,) and radius of the contraction"""
Lattice = tuple[float, float, float]
"""near, far, step in world units"""
DensityNet = tuple[Tensor, tuple[int, ...], Tensor, Tensor]
"""hash tables (L, T, F), their resolutions, hidden weights (H, L * F), output weights (H,)"""

Networks = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""density in (H, L * F), density out (1 + K, H), colour in (H, K + 16), colour mid (H, H), colour out (3, H)"""


class Batch(NamedTuple):
    """What a training step looks at."""

    rays: Rays3
    colours: Tensor
    """(N, 3) of the photos"""
    background: Tensor
    """(N, 3) shown where a ray stays transparent"""
    gains: Tensor | None = None
    """(N, 3) by which the photos multiply what is shown; 1 by default"""
    trust: Tensor | None = None
    """(N,) how much each ray's colours count; 1 by default"""
    moving: int = 0
    """so many rays, the first, tell how the loss changes with where they are"""


class Aim(NamedTuple):
    """What a training step wants."""

    distortion: float
    """weight of the distortion loss"""
    gradient_unit: float
    """gradients of samples nearer than this, world units, are scaled down by the square of their distance (§10.1)"""
    stop: float
    """optical depth at which a ray ends"""
    nearness: float | Tensor = 0.0
    """weight, times that of the distortion, of how near to the camera light ends; a tensor () where a graph reads it"""


class Stepped(NamedTuple):
    """What a training step found."""

    loss: float
    cells: Tensor
    """(S,) int64, flat index of the grid cell of each sample"""
    weights: Tensor
    """(S,)"""
    sigmas: Tensor
    """(S,) per world unit"""
    rays: int
    parts: Tensor | None = None
    """(S,) int64, which of its cell's 64 sub-cells each sample lies in, see `marked`; where it was asked"""
    shown: Tensor | None = None
    """(N, 3) what `train_step` composited, before gains, without the background"""
    errors: Tensor | None = None
    """(N, 3) what is seen less what the photos show; 0 where a photo is burnt out and what is seen is brighter"""
    heaviest: Tensor | None = None
    """(N,) int64, the sample of each ray that shows most; -1 where a ray has none"""
    to_rays: tuple[Tensor, Tensor] | None = None
    """d loss / d origin and / d direction, (moving, 3) each; the directions' part through the colours is left out"""


class Fixed(NamedTuple):
    """What lies along rays and cannot change: segments, near to far, of M rays."""

    t_mid: Tensor
    """(K,) where each segment's light comes from"""
    optical_depth: Tensor
    """(K,)"""
    rgb: Tensor
    """(K, 3) as if it were opaque"""
    offsets: Tensor
    """(M + 1,) int64"""
    chosen: Tensor
    """(N,) int64: which of the M each ray of a batch is"""


class Unwanted(NamedTuple):
    """Where a helper is not to show anything."""

    misplaced: Tensor
    """(R**3,) what a unit of weight in each cell adds to the loss"""
    taken: Callable[[Tensor], Tensor] | None
    """World points (S, 3) -> (S,) bool: where it is not asked. It must not march rays"""


BURNT = 254.5 / 255
"""a photo's colour above which it may have been brighter still"""
TRACE = 0.05
"""light that reaches a background which goes on for ever, and would move the mean distance there"""
PRIMES = (1, 2654435761, 805459861)  # the spatial hash of Teschner et al. 2003, as in Instant-NGP, Eq. 4


def contract(x: Tensor, centre: Tensor, radius: float) -> Tensor:
    """World (..., 3) -> (-2, 2)^3: affine inside the cube of half-size ``radius``, shrinking as 1/m outside (L-inf)."""
    u = (x - centre) / radius
    m = u.abs().amax(-1, keepdim=True)
    far = m.clamp_min(1.0)
    return torch.where(m > 1, u * ((2 - 1 / far) / far), u)


def uncontract(y: Tensor, centre: Tensor, radius: float) -> Tensor:
    """Inverse of :func:`contract` on the open cube (-2, 2)^3."""
    m = y.abs().amax(-1, keepdim=True)
    far = (2 - m).clamp_min(1e-6)
    u = torch.where(m > 1, y / m.clamp_min(1e-9) / far, y)
    return u * radius + centre


def level_index(corner: Tensor, resolution: int, size: int) -> Tensor:
    """Row of a lattice corner (..., 3) int64 in a level's table: dense if the lattice fits, hashed if not."""
    x, y, z = corner.unbind(-1)
    side = resolution + 1
    if side**3 <= size:
        return (x * side + y) * side + z
    return (x ^ ((y * PRIMES[1]) & 0xFFFFFFFF) ^ ((z * PRIMES[2]) & 0xFFFFFFFF)) & (size - 1)


def hash_encode(unit: Tensor, tables: Tensor, resolutions: tuple[int, ...]) -> Tensor:
    """Multi-resolution hash encoding: unit (S, 3) in [0, 1], tables (L, T, F) -> (S, L * F), trilinear."""
    out = []
    offsets = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], device=unit.device)
    for level, resolution in enumerate(resolutions):
        p = unit * resolution
        base = p.detach().floor().clamp(0, resolution - 1)
        f = (p - base)[:, None, :]
        w = torch.where(offsets.bool(), f, 1 - f).prod(-1)
        rows = level_index(base.long()[:, None, :] + offsets, resolution, tables.shape[1])
        out.append((tables[level][rows] * w[..., None]).sum(1))
    return torch.cat(out, -1)


def spherical_harmonics(d: Tensor) -> Tensor:
    """Real spherical harmonics up to degree 3 of unit directions (..., 3) -> (..., 16)."""
    x, y, z = d.unbind(-1)
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * xy,
            -1.0925484305920792 * yz,
            0.9461746957575601 * zz - 0.31539156525251999,
            -1.0925484305920792 * xz,
            0.5462742152960396 * (xx - yy),
            0.5900435899266435 * y * (-3 * xx + yy),
            2.890611442640554 * xy * z,
            0.4570457994644657 * y * (1 - 5 * zz),
            0.3731763325901154 * z * (5 * zz - 3),
            0.4570457994644657 * x * (1 - 5 * zz),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (-xx + 3 * yy),
        ],
        -1,
    )


def hash_field(
    unit: Tensor, d: Tensor, tables: Tensor, resolutions: tuple[int, ...], networks: Networks
) -> tuple[Tensor, Tensor]:
    """Encoding and both networks: unit (S, 3) in [0, 1], directions (S, 3) -> raw density (S,), rgb (S, 3)."""
    return through_networks(hash_encode(unit, tables, resolutions), spherical_harmonics(d), networks)


def through_networks(features: Tensor, harmonics: Tensor, networks: Networks) -> tuple[Tensor, Tensor]:
    """Features (S, L * F) and harmonics (S, 16) -> raw density (S,), rgb (S, 3) in [0, 1]."""
    density_in, density_out, colour_in, colour_mid, colour_out = networks
    out = (features @ density_in.T).relu() @ density_out.T
    entering = torch.cat([out[:, 1:], harmonics], -1)
    hidden = (entering @ colour_in.T).relu()
    hidden = (hidden @ colour_mid.T).relu()
    return out[:, 0], torch.sigmoid(hidden @ colour_out.T)


def hash_density(unit: Tensor, net: DensityNet) -> Tensor:
    """The raw density alone, without gradients: unit (S, 3) in [0, 1] -> (S,)."""
    tables, resolutions, w_in, w_out = net
    with torch.no_grad():
        return (hash_encode(unit, tables, resolutions) @ w_in.T).relu() @ w_out


def offsets_of(counts: Tensor) -> Tensor:
    """How many samples each of N rays has, (N,) int64 -> where each ray's begin and the last one's end, (N + 1,)."""
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)])


def _ray_ids(offsets: Tensor) -> Tensor:
    counts = offsets[1:] - offsets[:-1]
    return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)


def _exclusive_sum(values: Tensor, offsets: Tensor) -> Tensor:
    """Sum of the values before each sample on its own ray, (S,) -> (S,), in float64 (one long cumsum loses digits)."""
    before = torch.cat([values.new_zeros(1, dtype=torch.float64), values.double().cumsum(0)])
    return (before[:-1] - before[offsets[:-1]][_ray_ids(offsets)]).to(values.dtype)


def weights(sigmas: Tensor, t_starts: Tensor, t_ends: Tensor, offsets: Tensor) -> Tensor:
    """Eq. 1's weights, (S,)."""
    tau = sigmas * (t_ends - t_starts)
    return torch.exp(-_exclusive_sum(tau, offsets)) * -torch.expm1(-tau)


def accumulate(w: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    """Sum of w (S,) times values (S, C) over each ray -> (N, C)."""
    out = values.new_zeros(len(offsets) - 1, values.shape[1])
    return out.index_add(0, _ray_ids(offsets), w[:, None] * values)


def distortion(w: Tensor, s_starts: Tensor, s_ends: Tensor, offsets: Tensor) -> Tensor:
    """mip-NeRF 360's distortion of each ray, (N,): sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (s_end - s_start)."""
    mid = (s_starts + s_ends) / 2
    w_before = _exclusive_sum(w, offsets)
    wm_before = _exclusive_sum(w * mid, offsets)
    each = 2 * w * (mid * w_before - wm_before) + w * w * (s_ends - s_starts) / 3
    return each.new_zeros(len(offsets) - 1).index_add(0, _ray_ids(offsets), each)


def nearness(w: Tensor, s_starts: Tensor, s_ends: Tensor, offsets: Tensor) -> Tensor:
    """How near the light of each ray ends, (N,): sum_i w_i (1 - m_i)."""
    return accumulate(w, (1 - (s_starts + s_ends) / 2)[:, None], offsets)[:, 0]


def spread(w: Tensor, s_starts: Tensor, s_ends: Tensor, offsets: Tensor, aim: Aim) -> Tensor:
    """What a step pays for where the light of each ray ends, (N,)."""
    ends = s_starts, s_ends, offsets
    return aim.distortion * (distortion(w, *ends) + aim.nearness * nearness(w, *ends))


def march(
    rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, fine: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Samples where ``grid`` (R, R, R) uint8 over contracted space is set, and ``fine`` allows it: see `marked`.

    Steps are ``step`` long inside the core cube and times m^1.5 outside, between a pixel's growth (m) and a
    contracted cell's (m^2). Returns t_starts (S,), t_ends (S,), offsets (N + 1,).
    """
    origins, directions, jitter = rays
    centre, radius = space
    near, far, step = lattice
    r = grid.shape[0]
    t = near + jitter * step
    starts, ends, owners = [], [], []
    live = torch.arange(len(origins), device=origins.device)
    while len(live):
        x = origins[live] + directions[live] * t[:, None]
        m = ((x - centre) / radius).abs().amax(-1)
        dt = step * m.clamp_min(1.0) ** 1.5
        mid = x + directions[live] * (dt / 2)[:, None]
        hit = marked((contract(mid, centre, radius) + 2) * (r / 4), grid, fine)
        starts.append(t[hit])
        ends.append((t + dt)[hit])
        owners.append(live[hit])
        t = t + dt
        going = t < far
        live, t = live[going], t[going]
    if not owners:  # no ray at all
        return t, t, torch.zeros(1, dtype=torch.long, device=t.device)
    owner = torch.cat(owners)
    order = torch.argsort(owner, stable=True)
    counts = torch.bincount(owner, minlength=len(origins))
    offsets = offsets_of(counts)
    return torch.cat(starts)[order], torch.cat(ends)[order], offsets


class Within(NamedTuple):
    """Masks of objects: trilinear values at nodes, of which more than a half is inside, one mask after the other."""

    boxes: Tensor
    """(G, 2, 3) float32 world, corner to corner of each mask's nodes"""
    shapes: Tensor
    """(G, 3) int64"""
    firsts: Tensor
    """(G,) int64, the row of each mask's first node"""
    values: Tensor
    """(K,) float32 at all nodes"""
    inside: bool
    """whether the samples are meant that are in every mask, or those in none"""


EVERYWHERE = Within(
    torch.zeros(0, 2, 3), torch.zeros(0, 3, dtype=torch.long), torch.zeros(0, dtype=torch.long), torch.zeros(0), False
)


def march_visible(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    net: DensityNet,
    stop: float,
    fine: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`march`, but a ray ends after the sample in which its optical depth passes ``stop``.

    The density is that of a hash encoding and one hidden layer of relu, per world unit: exp(raw) / radius.
    """
    t0, t1, _, offsets = march_within(rays, space, grid, lattice, net, stop, fine, EVERYWHERE)
    return t0, t1, offsets


def march_within(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    net: DensityNet,
    stop: float,
    fine: Tensor | None,
    within: Within,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As :func:`march_visible`, but only of the samples that are ``within``, and with their densities: t_starts (S,),
    t_ends (S,), densities (S,) per world unit, offsets (N + 1,)."""
    origins, directions, _ = rays
    t0, t1, offsets = march(rays, space, grid, lattice, fine)
    ids = _ray_ids(offsets)
    x = origins[ids] + directions[ids] * ((t0 + t1) / 2)[:, None]
    sigma = torch.exp(hash_density((contract(x, *space) + 2) / 4, net).clamp(max=15)) / space[1]
    meant = torch.ones(len(x), dtype=torch.bool, device=x.device)
    for box, shape, first in zip(within.boxes, within.shapes.tolist(), within.firsts.tolist()):
        nodes = within.values[first : first + shape[0] * shape[1] * shape[2]].reshape(shape)
        meant &= (trilinear(x, box, nodes) > 0.5) == within.inside
    keep = meant & (_exclusive_sum(torch.where(meant, sigma * (t1 - t0), 0.0), offsets) < stop)
    counts = torch.zeros(len(offsets) - 1, dtype=torch.long, device=ids.device).index_add(0, ids, keep.long())
    return t0[keep], t1[keep], sigma[keep], offsets_of(counts)


def render(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    stop: float,
    fine: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """What rays see of a hash field, without gradients: rgb (N, 3) on black, depth (N,), opacity (N,); see
    `refield.field.volrend.Rendering`."""
    tables, resolutions, networks = field
    origins, directions, _ = rays
    with torch.no_grad():
        net = (tables, resolutions, networks[0], networks[1][0])
        t0, t1, offsets = march_visible(rays, space, grid, lattice, net, stop, fine)
        ids, mid = _ray_ids(offsets), (t0 + t1) / 2
        unit = (contract(origins[ids] + directions[ids] * mid[:, None], *space) + 2) / 4
        raw, rgbs = hash_field(unit, directions[ids], tables, resolutions, networks)
        sigmas = truncated_exp(raw) / space[1]
        w = weights(sigmas, t0, t1, offsets)
        return seen(accumulate(w, to_be_seen(w, sigmas, rgbs, t0, t1), offsets))


def to_be_seen(w: Tensor, sigmas: Tensor, rgbs: Tensor, t_starts: Tensor, t_ends: Tensor) -> Tensor:
    """What a picture sums up along rays, of samples with weights (S,), (S, 6); see :func:`seen`."""
    mid = (t_starts + t_ends) / 2
    before = w / -torch.expm1(-sigmas * (t_ends - t_starts)).clamp(max=-1e-9)  # transmittance
    lit = (before > TRACE).to(w.dtype)
    return torch.cat([rgbs, torch.stack([lit * mid, lit, torch.ones_like(mid)], -1)], -1)


def seen(summed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums (N, 6) -> rgb (N, 3) on black, depth (N,), opacity (N,)."""
    return summed[:, :3], summed[:, 3] / summed[:, 4].clamp_min(1e-6), summed[:, 5]


def adam(param: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float, step: int) -> None:
    """One Adam step in place on any parameter; what has no gradient is left alone (as Instant-NGP does).

    ``grad`` is cleared for the next step.
    """
    b1, b2 = 0.9, 0.99
    scale = rate * math.sqrt(1 - b2**step) / (1 - b1**step)
    touched = grad != 0
    first.copy_(torch.where(touched, first * b1 + grad * (1 - b1), first))
    second.copy_(torch.where(touched, second * b2 + grad * grad * (1 - b2), second))
    param.sub_(torch.where(touched, scale * first / (second.sqrt() + 1e-15), torch.zeros_like(param)))
    grad.zero_()


def scatter_max(values: Tensor, cells: Tensor, into: Tensor) -> None:
    """``into[cells] = max(into[cells], values)`` in place; into (K,), cells (S,) int64."""
    into.scatter_reduce_(0, cells, values, "amax")


def observe(state: Tensor, now: int, decay: float, cells: Tensor, w: Tensor, sigmas: Tensor) -> None:
    """Note in ``state`` what samples found in their cells (S,) int64: weights (S,), densities (S,).

    state (K, 4): running maxima of a sample's opacity and of its weight, which decay once in each round in which the
    cell is seen; the length of a sample; the last such round, or below 0. ``now`` is this round.
    """
    seen = cells.unique()
    fresh = seen[state[seen, 3] != now]
    state[fresh, :2] *= decay
    state[fresh, 3] = now
    for column, values in ((0, 1 - torch.exp(-sigmas * state[cells, 2])), (1, w)):
        state[:, column] = state[:, column].scatter_reduce(0, cells, values, "amax")


def keep(state: Tensor, allowed: Tensor, opacity: float, weight: float, only_seen: bool) -> Tensor:
    """(K,) uint8: ``allowed`` (K,) bool cells above both bounds, and ``only_seen`` ones if wanted."""
    kept = allowed & (state[:, 0] > opacity) & (state[:, 1] > weight)
    return (kept & (state[:, 3] >= 0) if only_seen else kept).to(torch.uint8)


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        out = torch.exp(x.clamp(max=15))
        ctx.save_for_backward(out)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        (out,) = ctx.saved_tensors
        return grad * out.clamp(max=3e4)


def truncated_exp(x: Tensor) -> Tensor:
    """exp(min(x, 15)) whose gradient neither runs away nor ends: what is too dense can come back (Instant-NGP)."""
    return _TruncatedExp.apply(x)


class _ScaleGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, scale: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        ctx.save_for_backward(scale)
        return x.view_as(x)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[no-untyped-def]
        (scale,) = ctx.saved_tensors
        return grad * (scale if grad.dim() == 1 else scale[:, None]), None


def scale_gradient(x: Tensor, scale: Tensor) -> Tensor:
    """x (S,) or (S, C) itself; its gradient times scale (S,)."""
    return _ScaleGradient.apply(x, scale)


def train_step(
    batch: Batch,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    aim: Aim,
    into: list[Tensor],
    fine: Tensor | None = None,
) -> Stepped:
    """March, evaluate, composite, compare and go back: adds d loss / d parameter to ``into`` (tables, five matrices).

    loss = mean of trust times squared colour error (Eq. 2) + mean `spread`, distances in s = t / (t + radius). The
    error is that of gains * shown + background, 0 where a photo is burnt out and less bright.
    """
    tables, resolutions, networks = field
    origins, directions, _ = batch.rays
    net = (tables.detach(), resolutions, networks[0].detach(), networks[1][0].detach())
    t0, t1, offsets = march_visible(batch.rays, space, grid, lattice, net, aim.stop, fine)
    ids, mid = _ray_ids(offsets), (t0 + t1) / 2
    leaves = [p.detach().requires_grad_() for p in (tables, *networks)]
    ways = [r.detach().requires_grad_(batch.moving > 0) for r in (origins, directions)]
    with torch.enable_grad():
        unit = (contract(ways[0][ids] + ways[1][ids] * mid[:, None], *space) + 2) / 4
        raw, rgbs = hash_field(unit, directions[ids], leaves[0], resolutions, tuple(leaves[1:]))  # type: ignore[arg-type]
        sigmas = truncated_exp(raw) / space[1]
        near = (mid / aim.gradient_unit).square().clamp(max=1)
        w = weights(scale_gradient(sigmas, near), t0, t1, offsets)
        shown = accumulate(w, torch.cat([scale_gradient(rgbs, near), torch.ones_like(w)[:, None]], -1), offsets)
        errors = compared(shown, batch)
        s0, s1 = (t / (t + space[1]) for t in (t0, t1))
        counts = 1.0 if batch.trust is None else batch.trust[:, None]
        loss = (counts * errors.square()).mean() + spread(w, s0, s1, offsets, aim).mean()
    wanted = leaves + (ways if batch.moving else [])
    grads = torch.autograd.grad(loss, wanted)
    for total, grad in zip(into, grads):
        total += grad
    cells = _cells(unit.detach(), grid.shape[0])
    parts = part_of((unit.detach() * grid.shape[0] * 4).long().clamp_(0, 4 * grid.shape[0] - 1))
    to_rays = (grads[-2][: batch.moving], grads[-1][: batch.moving]) if batch.moving else None
    told = parts, shown[:, :3].detach(), errors.detach(), heaviest(w.detach(), offsets), to_rays
    return Stepped(float(loss.detach()), cells, w.detach(), sigmas.detach(), len(offsets) - 1, *told)


def heaviest(w: Tensor, offsets: Tensor) -> Tensor:
    """The sample of each ray with the greatest weight (S,), the first of several; (N,) int64, -1 without any."""
    ids = _ray_ids(offsets)
    most = w.new_zeros(len(offsets) - 1).scatter_reduce_(0, ids, w[: len(ids)], "amax")
    found = torch.full((len(offsets) - 1,), -1, dtype=torch.long, device=w.device)
    rows = (w[: len(ids)] == most[ids]).nonzero()[:, 0].flip(0)
    return found.scatter_(0, ids[rows], rows)


def compared(shown: Tensor, batch: Batch) -> Tensor:
    """What is composited, with its opacity (N, 4), less what the photos show (N, 3); see `Stepped.errors`."""
    rgb = shown[:, :3] if batch.gains is None else shown[:, :3] * batch.gains
    errors = rgb + (1 - shown[:, 3:]) * batch.background - batch.colours
    return torch.where((batch.colours > BURNT) & (errors > 0), torch.zeros_like(errors), errors)


def _cells(unit: Tensor, r: int) -> Tensor:
    """Flat index (S,) of the cell of an r**3 grid that holds each position (S, 3) in [0, 1]."""
    ijk = (unit * r).long().clamp_(0, r - 1)
    return (ijk[:, 0] * r + ijk[:, 1]) * r + ijk[:, 2]


def woven_step(
    batch: Batch,
    fixed: Fixed,
    unwanted: Unwanted,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    aim: Aim,
    into: list[Tensor],
    fine: Tensor | None = None,
) -> Stepped:
    """`train_step` with fixed segments between the samples (Eq. 4); they count in the loss as samples of no length.
    All photos count alike, as they are.

    The loss has one term more: the mean over rays of what the samples' weights add where they are unwanted.
    """
    tables, resolutions, networks = field
    origins, directions, _ = batch.rays
    net = (tables.detach(), resolutions, networks[0].detach(), networks[1][0].detach())
    t0, t1, offsets = march_visible(batch.rays, space, grid, lattice, net, aim.stop, fine)
    ids, mid = _ray_ids(offsets), (t0 + t1) / 2
    x = origins[ids] + directions[ids] * mid[:, None]
    if unwanted.taken is not None:
        t1 = torch.where(unwanted.taken(x), t0, t1)
    unit = (contract(x, *space) + 2) / 4
    cells = _cells(unit, grid.shape[0])
    counts = fixed.offsets.diff()[fixed.chosen]
    fixed_ids = torch.repeat_interleave(counts)
    before = offsets_of(counts)
    rows = (
        torch.arange(len(fixed_ids), device=fixed_ids.device)
        - before[fixed_ids]
        + fixed.offsets[fixed.chosen][fixed_ids]
    )
    t_mid, depth, shown = fixed.t_mid[rows], fixed.optical_depth[rows], fixed.rgb[rows]
    own, other = places_in_order(ids, mid, fixed_ids, t_mid)
    leaves = [p.detach().requires_grad_() for p in (tables, *networks)]
    with torch.enable_grad():
        raw, rgbs = hash_field(unit, directions[ids], leaves[0], resolutions, tuple(leaves[1:]))  # type: ignore[arg-type]
        sigmas = truncated_exp(raw) / space[1]
        near = (mid / aim.gradient_unit).square().clamp(max=1)
        n = len(own) + len(other)
        tau = mid.new_zeros(n).index_copy(0, own, scale_gradient(sigmas, near) * (t1 - t0)).index_copy(0, other, depth)
        rgb = mid.new_zeros(n, 3).index_copy(0, own, scale_gradient(rgbs, near)).index_copy(0, other, shown)
        begin = mid.new_zeros(n).index_copy(0, own, t0).index_copy(0, other, t_mid)
        end = mid.new_zeros(n).index_copy(0, own, t1).index_copy(0, other, t_mid)
        both = offsets + before
        w = weights(tau, torch.zeros_like(tau), torch.ones_like(tau), both)
        total = accumulate(w, torch.cat([rgb, torch.ones_like(w)[:, None]], -1), both)
        seen = total[:, :3] + (1 - total[:, 3:]) * batch.background
        s0, s1 = (t / (t + space[1]) for t in (begin, end))
        loss = (seen - batch.colours).square().mean() + spread(w, s0, s1, both, aim).mean()
        loss = loss + (w[own] * unwanted.misplaced[cells]).sum() / len(batch.colours)
    for into_one, grad in zip(into, torch.autograd.grad(loss, leaves)):
        into_one += grad
    asked = t1 > t0
    return Stepped(float(loss.detach()), cells[asked], w[own][asked].detach(), sigmas[asked].detach(), len(both) - 1)


def places_in_order(ids: Tensor, t: Tensor, other_ids: Tensor, other_t: Tensor) -> tuple[Tensor, Tensor]:
    """Two packed sets of the same rays as one, ray by ray and near to far: the places (S,), (K,) of each one's items.

    Rays (int64) and distances of either; at the same distance the first set comes first.
    """
    a, b = order_key(ids, t), order_key(other_ids, other_t)
    own = torch.arange(len(a), device=a.device) + torch.searchsorted(b, a)
    return own, torch.arange(len(b), device=a.device) + torch.searchsorted(a, b, right=True)


def order_key(ray: Tensor, t: Tensor) -> Tensor:
    """Sorts by ray, then by distance; (S,) float64. Distances are squashed to [0, 1), in order."""
    return ray.double() + t.double() / (1 + t.double())
