"""Positions, directions and volume rendering in Triton.

Sums over a ray are made by one program of one warp, a chunk of samples at a time: rays have some tens of samples, which
lie side by side in memory.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd import Function

from refield.field.kernels import reference
from refield.field.kernels.gpu.harmonics import harmonics

_BLOCK = 1024  # elements of elementwise work
_RAY = {"CHUNK": 64, "num_warps": 1}


def ray_ids(offsets: Tensor, samples: int) -> Tensor:
    """The ray of each of ``samples`` samples, (S,) int64, without asking the device how many there are.

    Samples behind the last ray's, the unused end of a fixed capacity, count as the last ray's.
    """
    position = torch.arange(samples, device=offsets.device)
    return torch.searchsorted(offsets, position, right=True).sub_(1).clamp_(max=len(offsets) - 2)


# --- positions and directions ----------------------------------------------------------------------------------------


@triton.jit
def _contract(x, centre, radius, out, n, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    s = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    a = (tl.load(x + 3 * s, mask=s < n, other=0.0) - tl.load(centre)) / radius
    b = (tl.load(x + 3 * s + 1, mask=s < n, other=0.0) - tl.load(centre + 1)) / radius
    c = (tl.load(x + 3 * s + 2, mask=s < n, other=0.0) - tl.load(centre + 2)) / radius
    far = tl.maximum(tl.maximum(tl.abs(a), tl.maximum(tl.abs(b), tl.abs(c))), 1.0)
    k = (2 - 1 / far) / far
    tl.store(out + 3 * s, a * k, mask=s < n)
    tl.store(out + 3 * s + 1, b * k, mask=s < n)
    tl.store(out + 3 * s + 2, c * k, mask=s < n)


def contract(x: Tensor, centre: Tensor, radius: float) -> Tensor:
    """See `reference.contract`, which also serves where a gradient to the position is wanted."""
    if x.requires_grad and torch.is_grad_enabled():
        return reference.contract(x, centre, radius)
    flat = x.detach().reshape(-1, 3).contiguous()
    out = torch.empty_like(flat)
    _contract[(triton.cdiv(len(flat), _BLOCK),)](flat, centre.float(), radius, out, len(flat), BLOCK=_BLOCK)
    return out.reshape(x.shape)


@triton.jit
def _harmonics(d, out, n, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    s = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x = tl.load(d + 3 * s, mask=s < n, other=0.0)
    y = tl.load(d + 3 * s + 1, mask=s < n, other=0.0)
    z = tl.load(d + 3 * s + 2, mask=s < n, other=0.0)
    column = tl.arange(0, 16)[None, :]
    tl.store(out + 16 * s[:, None] + column, harmonics(x, y, z), mask=(s < n)[:, None])


def spherical_harmonics(d: Tensor) -> Tensor:
    """See `reference.spherical_harmonics`, which also serves where a gradient to the direction is wanted."""
    if d.requires_grad and torch.is_grad_enabled():
        return reference.spherical_harmonics(d)
    flat = d.detach().reshape(-1, 3).contiguous()
    out = flat.new_empty(len(flat), 16)
    _harmonics[(triton.cdiv(len(flat), 128),)](flat, out, len(flat), BLOCK=128)
    return out.reshape(*d.shape[:-1], 16)


# --- volume rendering ------------------------------------------------------------------------------------------------


@triton.jit
def _opacity(tau):  # type: ignore[no-untyped-def]
    """1 - exp(-tau), which loses the digits of a small tau if written so."""
    series = tau * (1 - tau / 2 * (1 - tau / 3 * (1 - tau / 4)))
    return tl.where(tau < 0.03, series, 1 - tl.exp(-tau))


@triton.jit
def _depths(sigmas, t0, t1, i, first, end):  # type: ignore[no-untyped-def]
    """Lengths and optical depths of samples ``i``, and the depth of the chunk's samples before each.

    The depths before are summed from the neighbours' own and not as a sum less its last term: behind a surface of
    depth 1e4 nothing would be left of what was before it.
    """
    length = tl.load(t1 + i, mask=i < end, other=0.0) - tl.load(t0 + i, mask=i < end, other=0.0)
    tau = tl.load(sigmas + i, mask=i < end, other=0.0) * length
    j = i - 1
    has = (j >= first) & (j < end)
    length_j = tl.load(t1 + j, mask=has, other=0.0) - tl.load(t0 + j, mask=has, other=0.0)
    return length, tau, tl.cumsum(tl.load(sigmas + j, mask=has, other=0.0) * length_j, 0)


@triton.jit
def _weights(sigmas, t0, t1, offsets, out, CHUNK: tl.constexpr):  # type: ignore[no-untyped-def]
    ray = tl.program_id(0)
    begin, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    depth = 0.0
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        _, tau, before = _depths(sigmas, t0, t1, i, first, end)
        tl.store(out + i, tl.exp(-(depth + before)) * _opacity(tau), mask=i < end)
        depth += tl.sum(tau, 0)


@triton.jit
def _weights_backward(sigmas, t0, t1, offsets, w, grad, out, CHUNK: tl.constexpr):  # type: ignore[no-untyped-def]
    """d/dsigma_i = delta_i (T_{i+1} g_i - sum_{j>i} w_j g_j)."""
    ray = tl.program_id(0)
    begin, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    behind = 0.0
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        behind += tl.sum(tl.load(w + i, mask=i < end, other=0.0) * tl.load(grad + i, mask=i < end, other=0.0), 0)
    depth = 0.0
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        length, tau, before = _depths(sigmas, t0, t1, i, first, end)
        g = tl.load(grad + i, mask=i < end, other=0.0)
        wg = tl.load(w + i, mask=i < end, other=0.0) * g
        slope = length * (tl.exp(-(depth + before + tau)) * g - (behind - tl.cumsum(wg, 0)))
        tl.store(out + i, slope, mask=i < end)
        depth += tl.sum(tau, 0)
        behind -= tl.sum(wg, 0)


class _Weights(Function):
    @staticmethod
    def forward(ctx, sigmas: Tensor, t0: Tensor, t1: Tensor, offsets: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        sigmas, t0, t1 = sigmas.contiguous(), t0.contiguous(), t1.contiguous()
        out = torch.zeros_like(t0)  # samples of no ray weigh nothing
        _weights[(len(offsets) - 1,)](sigmas, t0, t1, offsets, out, **_RAY)
        ctx.save_for_backward(sigmas, t0, t1, offsets, out)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[no-untyped-def]
        sigmas, t0, t1, offsets, w = ctx.saved_tensors
        out = torch.zeros_like(sigmas)
        _weights_backward[(len(offsets) - 1,)](sigmas, t0, t1, offsets, w, grad.contiguous(), out, **_RAY)
        return out, None, None, None


def weights(sigmas: Tensor, t_starts: Tensor, t_ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.weights`; gradients flow to the densities only."""
    return _Weights.apply(sigmas, t_starts, t_ends, offsets)


