"""What happens once a step to everything that is learnt, and once a sample to the cell it lies in."""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from refield.field.kernels.cpu.encoding import array
from refield.field.kernels.cpu.simd import JIT, exp

_BLOCK = 1 << 14
_LINE = 16  # floats
_ONE = np.float32(1)


@njit(**JIT)
def _adam_small(param, grad, first, second, scale):  # type: ignore[no-untyped-def]
    part1, part2, eps = np.float32(0.1), np.float32(0.01), np.float32(1e-15)
    for i in range(len(param)):
        if grad[i] != 0:
            first[i] += part1 * (grad[i] - first[i])
            second[i] += part2 * (grad[i] * grad[i] - second[i])
            param[i] -= scale * first[i] / (math.sqrt(second[i]) + eps)
        grad[i] = 0


@njit(**JIT)
def _adam_line(first_float, param, grad, bits, first, second, scale):  # type: ignore[no-untyped-def]
    """A cache line of each array: nothing but the gradient is fetched where nothing was touched, as in most of a large
    table in any one step."""
    part1, part2, eps = np.float32(0.1), np.float32(0.01), np.float32(1e-15)
    seen = np.int32(0)
    for i in range(first_float, first_float + _LINE):
        seen |= bits[i]
    if seen == 0:
        return
    for i in range(first_float, first_float + _LINE):
        g = grad[i]
        touched = np.float32(g != 0)  # a factor, not a branch: the loop is one run of vectors
        m = first[i] + touched * part1 * (g - first[i])
        v = second[i] + touched * part2 * (g * g - second[i])
        first[i], second[i] = m, v
        param[i] -= touched * scale * m / (math.sqrt(v) + eps)
        grad[i] = 0


@njit(parallel=True, **JIT)
def _adam(param, grad, bits, first, second, scale):  # type: ignore[no-untyped-def]
    whole = len(param) // _LINE * _LINE
    for b in prange((whole + _BLOCK - 1) // _BLOCK):
        for i in range(b * _BLOCK, min(whole, (b + 1) * _BLOCK), _LINE):
            _adam_line(i, param, grad, bits, first, second, scale)
    _adam_small(param[whole:], grad[whole:], first[whole:], second[whole:], scale)


def adam(param: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float, step: int) -> None:
    """See `reference.adam`."""
    scale = rate * math.sqrt(1 - 0.99**step) / (1 - 0.9**step)
    flat = [array(t).reshape(-1) for t in (param, grad, first, second)]
    if param.numel() > _BLOCK:
        _adam(*flat[:2], flat[1].view(np.int32), *flat[2:], np.float32(scale))
    else:
        _adam_small(*flat, np.float32(scale))


@njit(**JIT)
def _scatter_max(values, cells, into):  # type: ignore[no-untyped-def]
    for i in range(len(values)):
        if values[i] > into[cells[i]]:
            into[cells[i]] = values[i]


def scatter_max(values: Tensor, cells: Tensor, into: Tensor) -> None:
    """See `reference.scatter_max`."""
    _scatter_max(array(values), array(cells), into.numpy())


@njit(**JIT)
def _observe(state, now, decay, cells, w, sigmas):  # type: ignore[no-untyped-def]
    for i in range(len(cells)):
        cell = state[cells[i]]
        if cell[3] != now:
            cell[0], cell[1], cell[3] = cell[0] * decay, cell[1] * decay, now
        cell[0] = max(cell[0], _ONE - exp(-sigmas[i] * cell[2]))
        cell[1] = max(cell[1], w[i])


def observe(state: Tensor, now: int, decay: float, cells: Tensor, w: Tensor, sigmas: Tensor) -> None:
    """See `reference.observe`."""
    _observe(array(state), np.float32(now), np.float32(decay), array(cells), array(w), array(sigmas))


@njit(parallel=True, **JIT)
def _keep(state, allowed, opacity, weight, only_seen, out):  # type: ignore[no-untyped-def]
    for b in prange((len(out) + _BLOCK - 1) // _BLOCK):
        for i in range(b * _BLOCK, min(len(out), (b + 1) * _BLOCK)):
            kept = state[i, 0] > opacity and state[i, 1] > weight and (state[i, 3] >= 0 or not only_seen)
            out[i] = kept and allowed[i]


def keep(state: Tensor, allowed: Tensor, opacity: float, weight: float, only_seen: bool) -> Tensor:
    """See `reference.keep`."""
    out = torch.empty(len(state), dtype=torch.uint8)
    _keep(array(state), array(allowed), np.float32(opacity), np.float32(weight), only_seen, out.numpy())
    return out
