"""What happens along rays and at single points, on the CPU: weights, sums, distortion, contraction, harmonics."""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd import Function

from refield.field.kernels import reference
from refield.field.kernels.cpu.encoding import array
from refield.field.kernels.cpu.simd import JIT


@njit(parallel=True, **JIT)
def _weights(sigmas, t0, t1, offsets, out):  # type: ignore[no-untyped-def]
    for r in prange(len(offsets) - 1):
        depth = np.float32(0)
        for i in range(offsets[r], offsets[r + 1]):
            tau = sigmas[i] * (t1[i] - t0[i])
            out[i] = math.exp(-depth) * -math.expm1(-tau)
            depth += tau


@njit(parallel=True, **JIT)
def _weights_backward(sigmas, t0, t1, offsets, w, grad, out):  # type: ignore[no-untyped-def]
    """d/dsigma_i = delta_i (T_{i+1} g_i - sum_{j>i} w_j g_j)."""
    for r in prange(len(offsets) - 1):
        total = np.float32(0)
        for i in range(offsets[r], offsets[r + 1]):
            total += w[i] * grad[i]
        depth = np.float32(0)
        for i in range(offsets[r], offsets[r + 1]):
            total -= w[i] * grad[i]
            delta = t1[i] - t0[i]
            depth += sigmas[i] * delta
            out[i] = delta * (math.exp(-depth) * grad[i] - total)


