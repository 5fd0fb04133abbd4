"""What numba cannot say by itself: register-blocked products of small matrices, and pairs of floats in one register.

Written as LLVM vectors, so that they run on any processor; the tile is sized for its registers. Matrices are given by
address and strides in floats: C[r, c] (+)= sum_k A[r, k] B[k, c], with rows of B and C contiguous.
"""

from __future__ import annotations

import math
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

JIT: dict[str, Any] = {
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
}
LANES = 16 if llvm.get_host_cpu_features().get("avx512f") else 8
ROWS = 8 if LANES == 16 else 4  # ROWS * 2 accumulators, two rows of B and a broadcast fill the register file
PAD = 16  # every width is padded to a multiple of this many floats

_FLOAT, _INT, _DOUBLE = ir.FloatType(), ir.IntType(64), ir.DoubleType()
_FUSE = ("contract",)


def _int(value: int) -> ir.Constant:
    return ir.Constant(_INT, value)


def _splat(builder: Any, value: Any, lanes: int) -> Any:
    """A vector that holds ``value`` in every lane."""
    vector = ir.VectorType(_FLOAT, lanes)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    lane_zero = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), lane_zero)


def _at(builder: Any, base: Any, floats: Any, kind: Any) -> Any:
    """The address of a float, counted from ``base``, as a pointer to ``kind``."""
    return builder.inttoptr(builder.add(base, builder.mul(floats, _int(4))), kind.as_pointer())


def _tile(rows: int, vectors: int, accumulate: bool) -> Any:
    """An intrinsic that computes ``rows`` x (``vectors`` * LANES) entries of C, held in registers over the sum."""
    vec = ir.VectorType(_FLOAT, LANES)
    cells = [(r, v) for r in range(rows) for v in range(vectors)]

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        a, a_row, a_k, b, b_k, c, c_row, n = args
        places = {
            (r, v): _at(builder, c, builder.add(builder.mul(c_row, _int(r)), _int(v * LANES)), vec) for r, v in cells
        }
        zero = ir.Constant(vec, [0.0] * LANES)
        before = {rv: builder.load(places[rv], align=4) if accumulate else zero for rv in cells}
        entry = builder.block
        loop, done = builder.append_basic_block("sum"), builder.append_basic_block("done")
        builder.cbranch(builder.icmp_signed(">", n, _int(0)), loop, done)

        builder.position_at_end(loop)
        k = builder.phi(_INT)
        k.add_incoming(_int(0), entry)
        sums = {rv: builder.phi(vec) for rv in cells}
        row_of_b, column_of_a = builder.mul(k, b_k), builder.mul(k, a_k)
        bs = [
            builder.load(_at(builder, b, builder.add(row_of_b, _int(v * LANES)), vec), align=4) for v in range(vectors)
        ]
        after = {}
        for r in range(rows):
            where = builder.add(column_of_a, builder.mul(a_row, _int(r)))
            factor = _splat(builder, builder.load(_at(builder, a, where, _FLOAT), align=4), LANES)
            for v in range(vectors):
                product = builder.fmul(factor, bs[v], flags=_FUSE)
                after[r, v] = builder.fadd(sums[r, v], product, flags=_FUSE)
        following = builder.add(k, _int(1))
        k.add_incoming(following, loop)
        for rv in cells:
            sums[rv].add_incoming(before[rv], entry)
            sums[rv].add_incoming(after[rv], loop)
        builder.cbranch(builder.icmp_signed("<", following, n), loop, done)

        builder.position_at_end(done)
        results = {rv: builder.phi(vec) for rv in cells}
        for rv in cells:
            results[rv].add_incoming(before[rv], entry)
            results[rv].add_incoming(after[rv], loop)
        for rv in cells:
            builder.store(results[rv], places[rv], align=4)
        return context.get_dummy_value()

    @intrinsic
    def tile(typing: Any, a: Any, a_row: Any, a_k: Any, b: Any, b_k: Any, c: Any, c_row: Any, n: Any) -> Any:
        return types.void(*[types.intp] * 8), codegen

    return tile


_wide, _narrow = _tile(ROWS, 2, False), _tile(ROWS, 1, False)
_wide_more, _narrow_more = _tile(ROWS, 2, True), _tile(ROWS, 1, True)


@njit(**JIT)
def product(a, a_row, a_k, b, b_k, c, c_row, rows, columns, n):  # type: ignore[no-untyped-def]
    """C = A B for addresses a, b, c and strides in floats; rows and columns must be multiples of 8 and PAD."""
    for column in range(0, columns, 2 * LANES):
        if columns - column >= 2 * LANES:
            for r in range(0, rows, ROWS):
                _wide(a + 4 * r * a_row, a_row, a_k, b + 4 * column, b_k, c + 4 * (r * c_row + column), c_row, n)
        else:
            for r in range(0, rows, ROWS):
                _narrow(a + 4 * r * a_row, a_row, a_k, b + 4 * column, b_k, c + 4 * (r * c_row + column), c_row, n)


@njit(**JIT)
def add_product(a, a_row, a_k, b, b_k, c, c_row, rows, columns, n):  # type: ignore[no-untyped-def]
    """C += A B, as :func:`product`."""
    for column in range(0, columns, 2 * LANES):
        if columns - column >= 2 * LANES:
            for r in range(0, rows, ROWS):
                _wide_more(a + 4 * r * a_row, a_row, a_k, b + 4 * column, b_k, c + 4 * (r * c_row + column), c_row, n)
        else:
            for r in range(0, rows, ROWS):
                _narrow_more(a + 4 * r * a_row, a_row, a_k, b + 4 * column, b_k, c + 4 * (r * c_row + column), c_row, n)


def _make_bits_to_float(typing: Any, bits: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], _FLOAT)

    return types.float32(types.int32), codegen


_bits_to_float: Any = intrinsic(_make_bits_to_float)


@njit(forceinline=True, **JIT)
def exp(x):  # type: ignore[no-untyped-def]
    """e^x in single precision, two units in the last place; unlike libm's, loops over it become vectors."""
    f = np.float32
    x = min(max(x, f(-87)), f(88))
    whole = np.float32(math.floor(x * f(1.44269504088896341) + f(0.5)))
    r = x - whole * f(0.693359375) + whole * f(2.12194440e-4)  # ln 2 in two parts (Cody and Waite)
    p = f(1.9875691500e-4) * r + f(1.3981999507e-3)
    p = p * r + f(8.3334519073e-3)
    p = p * r + f(4.1665795894e-2)
    p = p * r + f(1.6666665459e-1)
    p = p * r + f(5.0000001201e-1)
    return (p * r * r + r + f(1)) * _bits_to_float((np.int32(whole) + np.int32(127)) << np.int32(23))


def _make_fma_pair(typing: Any, total: Any, factor: Any, pair: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        two = ir.VectorType(_FLOAT, 2)
        total, factor, pair = args
        product = builder.fmul(_splat(builder, factor, 2), builder.bitcast(pair, two), flags=_FUSE)
        return builder.bitcast(builder.fadd(builder.bitcast(total, two), product, flags=_FUSE), _DOUBLE)

    return types.float64(types.float64, types.float32, types.float64), codegen


fma_pair: Any = intrinsic(_make_fma_pair)
"""total + factor * pair, where ``total`` and ``pair`` are two float32 in the bits of a float64"""