@triton.jit
def _accumulate(w, values, offsets, out, C: tl.constexpr, CP: tl.constexpr, CHUNK: tl.constexpr):  # type: ignore[no-untyped-def]
    ray = tl.program_id(0)
    begin, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    c = tl.arange(0, CP)
    total = tl.zeros((CP,), tl.float32)
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        v = tl.load(values + i[:, None] * C + c[None, :], mask=(i < end)[:, None] & (c < C)[None, :], other=0.0)
        total += tl.sum(tl.load(w + i, mask=i < end, other=0.0)[:, None] * v, 0)
    tl.store(out + ray * C + c, total, mask=c < C)


@triton.jit
def _accumulate_backward(  # type: ignore[no-untyped-def]
    w, values, offsets, grad, to_w, to_values, C: tl.constexpr, CP: tl.constexpr, CHUNK: tl.constexpr
):
    ray = tl.program_id(0)
    begin, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    c = tl.arange(0, CP)
    g = tl.load(grad + ray * C + c, mask=c < C, other=0.0)[None, :]
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        inside = (i < end)[:, None] & (c < C)[None, :]
        v = tl.load(values + i[:, None] * C + c[None, :], mask=inside, other=0.0)
        tl.store(to_w + i, tl.sum(g * v, 1), mask=i < end)
        weight = tl.load(w + i, mask=i < end, other=0.0)
        tl.store(to_values + i[:, None] * C + c[None, :], weight[:, None] * g, mask=inside)


