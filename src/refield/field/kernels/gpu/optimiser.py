"""What happens once a step to everything that is learnt, and once a sample to the cell it lies in; in Triton."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 1024


@triton.jit
def _adam(param, grad, first, second, scale, n, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    g = tl.load(grad + i, mask=i < n, other=0.0)
    touched = g != 0  # never outside
    m = tl.load(first + i, mask=touched, other=0.0) * 0.9 + g * (1 - 0.9)
    v = tl.load(second + i, mask=touched, other=0.0) * 0.99 + g * g * (1 - 0.99)
    p = tl.load(param + i, mask=touched, other=0.0)
    tl.store(first + i, m, mask=touched)
    tl.store(second + i, v, mask=touched)
    tl.store(param + i, p - tl.load(scale) * m / (tl.sqrt(v) + 1e-15), mask=touched)
    tl.store(grad + i, tl.zeros_like(g), mask=touched)


def adam(param: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float | Tensor, step: int | Tensor) -> None:
    """See `reference.adam`; all four contiguous.

    Rate and step may also be tensors () on the device, so that a captured step can move on.
    """
    descend(param, grad, first, second, adam_scale(rate, step, param.device))


def adam_scale(rate: float | Tensor, step: int | Tensor, device: torch.device) -> Tensor:
    """What Adam multiplies its ratio of moments by in this step, ()."""
    steps = step.double() if isinstance(step, Tensor) else step
    found = rate * (1 - 0.99**steps) ** 0.5 / (1 - 0.9**steps)
    # a fill and not a copy from the host, which a graph could not hold
    return found.float() if isinstance(found, Tensor) else torch.full((), found, device=device)


def descend(param: Tensor, grad: Tensor, first: Tensor, second: Tensor, scale: Tensor) -> None:
    """:func:`adam` with the scale found before: it is the same for all that learns at one rate."""
    n = param.numel()
    _adam[(triton.cdiv(n, _BLOCK),)](param.detach(), grad, first, second, scale, n, BLOCK=_BLOCK)


@triton.jit
def _scatter_max(values, cells, into, stride, n, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    cell = tl.load(cells + i, mask=i < n, other=0)
    tl.atomic_max(into + cell * stride, tl.load(values + i, mask=i < n, other=0.0), mask=i < n, sem="relaxed")


def scatter_max(values: Tensor, cells: Tensor, into: Tensor) -> None:
    """See `reference.scatter_max`; ``into`` may be a column."""
    n = len(values)
    _scatter_max[(triton.cdiv(n, 256),)](
        values.detach().contiguous(), cells.contiguous(), into, into.stride(0), n, BLOCK=256
    )


@triton.jit
def _renew(state, now, decay, cells, w, n, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """The first sample to reach a cell in this round lets its maxima decay."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = (i < n) & (tl.load(w + i, mask=i < n, other=-1.0) >= 0)
    cell = state + 4 * tl.load(cells + i, mask=real, other=0)
    # rounds are compared as bits: they are whole numbers, and an exchange of integers is known everywhere
    this = (tl.load(now) + tl.zeros((BLOCK,), tl.float32)).to(tl.int32, bitcast=True)
    last = (cell + 3).to(tl.pointer_type(tl.int32), bitcast=True)
    first = real & (tl.atomic_xchg(last, this, mask=real, sem="relaxed") != this)
    tl.store(cell, tl.load(cell, mask=first, other=0.0) * decay, mask=first)
    tl.store(cell + 1, tl.load(cell + 1, mask=first, other=0.0) * decay, mask=first)


@triton.jit
def _raise(state, cells, w, sigmas, n, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    weight = tl.load(w + i, mask=i < n, other=-1.0)
    real = (i < n) & (weight >= 0)
    cell = state + 4 * tl.load(cells + i, mask=real, other=0)
    depth = tl.load(sigmas + i, mask=real, other=0.0) * tl.load(cell + 2, mask=real, other=0.0)
    tl.atomic_max(cell, 1 - tl.exp(-depth), mask=real, sem="relaxed")
    tl.atomic_max(cell + 1, weight, mask=real, sem="relaxed")


def observe(state: Tensor, now: int | Tensor, decay: float, cells: Tensor, w: Tensor, sigmas: Tensor) -> None:
    """See `reference.observe`; a weight below zero marks what is no sample. The round may be a tensor () float32.

    In two launches, since all of a cell's decay must be over before the first maximum is taken.
    """
    n, grid = len(cells), (triton.cdiv(len(cells), 256),)
    this = now if isinstance(now, Tensor) else torch.full((), float(now), device=state.device)
    cells, w, sigmas = cells.contiguous(), w.detach().contiguous(), sigmas.detach().contiguous()
    _renew[grid](state, this, decay, cells, w, n, BLOCK=256)
    _raise[grid](state, cells, w, sigmas, n, BLOCK=256)
