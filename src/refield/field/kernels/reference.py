"""The hot loops in plain torch: the truth that the fast twins are tested against, and the path of any other device.

Letters: S samples packed by ray, N rays, ``offsets`` (N + 1,); L levels, F features a level, C channels.
Every function here is differentiable by autograd where its twin is.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

Rays3 = tuple[Tensor, Tensor, Tensor]
"""origins (N, 3), unit directions (N, 3), jitter (N,) in [0, 1) that shifts each ray's lattice"""
Space = tuple[Tensor, float]
"""centre (3,) and radius of the contraction"""
Lattice = tuple[float, float, float]
"""near, far, step in world units"""
DensityNet = tuple[Tensor, tuple[int, ...], Tensor, Tensor]
"""hash tables (L, T, F), their resolutions, hidden weights (H, L * F), output weights (H,)"""

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


def march(rays: Rays3, space: Space, grid: Tensor, lattice: Lattice) -> tuple[Tensor, Tensor, Tensor]:
    """Samples where ``grid`` (R, R, R) uint8 over contracted space is set.

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
        cell = ((contract(mid, centre, radius) + 2) * (r / 4)).long().clamp(0, r - 1)
        hit = grid[cell[:, 0], cell[:, 1], cell[:, 2]] > 0
        starts.append(t[hit])
        ends.append((t + dt)[hit])
        owners.append(live[hit])
        t = t + dt
        going = t < far
        live, t = live[going], t[going]
    owner = torch.cat(owners) if owners else torch.zeros(0, dtype=torch.long)
    order = torch.argsort(owner, stable=True)
    counts = torch.bincount(owner, minlength=len(origins))
    offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    return torch.cat(starts)[order], torch.cat(ends)[order], offsets


def march_visible(
    rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, net: DensityNet, stop: float
) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`march`, but a ray ends after the sample in which its optical depth passes ``stop``.

    The density is that of a hash encoding and one hidden layer of relu, per world unit: exp(raw) / radius.
    """
    origins, directions, _ = rays
    t0, t1, offsets = march(rays, space, grid, lattice)
    tables, resolutions, w_in, w_out = net
    ids = _ray_ids(offsets)
    x = origins[ids] + directions[ids] * ((t0 + t1) / 2)[:, None]
    features = hash_encode((contract(x, *space) + 2) / 4, tables, resolutions)
    sigma = torch.exp(((features @ w_in.T).relu() @ w_out).clamp(max=15)) / space[1]
    keep = _exclusive_sum(sigma * (t1 - t0), offsets) < stop
    counts = torch.zeros(len(offsets) - 1, dtype=torch.long, device=ids.device).index_add(0, ids, keep.long())
    return t0[keep], t1[keep], torch.cat([counts.new_zeros(1), counts.cumsum(0)])


def adam(param: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float, step: int) -> None:
    """One Adam step in place on a hash table (L, T, F); rows without gradient are left alone (as Instant-NGP does)."""
    b1, b2 = 0.9, 0.99
    scale = rate * math.sqrt(1 - b2**step) / (1 - b1**step)
    touched = grad != 0
    first.copy_(torch.where(touched, first * b1 + grad * (1 - b1), first))
    second.copy_(torch.where(touched, second * b2 + grad * grad * (1 - b2), second))
    param.sub_(torch.where(touched, scale * first / (second.sqrt() + 1e-15), torch.zeros_like(param)))


def scatter_max(values: Tensor, cells: Tensor, into: Tensor) -> None:
    """``into[cells] = max(into[cells], values)`` in place; into (K,), cells (S,) int64."""
    into.scatter_reduce_(0, cells, values, "amax")
