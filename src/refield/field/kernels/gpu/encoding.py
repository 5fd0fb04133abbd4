"""The hash encoding in Triton, and the pieces of it that marching and the fused field share.

A program owns a block of samples times all levels (padded to a power of two), so that nothing but the eight rows of a
cell is fetched per sample and level. An entry of a table is two floats and is fetched as one 64-bit word.
Letters: B samples a block, LP padded levels, T entries of a level's table.
"""

from __future__ import annotations

from functools import cache

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd import Function

from refield.field.kernels.reference import PRIMES

P1, P2 = tl.constexpr(PRIMES[1]), tl.constexpr(PRIMES[2])
BLOCK = 64  # samples


@cache
def level_table(resolutions: tuple[int, ...], size: int, device: torch.device) -> Tensor:
    """(2, L) int32: each level's resolution, and whether its lattice fits the table as it is.

    Made once per shape and kept: a copy to the device may not happen while a graph is captured.
    """
    dense = [int((r + 1) ** 3 <= size) for r in resolutions]
    return torch.tensor([list(resolutions), dense], dtype=torch.int32, device=device)


def padded_levels(count: int) -> int:
    """Levels of a tile: tl.dot wants at least 16 features."""
    return max(8, triton.next_power_of_2(count))


def words(tables: Tensor) -> Tensor:
    """Tables (L, T, 2) float32 as one 64-bit word an entry."""
    return tables.detach().contiguous().view(torch.int64)


@triton.jit
def cells(x, y, z, levels, L: tl.constexpr, LP: tl.constexpr):  # type: ignore[no-untyped-def]
    """Lowest corners (B, LP) int32 x 3, places in the cell (B, LP) x 3, resolutions and dense (1, LP)."""
    level = tl.arange(0, LP)
    resolution = tl.load(levels + level, mask=level < L, other=1)[None, :]
    dense = tl.load(levels + L + level, mask=level < L, other=0)[None, :]
    scale = resolution.to(tl.float32)
    px, py, pz = x[:, None] * scale, y[:, None] * scale, z[:, None] * scale
    ix = tl.minimum(tl.maximum(tl.floor(px).to(tl.int32), 0), resolution - 1)
    iy = tl.minimum(tl.maximum(tl.floor(py).to(tl.int32), 0), resolution - 1)
    iz = tl.minimum(tl.maximum(tl.floor(pz).to(tl.int32), 0), resolution - 1)
    fx, fy, fz = px - ix.to(tl.float32), py - iy.to(tl.float32), pz - iz.to(tl.float32)
    return ix, iy, iz, fx, fy, fz, resolution, dense