class _Weights(Function):
    @staticmethod
    def forward(ctx, sigmas: Tensor, t0: Tensor, t1: Tensor, offsets: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        out = torch.empty_like(t0)
        _weights(array(sigmas), array(t0), array(t1), array(offsets), out.numpy())
        ctx.save_for_backward(sigmas, t0, t1, offsets, out)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[no-untyped-def]
        sigmas, t0, t1, offsets, w = ctx.saved_tensors
        out = torch.empty_like(sigmas)
        _weights_backward(array(sigmas), array(t0), array(t1), array(offsets), array(w), array(grad), out.numpy())
        return out, None, None, None


def weights(sigmas: Tensor, t_starts: Tensor, t_ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.weights`; gradients flow to the densities only."""
    return _Weights.apply(sigmas, t_starts, t_ends, offsets)


@njit(parallel=True, **JIT)
def _accumulate(w, values, offsets, out):  # type: ignore[no-untyped-def]
    channels = values.shape[1]
    for r in prange(len(offsets) - 1):
        for c in range(channels):
            out[r, c] = 0
        for i in range(offsets[r], offsets[r + 1]):
            for c in range(channels):
                out[r, c] += w[i] * values[i, c]


@njit(parallel=True, **JIT)
def _accumulate_backward(w, values, offsets, grad, to_w, to_values):  # type: ignore[no-untyped-def]
    channels = values.shape[1]
    for r in prange(len(offsets) - 1):
        for i in range(offsets[r], offsets[r + 1]):
            total = np.float32(0)
            for c in range(channels):
                total += grad[r, c] * values[i, c]
                to_values[i, c] = grad[r, c] * w[i]
            to_w[i] = total


class _Accumulate(Function):
    @staticmethod
    def forward(ctx, w: Tensor, values: Tensor, offsets: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        values = values.contiguous()
        out = torch.empty(len(offsets) - 1, values.shape[1])
        _accumulate(array(w), array(values), array(offsets), out.numpy())
        ctx.save_for_backward(w, values, offsets)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None]:  # type: ignore[no-untyped-def]
        w, values, offsets = ctx.saved_tensors
        to_w, to_values = torch.empty_like(w), torch.empty_like(values)
        _accumulate_backward(array(w), array(values), array(offsets), array(grad), to_w.numpy(), to_values.numpy())
        return to_w, to_values, None


def accumulate(w: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.accumulate`."""
    return _Accumulate.apply(w, values, offsets)


@njit(parallel=True, **JIT)
def _distortion(w, s0, s1, offsets, out, slope):  # type: ignore[no-untyped-def]
    """Each ray's distortion and its derivative with respect to every weight, in two sweeps."""
    for r in prange(len(offsets) - 1):
        w_all = wm_all = np.float32(0)
        for i in range(offsets[r], offsets[r + 1]):
            w_all += w[i]
            wm_all += w[i] * (s0[i] + s1[i]) / 2
        w_sum = wm_sum = total = np.float32(0)
        for i in range(offsets[r], offsets[r + 1]):
            mid, length = (s0[i] + s1[i]) / 2, s1[i] - s0[i]
            left = mid * w_sum - wm_sum
            w_sum += w[i]
            wm_sum += w[i] * mid
            right = (wm_all - wm_sum) - mid * (w_all - w_sum)
            total += 2 * w[i] * left + w[i] * w[i] * length / 3
            slope[i] = 2 * (left + right) + 2 * w[i] * length / 3
        out[r] = total


class _Distortion(Function):
    @staticmethod
    def forward(ctx, w: Tensor, s0: Tensor, s1: Tensor, offsets: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        out, slope = torch.empty(len(offsets) - 1), torch.empty_like(w)
        _distortion(array(w), array(s0), array(s1), array(offsets), out.numpy(), slope.numpy())
        ctx.save_for_backward(slope, offsets)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[no-untyped-def]
        slope, offsets = ctx.saved_tensors
        return slope * torch.repeat_interleave(grad, offsets[1:] - offsets[:-1]), None, None, None


def distortion(w: Tensor, s_starts: Tensor, s_ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.distortion`; gradients flow to the weights only."""
    return _Distortion.apply(w, s_starts, s_ends, offsets)


@njit(parallel=True, **JIT)
def _contract(x, centre, radius, out):  # type: ignore[no-untyped-def]
    for s in prange(x.shape[0]):
        a, b, c = (
            (x[s, 0] - centre[0]) / radius,
            (x[s, 1] - centre[1]) / radius,
            (x[s, 2] - centre[2]) / radius,
        )
        m = max(abs(a), max(abs(b), abs(c)))
        k = np.float32(1) if m <= 1 else (2 - 1 / m) / m
        out[s, 0], out[s, 1], out[s, 2] = a * k, b * k, c * k


def contract(x: Tensor, centre: Tensor, radius: float) -> Tensor:
    """See `reference.contract`, which also serves where a gradient to the position is wanted."""
    if x.requires_grad and torch.is_grad_enabled():
        return reference.contract(x, centre, radius)
    flat = x.reshape(-1, 3)
    out = torch.empty_like(flat)
    _contract(array(flat), array(centre.float()), np.float32(radius), out.numpy())
    return out.reshape(x.shape)


@njit(forceinline=True, **JIT)
def harmonics_of(x, y, z, out):  # type: ignore[no-untyped-def]
    """The 16 harmonics of one direction; all constants are float32, or the loop would run in double precision."""
    f = np.float32
    xx, yy, zz = x * x, y * y, z * z
    out[0] = f(0.28209479177387814)
    out[1] = f(-0.4886025119029199) * y
    out[2] = f(0.4886025119029199) * z
    out[3] = f(-0.4886025119029199) * x
    out[4] = f(1.0925484305920792) * x * y
    out[5] = f(-1.0925484305920792) * y * z
    out[6] = f(0.9461746957575601) * zz - f(0.31539156525251999)
    out[7] = f(-1.0925484305920792) * x * z
    out[8] = f(0.5462742152960396) * (xx - yy)
    out[9] = f(0.5900435899266435) * y * (yy - f(3) * xx)
    out[10] = f(2.890611442640554) * x * y * z
    out[11] = f(0.4570457994644657) * y * (f(1) - f(5) * zz)
    out[12] = f(0.3731763325901154) * z * (f(5) * zz - f(3))
    out[13] = f(0.4570457994644657) * x * (f(1) - f(5) * zz)
    out[14] = f(1.445305721320277) * z * (xx - yy)
    out[15] = f(0.5900435899266435) * x * (f(3) * yy - xx)


@njit(parallel=True, **JIT)
def _harmonics(d, out):  # type: ignore[no-untyped-def]
    for s in prange(d.shape[0]):
        harmonics_of(d[s, 0], d[s, 1], d[s, 2], out[s])


def spherical_harmonics(d: Tensor) -> Tensor:
    """See `reference.spherical_harmonics`, which also serves where a gradient to the direction is wanted."""
    if d.requires_grad and torch.is_grad_enabled():
        return reference.spherical_harmonics(d)
    flat = d.reshape(-1, 3)
    out = torch.empty(len(flat), 16)
    _harmonics(array(flat), out.numpy())
    return out.reshape(*d.shape[:-1], 16)
