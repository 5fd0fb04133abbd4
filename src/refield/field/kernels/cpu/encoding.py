"""Hash encoding on the CPU: forward in parallel over samples, backward over levels, so nothing is atomic.

A table's two features are one float64 to the loops (see `simd.fma_pair`): half the loads and stores.
"""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor
from torch.autograd import Function

from refield.field.kernels import reference
from refield.field.kernels.cpu.simd import JIT, fma_pair

_P1, _P2 = np.uint32(reference.PRIMES[1]), np.uint32(reference.PRIMES[2])
BLOCK = 64  # samples whose rows and weights are made together, in vectors
_ONE, _ZERO = np.float32(1), np.float32(0)


def array(t: Tensor) -> np.ndarray:
    """A tensor's memory as a contiguous numpy array."""
    return t.detach().contiguous().numpy()


def pairs(tables: Tensor) -> np.ndarray:
    """(L, T, 2) float32 -> (L, T) float64 of the same bits."""
    return array(tables).view(np.float64)[..., 0]


_buffers = threading.local()


def scratch(name: str, shape: tuple[int, ...], kind: Any = np.float32) -> np.ndarray:
    """An array to work in, of this thread, uninitialised and kept: fresh pages cost more than what is done with them.

    The next call by the same name gives the same memory.
    """
    size, known = math.prod(shape), vars(_buffers)
    if name not in known or known[name].size < size:
        known[name] = np.empty(size + size // 4, kind)
    return known[name][:size].reshape(shape)


def held(name: str) -> int:
    """How many numbers this thread's array by a name can hold; 0 if there is none yet."""
    return vars(_buffers)[name].size if name in vars(_buffers) else 0


@njit(forceinline=True, **JIT)
def _dense_rows(i, j, k, side, rows, s):  # type: ignore[no-untyped-def]
    base = (i * side + j) * side + k
    rows[0, s], rows[1, s] = base, base + np.uint32(1)
    rows[2, s], rows[3, s] = base + side, base + side + np.uint32(1)
    far = base + side * side
    rows[4, s], rows[5, s] = far, far + np.uint32(1)
    rows[6, s], rows[7, s] = far + side, far + side + np.uint32(1)


@njit(forceinline=True, **JIT)
def _hashed_rows(i, j, k, mask, rows, s):  # type: ignore[no-untyped-def]
    far, b, c = i + np.uint32(1), j * _P1, k * _P2
    e, f = b + _P1, c + _P2
    rows[0, s], rows[1, s] = (i ^ b ^ c) & mask, (i ^ b ^ f) & mask
    rows[2, s], rows[3, s] = (i ^ e ^ c) & mask, (i ^ e ^ f) & mask
    rows[4, s], rows[5, s] = (far ^ b ^ c) & mask, (far ^ b ^ f) & mask
    rows[6, s], rows[7, s] = (far ^ e ^ c) & mask, (far ^ e ^ f) & mask


@njit(forceinline=True, **JIT)
def _weights(fx, fy, fz, wts, s):  # type: ignore[no-untyped-def]
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    a, b, c, d = gx * gy, gx * fy, fx * gy, fx * fy
    wts[0, s], wts[1, s], wts[2, s], wts[3, s] = a * gz, a * fz, b * gz, b * fz
    wts[4, s], wts[5, s], wts[6, s], wts[7, s] = c * gz, c * fz, d * gz, d * fz


@njit(forceinline=True, **JIT)
def corners(unit, first, n, resolution, size, rows, wts):  # type: ignore[no-untyped-def]
    """Table rows (8, n) and trilinear weights (8, n) around unit positions ``first : first + n``.

    The bound comes first in ``max``: of a NaN that makes row 0 and a NaN weight, not an address.
    """
    res, top = np.float32(resolution), np.float32(resolution - 1)
    side, mask = np.uint32(resolution + 1), np.uint32(size - 1)
    if (resolution + 1) ** 3 <= size:  # two loops, so that each is a straight run of vectors
        for s in range(n):
            px, py, pz = unit[first + s, 0] * res, unit[first + s, 1] * res, unit[first + s, 2] * res
            i = np.int32(min(max(_ZERO, px), top))
            j = np.int32(min(max(_ZERO, py), top))
            k = np.int32(min(max(_ZERO, pz), top))
            _weights(px - np.float32(i), py - np.float32(j), pz - np.float32(k), wts, s)
            _dense_rows(np.uint32(i), np.uint32(j), np.uint32(k), side, rows, s)
    else:
        for s in range(n):
            px, py, pz = unit[first + s, 0] * res, unit[first + s, 1] * res, unit[first + s, 2] * res
            i = np.int32(min(max(_ZERO, px), top))
            j = np.int32(min(max(_ZERO, py), top))
            k = np.int32(min(max(_ZERO, pz), top))
            _weights(px - np.float32(i), py - np.float32(j), pz - np.float32(k), wts, s)
            _hashed_rows(np.uint32(i), np.uint32(j), np.uint32(k), mask, rows, s)


@njit(**JIT)
def encode_part(unit, begin, end, tables, resolutions, out):  # type: ignore[no-untyped-def]
    """Features of samples ``begin : end`` into out (S, L) of pairs. Levels outermost: one table stays in the cache."""
    rows, wts = np.empty((8, BLOCK), np.uint32), np.empty((8, BLOCK), np.float32)
    for level in range(tables.shape[0]):
        table = tables[level]
        for first in range(begin, end, BLOCK):
            n = min(BLOCK, end - first)
            corners(unit, first, n, resolutions[level], table.shape[0], rows, wts)
            for s in range(n):
                total = 0.0
                for c in range(8):
                    total = fma_pair(total, wts[c, s], table[rows[c, s]])
                out[first + s, level] = total


@njit(parallel=True, **JIT)
def encode(unit, tables, resolutions, out, parts):  # type: ignore[no-untyped-def]
    n = unit.shape[0]
    for p in prange(parts):
        encode_part(unit, n * p // parts, n * (p + 1) // parts, tables, resolutions, out)


@njit(parallel=True, **JIT)
def encode_backward(unit, grad, resolutions, into):  # type: ignore[no-untyped-def]
    """Adds the gradient to tables ``into`` (L, T) of pairs; grad (S, L) of pairs."""
    n, half = unit.shape[0], (into.shape[0] + 1) // 2
    for i in prange(into.shape[0]):
        # threads get runs of neighbours: let each have coarse levels, which stay in its cache, and fine ones
        level = 2 * i if i < half else 2 * (i - half) + 1
        rows, wts = np.empty((8, BLOCK), np.uint32), np.empty((8, BLOCK), np.float32)
        table = into[level]
        for first in range(0, n, BLOCK):
            m = min(BLOCK, n - first)
            corners(unit, first, m, resolutions[level], table.shape[0], rows, wts)
            for s in range(m):
                g = grad[first + s, level]
                for c in range(8):
                    row = rows[c, s]
                    table[row] = fma_pair(table[row], wts[c, s], g)


@njit(parallel=True, **JIT)
def encode_slope(unit, tables, resolutions, grad, out):  # type: ignore[no-untyped-def]
    """Gradient with respect to the position, (S, 3)."""
    n = unit.shape[0]
    for b in prange((n + BLOCK - 1) // BLOCK):
        rows, wts = np.empty((8, BLOCK), np.uint32), np.empty((8, BLOCK), np.float32)
        v = np.empty(8, np.float32)
        first, m = b * BLOCK, min(BLOCK, n - b * BLOCK)
        out[first : first + m] = 0
        for level in range(tables.shape[0]):
            res = np.float32(resolutions[level])
            corners(unit, first, m, resolutions[level], tables.shape[1], rows, wts)
            for s in range(m):
                g0, g1 = grad[first + s, 2 * level], grad[first + s, 2 * level + 1]
                for c in range(8):
                    v[c] = g0 * tables[level, rows[c, s], 0] + g1 * tables[level, rows[c, s], 1]
                px, py, pz = unit[first + s, 0] * res, unit[first + s, 1] * res, unit[first + s, 2] * res
                fx = px - np.float32(np.int32(min(max(_ZERO, px), res - _ONE)))
                fy = py - np.float32(np.int32(min(max(_ZERO, py), res - _ONE)))
                fz = pz - np.float32(np.int32(min(max(_ZERO, pz), res - _ONE)))
                gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
                out[first + s, 0] += res * (
                    gy * (gz * (v[4] - v[0]) + fz * (v[5] - v[1])) + fy * (gz * (v[6] - v[2]) + fz * (v[7] - v[3]))
                )
                out[first + s, 1] += res * (
                    gx * (gz * (v[2] - v[0]) + fz * (v[3] - v[1])) + fx * (gz * (v[6] - v[4]) + fz * (v[7] - v[5]))
                )
                out[first + s, 2] += res * (
                    gx * (gy * (v[1] - v[0]) + fy * (v[3] - v[2])) + fx * (gy * (v[5] - v[4]) + fy * (v[7] - v[6]))
                )


class _HashEncode(Function):
    @staticmethod
    def forward(ctx, unit: Tensor, tables: Tensor, resolutions: tuple[int, ...]) -> Tensor:  # type: ignore[no-untyped-def]
        res = np.asarray(resolutions, np.int32)
        out = torch.empty(unit.shape[0], 2 * len(resolutions))
        encode(array(unit), pairs(tables), res, out.numpy().view(np.float64), parts_of(len(unit)))
        ctx.save_for_backward(unit, tables)
        ctx.resolutions = res
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:  # type: ignore[no-untyped-def]
        unit, tables = ctx.saved_tensors
        to_unit, to_tables = None, None
        if ctx.needs_input_grad[0]:
            to_unit = torch.empty_like(unit)
            encode_slope(array(unit), array(tables), ctx.resolutions, array(grad), to_unit.numpy())
        if ctx.needs_input_grad[1]:
            to_tables = torch.zeros(tables.shape)
            encode_backward(array(unit), array(grad).view(np.float64), ctx.resolutions, pairs(to_tables))
        return to_unit, to_tables, None


def parts_of(samples: int) -> int:
    """Into how many parts work on so many samples is split: large ones, or every part fetches every table anew."""
    return min(2 * get_num_threads(), samples // 512 + 1)


def hash_encode(unit: Tensor, tables: Tensor, resolutions: tuple[int, ...]) -> Tensor:
    """See `reference.hash_encode`; two features a level."""
    return _HashEncode.apply(unit.contiguous(), tables, resolutions)