@triton.jit
def row_of(ix, iy, iz, resolution, dense, size, LP: tl.constexpr, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Entry (B, LP) of one corner in the tables laid end to end; `reference.level_index` in uint32."""
    x = (ix + (CORNER // 4)).to(tl.uint32)
    y = (iy + (CORNER // 2 % 2)).to(tl.uint32)
    z = (iz + (CORNER % 2)).to(tl.uint32)
    side = (resolution + 1).to(tl.uint32)
    hashed = (x ^ (y * P1) ^ (z * P2)) & (size - 1).to(tl.uint32)
    direct = (x * side + y) * side + z
    row = tl.where(dense != 0, direct, hashed).to(tl.int32)
    return row + (tl.arange(0, LP) * size)[None, :]


@triton.jit
def weight_of(fx, fy, fz, CORNER: tl.constexpr):  # type: ignore[no-untyped-def]
    """Trilinear weight (B, LP) of one corner."""
    wx = fx if CORNER // 4 == 1 else 1 - fx
    wy = fy if CORNER // 2 % 2 == 1 else 1 - fy
    wz = fz if CORNER % 2 == 1 else 1 - fz
    return wx * wy * wz


@triton.jit
def low_and_high(word):  # type: ignore[no-untyped-def]
    """The two floats of a 64-bit word."""
    low = word.to(tl.int32).to(tl.float32, bitcast=True)
    high = (word >> 32).to(tl.int32).to(tl.float32, bitcast=True)
    return low, high


@triton.jit
def encoded(x, y, z, inside, tables, levels, size, L: tl.constexpr, LP: tl.constexpr):  # type: ignore[no-untyped-def]
    """Features (B, 2 LP) at places (B,) in [0, 1]; zero outside ``inside`` and on padding."""
    ix, iy, iz, fx, fy, fz, resolution, dense = cells(x, y, z, levels, L, LP)
    wanted = inside[:, None] & (tl.arange(0, LP) < L)[None, :]
    a, b = tl.zeros_like(fx), tl.zeros_like(fx)
    for corner in tl.static_range(8):
        row = row_of(ix, iy, iz, resolution, dense, size, LP, corner)
        w = weight_of(fx, fy, fz, corner)
        low, high = low_and_high(tl.load(tables + row, mask=wanted, other=0))
        a += w * low
        b += w * high
    return tl.reshape(tl.join(a, b), (a.shape[0], 2 * LP))


@triton.jit
def scatter(x, y, z, inside, grad, into, levels, size, L: tl.constexpr, LP: tl.constexpr):  # type: ignore[no-untyped-def]
    """Add the gradients (B, 2 LP) of the features to the tables' (L, T, 2); what is zero costs nothing."""
    ix, iy, iz, fx, fy, fz, resolution, dense = cells(x, y, z, levels, L, LP)
    pair = tl.reshape(grad, (grad.shape[0], LP, 2))
    a, b = tl.split(pair)
    wanted = inside[:, None] & (tl.arange(0, LP) < L)[None, :] & ((a != 0) | (b != 0))
    feature = tl.arange(0, 2)[None, None, :]
    for corner in tl.static_range(8):
        entry = into + 2 * row_of(ix, iy, iz, resolution, dense, size, LP, corner)
        w = weight_of(fx, fy, fz, corner)
        # both features in one block: on Hopper they become one instruction
        tl.atomic_add(entry[:, :, None] + feature, w[:, :, None] * pair, mask=wanted[:, :, None], sem="relaxed")


@triton.jit
def place(unit, s, inside):  # type: ignore[no-untyped-def]
    """Coordinates (B,) x 3 of samples ``s`` of (S, 3)."""
    x = tl.load(unit + 3 * s, mask=inside, other=0.0)
    y = tl.load(unit + 3 * s + 1, mask=inside, other=0.0)
    z = tl.load(unit + 3 * s + 2, mask=inside, other=0.0)
    return x, y, z


@triton.jit
def _encode(unit, tables, levels, out, n, size, L: tl.constexpr, LP: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    s = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y, z = place(unit, s, s < n)
    features = encoded(x, y, z, s < n, tables, levels, size, L, LP)
    column = tl.arange(0, 2 * LP)[None, :]
    tl.store(out + s[:, None] * (2 * L) + column, features, mask=(s < n)[:, None] & (column < 2 * L))


@triton.jit
def _encode_backward(unit, grad, levels, into, n, size, L: tl.constexpr, LP: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    s = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y, z = place(unit, s, s < n)
    column = tl.arange(0, 2 * LP)[None, :]
    g = tl.load(grad + s[:, None] * (2 * L) + column, mask=(s < n)[:, None] & (column < 2 * L), other=0.0)
    scatter(x, y, z, s < n, g, into, levels, size, L, LP)


@triton.jit
def _encode_slope(unit, tables, grad, levels, out, n, size, L: tl.constexpr, LP: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Gradient with respect to the position, (S, 3)."""
    s = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y, z = place(unit, s, s < n)
    ix, iy, iz, fx, fy, fz, resolution, dense = cells(x, y, z, levels, L, LP)
    level = tl.arange(0, LP)[None, :]
    wanted = (s < n)[:, None] & (level < L)
    first = grad + s[:, None] * (2 * L) + 2 * level
    ga, gb = tl.load(first, mask=wanted, other=0.0), tl.load(first + 1, mask=wanted, other=0.0)
    one = tl.zeros_like(fx) + 1
    sx, sy, sz = tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx)
    for corner in tl.static_range(8):
        row = row_of(ix, iy, iz, resolution, dense, size, LP, corner)
        low, high = low_and_high(tl.load(tables + row, mask=wanted, other=0))
        v = ga * low + gb * high
        # a weight is linear along each axis: its slope is the weight with that axis' factor replaced by +1 or -1
        sx += (2 * (corner // 4) - 1) * v * weight_of(one * (corner // 4), fy, fz, corner)
        sy += (2 * (corner // 2 % 2) - 1) * v * weight_of(fx, one * (corner // 2 % 2), fz, corner)
        sz += (2 * (corner % 2) - 1) * v * weight_of(fx, fy, one * (corner % 2), corner)
    scale = resolution.to(tl.float32)
    tl.store(out + 3 * s, tl.sum(sx * scale, 1), mask=s < n)
    tl.store(out + 3 * s + 1, tl.sum(sy * scale, 1), mask=s < n)
    tl.store(out + 3 * s + 2, tl.sum(sz * scale, 1), mask=s < n)


class _HashEncode(Function):
    @staticmethod
    def forward(ctx, unit: Tensor, tables: Tensor, resolutions: tuple[int, ...]) -> Tensor:  # type: ignore[no-untyped-def]
        unit = unit.contiguous()
        n, count, size = len(unit), len(resolutions), tables.shape[1]
        levels = level_table(resolutions, size, unit.device)
        out = unit.new_empty(n, 2 * count)
        shape = {"L": count, "LP": padded_levels(count), "BLOCK": BLOCK}
        _encode[(triton.cdiv(n, BLOCK),)](unit, words(tables), levels, out, n, size, **shape)
        ctx.save_for_backward(unit, tables, levels)
        ctx.shape = shape
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:  # type: ignore[no-untyped-def]
        unit, tables, levels = ctx.saved_tensors
        n, size, grad = len(unit), tables.shape[1], grad.contiguous()
        grid, to_unit, to_tables = (triton.cdiv(n, BLOCK),), None, None
        if ctx.needs_input_grad[0]:
            to_unit = torch.empty_like(unit)
            _encode_slope[grid](unit, words(tables), grad, levels, to_unit, n, size, **ctx.shape)
        if ctx.needs_input_grad[1]:
            to_tables = torch.zeros_like(tables, memory_format=torch.contiguous_format)
            _encode_backward[grid](unit, grad, levels, to_tables, n, size, **ctx.shape)
        return to_unit, to_tables, None


def hash_encode(unit: Tensor, tables: Tensor, resolutions: tuple[int, ...]) -> Tensor:
    """See `reference.hash_encode`; two features a level."""
    return _HashEncode.apply(unit, tables, tuple(resolutions))
