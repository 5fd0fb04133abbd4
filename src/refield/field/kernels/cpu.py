"""The hot loops for the CPU, by numba: the same functions as `reference`, value for value and gradient for gradient.

Loops over samples or rays run in parallel; scatters run in parallel over levels, so nothing is atomic and results are
the same for every thread count. Arrays come in as numpy views of torch's memory.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd import Function

from refield.field.kernels import reference
from refield.field.kernels.reference import DensityNet, Lattice, Rays3, Space

_JIT: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz", "arcp"}, "cache": True, "nogil": True}
_P1, _P2 = np.uint32(reference.PRIMES[1]), np.uint32(reference.PRIMES[2])
_BLOCK = 1024  # samples a thread takes at a time: their coordinates stay in L1 while a level's table stays in L2


def _np(t: Tensor) -> np.ndarray:
    return t.detach().contiguous().numpy()


# --- hash encoding ---------------------------------------------------------------------------------------------------


@njit(inline="always", **_JIT)
def _corners(x, y, z, resolution, size, rows, wts):  # type: ignore[no-untyped-def]
    """The eight table rows and trilinear weights around a unit position."""
    px, py, pz = x * resolution, y * resolution, z * resolution
    ix = min(max(int(px), 0), resolution - 1)
    iy = min(max(int(py), 0), resolution - 1)
    iz = min(max(int(pz), 0), resolution - 1)
    fx, fy, fz = px - ix, py - iy, pz - iz
    gx, gy, gz = np.float32(1) - fx, np.float32(1) - fy, np.float32(1) - fz
    side = resolution + 1
    if side * side * side <= size:
        base = (ix * side + iy) * side + iz
        rows[0], rows[1] = base, base + 1
        rows[2], rows[3] = base + side, base + side + 1
        rows[4], rows[5] = base + side * side, base + side * side + 1
        rows[6], rows[7] = base + side * side + side, base + side * side + side + 1
    else:
        mask = np.uint32(size - 1)
        a0, a1 = np.uint32(ix), np.uint32(ix + 1)
        b0 = np.uint32(iy) * _P1
        c0 = np.uint32(iz) * _P2
        b1, c1 = np.uint32(b0 + _P1), np.uint32(c0 + _P2)
        rows[0], rows[1] = (a0 ^ b0 ^ c0) & mask, (a0 ^ b0 ^ c1) & mask
        rows[2], rows[3] = (a0 ^ b1 ^ c0) & mask, (a0 ^ b1 ^ c1) & mask
        rows[4], rows[5] = (a1 ^ b0 ^ c0) & mask, (a1 ^ b0 ^ c1) & mask
        rows[6], rows[7] = (a1 ^ b1 ^ c0) & mask, (a1 ^ b1 ^ c1) & mask
    wts[0], wts[1], wts[2], wts[3] = gx * gy * gz, gx * gy * fz, gx * fy * gz, gx * fy * fz
    wts[4], wts[5], wts[6], wts[7] = fx * gy * gz, fx * gy * fz, fx * fy * gz, fx * fy * fz


@njit(parallel=True, **_JIT)
def _encode(unit, tables, resolutions, out):  # type: ignore[no-untyped-def]
    n, levels, size = unit.shape[0], tables.shape[0], tables.shape[1]
    blocks = (n + _BLOCK - 1) // _BLOCK
    for b in prange(blocks):
        rows, wts = np.empty(8, np.int32), np.empty(8, np.float32)
        for level in range(levels):
            table = tables[level]
            for s in range(b * _BLOCK, min(n, (b + 1) * _BLOCK)):
                _corners(unit[s, 0], unit[s, 1], unit[s, 2], resolutions[level], size, rows, wts)
                a0 = a1 = np.float32(0)
                for k in range(8):
                    a0 += wts[k] * table[rows[k], 0]
                    a1 += wts[k] * table[rows[k], 1]
                out[s, 2 * level] = a0
                out[s, 2 * level + 1] = a1


@njit(parallel=True, **_JIT)
def _encode_backward(unit, grad, resolutions, grad_tables):  # type: ignore[no-untyped-def]
    n, levels, size = unit.shape[0], grad_tables.shape[0], grad_tables.shape[1]
    for level in prange(levels):
        rows, wts = np.empty(8, np.int32), np.empty(8, np.float32)
        table = grad_tables[level]
        for s in range(n):
            g0, g1 = grad[s, 2 * level], grad[s, 2 * level + 1]
            if g0 == 0 and g1 == 0:
                continue
            _corners(unit[s, 0], unit[s, 1], unit[s, 2], resolutions[level], size, rows, wts)
            for k in range(8):
                table[rows[k], 0] += wts[k] * g0
                table[rows[k], 1] += wts[k] * g1


@njit(parallel=True, **_JIT)
def _encode_slope(unit, tables, resolutions, grad, out):  # type: ignore[no-untyped-def]
    """Gradient with respect to the position, (S, 3)."""
    n, levels, size = unit.shape[0], tables.shape[0], tables.shape[1]
    for s in prange(n):
        rows, wts, v = np.empty(8, np.int32), np.empty(8, np.float32), np.empty(8, np.float32)
        sx = sy = sz = np.float32(0)
        for level in range(levels):
            res = resolutions[level]
            _corners(unit[s, 0], unit[s, 1], unit[s, 2], res, size, rows, wts)
            g0, g1 = grad[s, 2 * level], grad[s, 2 * level + 1]
            for k in range(8):
                v[k] = g0 * tables[level, rows[k], 0] + g1 * tables[level, rows[k], 1]
            fx = unit[s, 0] * res - min(max(int(unit[s, 0] * res), 0), res - 1)
            fy = unit[s, 1] * res - min(max(int(unit[s, 1] * res), 0), res - 1)
            fz = unit[s, 2] * res - min(max(int(unit[s, 2] * res), 0), res - 1)
            gx, gy, gz = 1 - fx, 1 - fy, 1 - fz
            sx += res * (
                gy * (gz * (v[4] - v[0]) + fz * (v[5] - v[1])) + fy * (gz * (v[6] - v[2]) + fz * (v[7] - v[3]))
            )
            sy += res * (
                gx * (gz * (v[2] - v[0]) + fz * (v[3] - v[1])) + fx * (gz * (v[6] - v[4]) + fz * (v[7] - v[5]))
            )
            sz += res * (
                gx * (gy * (v[1] - v[0]) + fy * (v[3] - v[2])) + fx * (gy * (v[5] - v[4]) + fy * (v[7] - v[6]))
            )
        out[s, 0], out[s, 1], out[s, 2] = sx, sy, sz


class _HashEncode(Function):
    @staticmethod
    def forward(ctx, unit: Tensor, tables: Tensor, resolutions: tuple[int, ...]) -> Tensor:  # type: ignore[no-untyped-def]
        unit = unit.contiguous()
        res = np.asarray(resolutions, np.int32)
        out = torch.empty(unit.shape[0], 2 * len(resolutions))
        _encode(_np(unit), _np(tables), res, out.numpy())
        ctx.save_for_backward(unit, tables)
        ctx.resolutions = res
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:  # type: ignore[no-untyped-def]
        unit, tables = ctx.saved_tensors
        g, to_unit, to_tables = _np(grad), None, None
        if ctx.needs_input_grad[0]:
            to_unit = torch.empty_like(unit)
            _encode_slope(_np(unit), _np(tables), ctx.resolutions, g, to_unit.numpy())
        if ctx.needs_input_grad[1]:
            to_tables = torch.zeros_like(tables)
            _encode_backward(_np(unit), g, ctx.resolutions, to_tables.numpy())
        return to_unit, to_tables, None


def hash_encode(unit: Tensor, tables: Tensor, resolutions: tuple[int, ...]) -> Tensor:
    """See `reference.hash_encode`; two features a level."""
    return _HashEncode.apply(unit, tables, resolutions)


# --- volume rendering ------------------------------------------------------------------------------------------------


@njit(parallel=True, **_JIT)
def _weights(sigmas, t0, t1, offsets, out):  # type: ignore[no-untyped-def]
    for r in prange(len(offsets) - 1):
        depth = np.float32(0)
        for i in range(offsets[r], offsets[r + 1]):
            tau = sigmas[i] * (t1[i] - t0[i])
            out[i] = math.exp(-depth) * -math.expm1(-tau)
            depth += tau


@njit(parallel=True, **_JIT)
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
        _weights(_np(sigmas), _np(t0), _np(t1), _np(offsets), out.numpy())
        ctx.save_for_backward(sigmas, t0, t1, offsets, out)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[no-untyped-def]
        sigmas, t0, t1, offsets, w = ctx.saved_tensors
        out = torch.empty_like(sigmas)
        _weights_backward(_np(sigmas), _np(t0), _np(t1), _np(offsets), _np(w), _np(grad), out.numpy())
        return out, None, None, None


def weights(sigmas: Tensor, t_starts: Tensor, t_ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.weights`; gradients flow to the densities only."""
    return _Weights.apply(sigmas, t_starts, t_ends, offsets)