class _Accumulate(Function):
    @staticmethod
    def forward(ctx, w: Tensor, values: Tensor, offsets: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        w, values = w.contiguous(), values.contiguous()
        rays, channels = len(offsets) - 1, values.shape[1]
        ctx.shape = {"C": channels, "CP": triton.next_power_of_2(channels)}
        out = values.new_empty(rays, channels)
        _accumulate[(rays,)](w, values, offsets, out, **ctx.shape, **_RAY)
        ctx.save_for_backward(w, values, offsets)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None]:  # type: ignore[no-untyped-def]
        w, values, offsets = ctx.saved_tensors
        to_w, to_values = torch.zeros_like(w), torch.zeros_like(values)
        grid = (len(offsets) - 1,)
        _accumulate_backward[grid](w, values, offsets, grad.contiguous(), to_w, to_values, **ctx.shape, **_RAY)
        return to_w, to_values, None


def accumulate(w: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.accumulate`."""
    return _Accumulate.apply(w, values, offsets)


@triton.jit
def _distortion(w, s0, s1, offsets, out, slope, CHUNK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Each ray's distortion and its derivative with respect to every weight, in two sweeps."""
    ray = tl.program_id(0)
    begin, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    w_all = 0.0
    wm_all = 0.0
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        wi = tl.load(w + i, mask=i < end, other=0.0)
        mid = (tl.load(s0 + i, mask=i < end, other=0.0) + tl.load(s1 + i, mask=i < end, other=0.0)) / 2
        w_all += tl.sum(wi, 0)
        wm_all += tl.sum(wi * mid, 0)
    w_sum = 0.0
    wm_sum = 0.0
    total = 0.0
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        wi = tl.load(w + i, mask=i < end, other=0.0)
        a, b = tl.load(s0 + i, mask=i < end, other=0.0), tl.load(s1 + i, mask=i < end, other=0.0)
        mid = (a + b) / 2
        w_upto = w_sum + tl.cumsum(wi, 0)
        wm_upto = wm_sum + tl.cumsum(wi * mid, 0)
        left = mid * (w_upto - wi) - (wm_upto - wi * mid)
        right = (wm_all - wm_upto) - mid * (w_all - w_upto)
        total += tl.sum(2 * wi * left + wi * wi * (b - a) / 3, 0)
        tl.store(slope + i, 2 * (left + right) + 2 * wi * (b - a) / 3, mask=i < end)
        w_sum += tl.sum(wi, 0)
        wm_sum += tl.sum(wi * mid, 0)
    tl.store(out + ray, total)


@triton.jit
def _distortion_backward(slope, offsets, grad, out, CHUNK: tl.constexpr):  # type: ignore[no-untyped-def]
    ray = tl.program_id(0)
    begin, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    g = tl.load(grad + ray)
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        tl.store(out + i, tl.load(slope + i, mask=i < end, other=0.0) * g, mask=i < end)


class _Distortion(Function):
    @staticmethod
    def forward(ctx, w: Tensor, s0: Tensor, s1: Tensor, offsets: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        w, rays = w.contiguous(), len(offsets) - 1
        out, slope = w.new_empty(rays), torch.empty_like(w)
        _distortion[(rays,)](w, s0.contiguous(), s1.contiguous(), offsets, out, slope, **_RAY)
        ctx.save_for_backward(slope, offsets)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[no-untyped-def]
        slope, offsets = ctx.saved_tensors
        out = torch.zeros_like(slope)
        # the gradient of a mean comes as one number spread over all rays
        _distortion_backward[(len(offsets) - 1,)](slope, offsets, grad.contiguous(), out, **_RAY)
        return out, None, None, None


def distortion(w: Tensor, s_starts: Tensor, s_ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.distortion`; gradients flow to the weights only."""
    return _Distortion.apply(w, s_starts, s_ends, offsets)


@triton.jit
def _heaviest(w, offsets, out, CHUNK: tl.constexpr):  # type: ignore[no-untyped-def]
    ray = tl.program_id(0)
    begin, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    most = -1.0
    at = begin * 0 - 1
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        each = tl.load(w + i, mask=i < end, other=-1.0)
        here = tl.max(each, 0)
        at = tl.where(here > most, tl.min(tl.where(each == here, i, end), 0), at)
        most = tl.maximum(most, here)
    tl.store(out + ray, at)


def heaviest(w: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.heaviest`."""
    rays = len(offsets) - 1
    out = torch.empty(rays, dtype=torch.int64, device=w.device)
    _heaviest[(rays,)](w.contiguous(), offsets, out, **_RAY)
    return out