@njit(parallel=True, **_JIT)
def _accumulate(w, values, offsets, out):  # type: ignore[no-untyped-def]
    channels = values.shape[1]
    for r in prange(len(offsets) - 1):
        for c in range(channels):
            out[r, c] = 0
        for i in range(offsets[r], offsets[r + 1]):
            for c in range(channels):
                out[r, c] += w[i] * values[i, c]


@njit(parallel=True, **_JIT)
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
        _accumulate(_np(w), _np(values), _np(offsets), out.numpy())
        ctx.save_for_backward(w, values, offsets)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None]:  # type: ignore[no-untyped-def]
        w, values, offsets = ctx.saved_tensors
        to_w, to_values = torch.empty_like(w), torch.empty_like(values)
        _accumulate_backward(_np(w), _np(values), _np(offsets), _np(grad), to_w.numpy(), to_values.numpy())
        return to_w, to_values, None


def accumulate(w: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.accumulate`."""
    return _Accumulate.apply(w, values, offsets)


@njit(parallel=True, **_JIT)
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
        _distortion(_np(w), _np(s0), _np(s1), _np(offsets), out.numpy(), slope.numpy())
        ctx.save_for_backward(slope, offsets)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[no-untyped-def]
        slope, offsets = ctx.saved_tensors
        return slope * torch.repeat_interleave(grad, offsets[1:] - offsets[:-1]), None, None, None


def distortion(w: Tensor, s_starts: Tensor, s_ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.distortion`; gradients flow to the weights only."""
    return _Distortion.apply(w, s_starts, s_ends, offsets)


# --- marching --------------------------------------------------------------------------------------------------------


@njit(inline="always", **_JIT)
def _cell_exit(u, d, cells, step):  # type: ignore[no-untyped-def]
    """Steps of the lattice until normalised position u, moving d a step, leaves its cell (core cube only)."""
    best = np.float32(1e9)
    for a in range(3):
        p = (u[a] + 2) * cells
        edge = math.floor(p) + (1 if d[a] > 0 else 0)
        speed = d[a] * cells
        if abs(speed) > 1e-9:
            best = min(best, (edge - p) / speed)
    return best / step


@njit(inline="always", **_JIT)
def _optical_density(u, k, tables, resolutions, w_in, w_out, room):  # type: ignore[no-untyped-def]
    """The density network's output at contracted position u * k: encoding, one hidden layer of relu."""
    rows, wts, hidden = room
    size, width = tables.shape[1], w_in.shape[1]
    x, y, z = (u[0] * k + 2) / 4, (u[1] * k + 2) / 4, (u[2] * k + 2) / 4
    for j in range(width):
        hidden[j] = 0
    for level in range(tables.shape[0]):
        _corners(x, y, z, resolutions[level], size, rows, wts)
        a0 = a1 = np.float32(0)
        for c in range(8):
            a0 += wts[c] * tables[level, rows[c], 0]
            a1 += wts[c] * tables[level, rows[c], 1]
        for j in range(width):
            hidden[j] += a0 * w_in[2 * level, j] + a1 * w_in[2 * level + 1, j]
    raw = np.float32(0)
    for j in range(width):
        raw += max(hidden[j], np.float32(0)) * w_out[j]
    return raw


@njit(parallel=True, **_JIT)
def _march(rays, space, grid, lattice, net, t0, t1, counts):  # type: ignore[no-untyped-def]
    """Fills row r of t0, t1 (N, K) and counts[r]; counts may exceed K, then the caller retries with a wider K.

    With a density network in ``net`` a ray ends where its optical depth passes ``stop``.
    """
    origins, directions, jitter = rays
    centre, radius = space
    near, far, step = lattice
    tables, resolutions, w_in, w_out, stop = net
    r_cells, room = grid.shape[0], t0.shape[1]
    per_unit = np.float32(r_cells / 4)
    blocks = (origins.shape[0] + 63) // 64
    for b in prange(blocks):
        u, v = np.empty(3, np.float32), np.empty(3, np.float32)
        scratch = (np.empty(8, np.int32), np.empty(8, np.float32), np.empty(max(len(w_out), 1), np.float32))
        for r in range(b * 64, min(origins.shape[0], (b + 1) * 64)):
            for a in range(3):
                v[a] = directions[r, a] / radius
            t = np.float32(near + jitter[r] * step)
            tau = np.float32(0)
            n = 0
            while t < far and tau < stop:
                m = np.float32(0)
                for a in range(3):
                    u[a] = (origins[r, a] - centre[a]) / radius + v[a] * t
                    m = max(m, abs(u[a]))
                m = max(m, np.float32(1))
                dt = np.float32(step) * m * math.sqrt(m)
                m = np.float32(0)
                for a in range(3):
                    u[a] += v[a] * dt / 2
                    m = max(m, abs(u[a]))
                k = np.float32(1) if m <= 1 else (2 - 1 / m) / m
                ix = min(max(int((u[0] * k + 2) * per_unit), 0), r_cells - 1)
                iy = min(max(int((u[1] * k + 2) * per_unit), 0), r_cells - 1)
                iz = min(max(int((u[2] * k + 2) * per_unit), 0), r_cells - 1)
                if grid[ix, iy, iz] > 0:
                    if n < room:
                        t0[r, n], t1[r, n] = t, t + dt
                    n += 1
                    if len(w_out) > 0:
                        raw = _optical_density(u, k, tables, resolutions, w_in, w_out, scratch)
                        tau += math.exp(min(raw, np.float32(15))) / radius * dt
                elif m < 1:
                    # all lattice midpoints inside this empty cell can be skipped; one is kept back for rounding
                    skip = math.floor(_cell_exit(u, v, per_unit, np.float32(step))) - 1
                    if skip > 0:
                        inside = (1 - m) / (step * max(abs(v[0]), abs(v[1]), abs(v[2])))
                        t += np.float32(step) * math.floor(min(np.float32(skip), np.float32(max(inside - 1, 0))))
                t += dt
            counts[r] = n


@njit(parallel=True, **_JIT)
def _pack(t0, t1, offsets, out0, out1):  # type: ignore[no-untyped-def]
    for r in prange(len(offsets) - 1):
        for i in range(offsets[r + 1] - offsets[r]):
            out0[offsets[r] + i] = t0[r, i]
            out1[offsets[r] + i] = t1[r, i]


_NO_NET = (np.empty((0, 1, 2), np.float32), np.empty(0, np.int32), np.empty((0, 0), np.float32),
           np.empty(0, np.float32), np.float32(np.inf))  # fmt: skip


def _marched(
    rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, net: tuple[Any, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    n, room = len(rays[0]), 64
    counts = np.empty(n, np.int64)
    arrays = tuple(_np(r) for r in rays)
    place = (_np(space[0].float()), np.float32(space[1]))
    while True:
        t0, t1 = np.empty((n, room), np.float32), np.empty((n, room), np.float32)
        _march(arrays, place, _np(grid), lattice, net, t0, t1, counts)
        most = int(counts.max(initial=0))
        if most <= room:
            break
        room = most
    offsets = np.zeros(n + 1, np.int64)
    np.cumsum(counts, out=offsets[1:])
    out0, out1 = torch.empty(int(offsets[-1])), torch.empty(int(offsets[-1]))
    _pack(t0, t1, offsets, out0.numpy(), out1.numpy())
    return out0, out1, torch.from_numpy(offsets)


def march(rays: Rays3, space: Space, grid: Tensor, lattice: Lattice) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.march`."""
    return _marched(rays, space, grid, lattice, _NO_NET)


def march_visible(
    rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, net: DensityNet, stop: float
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.march_visible`."""
    tables, resolutions, w_in, w_out = net
    arrays = (_np(tables), np.asarray(resolutions, np.int32), _np(w_in.T), _np(w_out), np.float32(stop))
    return _marched(rays, space, grid, lattice, arrays)


# --- the rest --------------------------------------------------------------------------------------------------------


@njit(parallel=True, **_JIT)
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
    _contract(_np(flat), _np(centre.float()), np.float32(radius), out.numpy())
    return out.reshape(x.shape)


@njit(parallel=True, **_JIT)
def _harmonics(d, out):  # type: ignore[no-untyped-def]
    for s in prange(d.shape[0]):
        x, y, z = d[s, 0], d[s, 1], d[s, 2]
        xx, yy, zz = x * x, y * y, z * z
        out[s, 0] = 0.28209479177387814
        out[s, 1] = -0.4886025119029199 * y
        out[s, 2] = 0.4886025119029199 * z
        out[s, 3] = -0.4886025119029199 * x
        out[s, 4] = 1.0925484305920792 * x * y
        out[s, 5] = -1.0925484305920792 * y * z
        out[s, 6] = 0.9461746957575601 * zz - 0.31539156525251999
        out[s, 7] = -1.0925484305920792 * x * z
        out[s, 8] = 0.5462742152960396 * (xx - yy)
        out[s, 9] = 0.5900435899266435 * y * (-3 * xx + yy)
        out[s, 10] = 2.890611442640554 * x * y * z
        out[s, 11] = 0.4570457994644657 * y * (1 - 5 * zz)
        out[s, 12] = 0.3731763325901154 * z * (5 * zz - 3)
        out[s, 13] = 0.4570457994644657 * x * (1 - 5 * zz)
        out[s, 14] = 1.445305721320277 * z * (xx - yy)
        out[s, 15] = 0.5900435899266435 * x * (-xx + 3 * yy)


def spherical_harmonics(d: Tensor) -> Tensor:
    """See `reference.spherical_harmonics`, which also serves where a gradient to the direction is wanted."""
    if d.requires_grad and torch.is_grad_enabled():
        return reference.spherical_harmonics(d)
    flat = d.reshape(-1, 3)
    out = torch.empty(len(flat), 16)
    _harmonics(_np(flat), out.numpy())
    return out.reshape(*d.shape[:-1], 16)


@njit(parallel=True, **_JIT)
def _adam(param, grad, first, second, scale):  # type: ignore[no-untyped-def]
    b1, b2 = np.float32(0.9), np.float32(0.99)
    blocks = (len(param) + 65535) // 65536
    for b in prange(blocks):
        for i in range(b * 65536, min(len(param), (b + 1) * 65536)):
            g = grad[i]
            if g != 0:
                first[i] = first[i] * b1 + g * (1 - b1)
                second[i] = second[i] * b2 + g * g * (1 - b2)
                param[i] -= scale * first[i] / (math.sqrt(second[i]) + np.float32(1e-15))


def adam(param: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float, step: int) -> None:
    """See `reference.adam`."""
    scale = rate * math.sqrt(1 - 0.99**step) / (1 - 0.9**step)
    flat = [_np(t).reshape(-1) for t in (param, grad, first, second)]
    _adam(*flat, np.float32(scale))


@njit(**_JIT)
def _scatter_max(values, cells, into):  # type: ignore[no-untyped-def]
    for i in range(len(values)):
        if values[i] > into[cells[i]]:
            into[cells[i]] = values[i]


def scatter_max(values: Tensor, cells: Tensor, into: Tensor) -> None:
    """See `reference.scatter_max`."""
    _scatter_max(_np(values), _np(cells), into.numpy())
