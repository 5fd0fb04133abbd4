"""The two small networks of a hash field, fused: a block of samples goes through all layers while it is in the cache.

Matrices are kept sample by sample, widths padded to `simd.PAD`, so that every product of the forward and the backward
pass has the one shape of `simd.product` and nothing is ever transposed. Letters: S samples, H the hidden width, K
geometry features, D = 1 + K outputs of the density network, C columns that enter the colour network. These are the
density network's D outputs, of which the first (the raw density) meets a column of zeros, then 16 spherical harmonics.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd import Function

from refield.field.kernels import reference
from refield.field.kernels.cpu.encoding import array, encode, encode_backward, hash_encode, pairs, parts_of
from refield.field.kernels.cpu.rays import harmonics_of, spherical_harmonics
from refield.field.kernels.cpu.simd import JIT, PAD, add_product, exp, product
from refield.field.kernels.reference import Networks

BLOCK = 128  # samples whose activations are held at once: some 60 KB
_GROUPS = 16  # partial sums of the networks' gradients; a fixed number, so that results do not depend on the threads
_ZERO, _ONE = np.float32(0), np.float32(1)


def padded(width: int) -> int:
    return -(-width // PAD) * PAD


def pack(networks: Networks) -> tuple[np.ndarray, ...]:
    """Padded copies of the five matrices, each transposed (for the forward pass) and as it is (for the backward)."""
    density_in, density_out, colour_in, colour_mid, colour_out = (w.detach() for w in networks)
    colour_in = torch.nn.functional.pad(colour_in, (1, 0))  # the raw density does not enter the colour network
    out: list[np.ndarray] = []
    for w in (density_in, density_out, colour_in, colour_mid, colour_out):
        full = torch.zeros(padded(w.shape[0]), padded(w.shape[1]))
        full[: w.shape[0], : w.shape[1]] = w
        out += [full.T.contiguous().numpy(), full.numpy()]
    return tuple(out)


def unpack(sums: tuple[np.ndarray, ...], networks: Networks) -> list[Tensor]:
    """Gradients of the five matrices from padded sums."""
    grads = [torch.from_numpy(s) for s in sums]
    grads[2] = grads[2][:, 1:]
    return [g[: w.shape[0], : w.shape[1]].contiguous() for g, w in zip(grads, networks)]


@njit(**JIT)
def room_for(samples, packed):  # type: ignore[no-untyped-def]
    """Scratch for the activations of so many samples, in the order in which they come about."""
    rows = (samples + 7) // 8 * 8
    features, hidden = packed[0].shape
    entering, mid = packed[4].shape
    return (
        np.zeros((rows, features), np.float32),
        np.zeros((rows, hidden), np.float32),
        np.zeros((rows, entering), np.float32),
        np.zeros((rows, mid), np.float32),
        np.zeros((rows, packed[6].shape[1]), np.float32),
        np.zeros((rows, packed[8].shape[1]), np.float32),
    )


@njit(forceinline=True, **JIT)
def _layer(x, w, y, rows, n):  # type: ignore[no-untyped-def]
    """y = x w over the first n columns of x."""
    product(x.ctypes.data, x.shape[1], 1, w.ctypes.data, w.shape[1], y.ctypes.data, y.shape[1], rows, w.shape[1], n)


@njit(forceinline=True, **JIT)
def _weight_gradient(to_y, x, into, rows):  # type: ignore[no-untyped-def]
    """into += to_y^T x."""
    add_product(
        to_y.ctypes.data, 1, to_y.shape[1], x.ctypes.data, x.shape[1],
        into.ctypes.data, into.shape[1], into.shape[0], into.shape[1], rows,
    )  # fmt: skip


@njit(**JIT)
def _relu(x, rows):  # type: ignore[no-untyped-def]
    flat = x.reshape(-1)
    for i in range(rows * x.shape[1]):
        flat[i] = max(flat[i], _ZERO)


@njit(**JIT)
def _relu_backward(y, to_y, rows):  # type: ignore[no-untyped-def]
    a, b = y.reshape(-1), to_y.reshape(-1)
    for i in range(rows * y.shape[1]):
        b[i] = b[i] if a[i] > 0 else _ZERO


@njit(**JIT)
def forward_block(features, directions, sizes, packed, room):  # type: ignore[no-untyped-def]
    """The activations of a block into ``room``: features (n, F), directions (n, 3); sizes (F, D, H).

    After it ``room[2][:, 0]`` is the raw density and ``room[5][:, :3]`` the colour.
    """
    x, hidden, entering, c1, c2, rgb = room
    f, d, h = sizes
    n = features.shape[0]
    rows = (n + 7) // 8 * 8
    for s in range(n):
        for i in range(f):
            x[s, i] = features[s, i]
    _layer(x, packed[0], hidden, rows, f)
    _relu(hidden, rows)
    _layer(hidden, packed[2], entering, rows, h)
    for s in range(n):
        harmonics_of(directions[s, 0], directions[s, 1], directions[s, 2], entering[s, d : d + 16])
    _layer(entering, packed[4], c1, rows, d + 16)
    _relu(c1, rows)
    _layer(c1, packed[6], c2, rows, h)
    _relu(c2, rows)
    _layer(c2, packed[8], rgb, rows, h)
    flat = rgb.reshape(-1)  # the padding's columns too: it is one run of vectors
    for i in range(rows * rgb.shape[1]):
        flat[i] = _ONE / (_ONE + exp(-flat[i]))


@njit(**JIT)
def backward_block(to_raw, to_rgb, sizes, packed, room, back, sums, to_features):  # type: ignore[no-untyped-def]
    """Gradients of the block last seen by :func:`forward_block`.

    to_raw (n,), to_rgb (n, 3) come in; ``sums`` are added to and to_features (n, F) is written. ``back`` is scratch
    of the same shape as ``room``.
    """
    x, hidden, entering, c1, c2, rgb = room
    to_x, to_hidden, to_entering, to_c1, to_c2, to_out = back
    f, d, _ = sizes
    n = len(to_raw)
    rows = (n + 7) // 8 * 8
    for s in range(rows):
        for i in range(to_out.shape[1]):
            to_out[s, i] = 0
    for s in range(n):
        for i in range(3):
            to_out[s, i] = to_rgb[s, i] * rgb[s, i] * (_ONE - rgb[s, i])
    _weight_gradient(to_out, c2, sums[4], rows)
    _layer(to_out, packed[9], to_c2, rows, 3)
    _relu_backward(c2, to_c2, rows)
    _weight_gradient(to_c2, c1, sums[3], rows)
    _layer(to_c2, packed[7], to_c1, rows, c2.shape[1])
    _relu_backward(c1, to_c1, rows)
    _weight_gradient(to_c1, entering, sums[2], rows)
    wide = packed[3].shape[0]
    product(
        to_c1.ctypes.data, to_c1.shape[1], 1, packed[5].ctypes.data, packed[5].shape[1],
        to_entering.ctypes.data, to_entering.shape[1], rows, wide, c1.shape[1],
    )  # fmt: skip
    for s in range(rows):
        for i in range(d, wide):
            to_entering[s, i] = 0
        to_entering[s, 0] = to_raw[s] if s < n else _ZERO
    add_product(
        to_entering.ctypes.data, 1, to_entering.shape[1], hidden.ctypes.data, hidden.shape[1],
        sums[1].ctypes.data, sums[1].shape[1], sums[1].shape[0], sums[1].shape[1], rows,
    )  # fmt: skip
    _layer(to_entering, packed[3], to_hidden, rows, d)
    _relu_backward(hidden, to_hidden, rows)
    _weight_gradient(to_hidden, x, sums[0], rows)
    _layer(to_hidden, packed[1], to_x, rows, hidden.shape[1])
    for s in range(n):
        for i in range(f):
            to_features[s, i] = to_x[s, i]


# What a thread does is compiled by itself: numba's analysis of parallel loops is slow, and sees a call only.


@njit(**JIT)
def _forward_part(begin, end, features, directions, sizes, packed, raw, rgb):  # type: ignore[no-untyped-def]
    room = room_for(BLOCK, packed)
    for first in range(begin, end, BLOCK):
        last = min(end, first + BLOCK)
        forward_block(features[first:last], directions[first:last], sizes, packed, room)
        for s in range(last - first):
            raw[first + s] = room[2][s, 0]
            for i in range(3):
                rgb[first + s, i] = room[5][s, i]


@njit(parallel=True, **JIT)
def forward_all(features, directions, sizes, packed, raw, rgb):  # type: ignore[no-untyped-def]
    """Features (S, F) and directions (S, 3) -> raw densities (S,) and colours (S, 3)."""
    n = len(raw)
    for g in prange(_GROUPS):
        _forward_part(n * g // _GROUPS, n * (g + 1) // _GROUPS, features, directions, sizes, packed, raw, rgb)


@njit(**JIT)
def _backward_part(begin, end, inputs, sizes, packed, to_raw, to_rgb, to_features, sums):  # type: ignore[no-untyped-def]
    features, directions = inputs
    room, back = room_for(BLOCK, packed), room_for(BLOCK, packed)
    for first in range(begin, end, BLOCK):
        last = min(end, first + BLOCK)
        forward_block(features[first:last], directions[first:last], sizes, packed, room)
        backward_block(to_raw[first:last], to_rgb[first:last], sizes, packed, room, back, sums, to_features[first:last])


@njit(parallel=True, **JIT)
def _backward(inputs, sizes, packed, to_raw, to_rgb, to_features, all_sums):  # type: ignore[no-untyped-def]
    n = len(to_raw)
    for g in prange(_GROUPS):
        sums = (all_sums[0][g], all_sums[1][g], all_sums[2][g], all_sums[3][g], all_sums[4][g])
        begin, end = n * g // _GROUPS, n * (g + 1) // _GROUPS
        _backward_part(begin, end, inputs, sizes, packed, to_raw, to_rgb, to_features, sums)


def sizes_of(networks: Networks) -> tuple[int, int, int]:
    """F features, D outputs of the density network, H hidden."""
    return networks[0].shape[1], networks[1].shape[0], networks[0].shape[0]


def group_sums(packed: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Zeros for the partial sums of each group."""
    return tuple(np.zeros((_GROUPS, *packed[i].shape), np.float32) for i in (1, 3, 5, 7, 9))


class _HashField(Function):
    @staticmethod
    def forward(ctx, unit, d, tables, resolutions, *networks):  # type: ignore[no-untyped-def]
        res = np.asarray(resolutions, np.int32)
        features = np.empty((len(unit), 2 * len(res)), np.float32)
        encode(array(unit), pairs(tables), res, features.view(np.float64), parts_of(len(unit)))
        raw, rgb = torch.empty(len(unit)), torch.empty(len(unit), 3)
        forward_all(features, array(d), sizes_of(networks), pack(networks), raw.numpy(), rgb.numpy())
        ctx.save_for_backward(unit, d, tables, *networks)
        ctx.features, ctx.resolutions = features, res
        return raw, rgb

    @staticmethod
    def backward(ctx, to_raw, to_rgb):  # type: ignore[no-untyped-def]
        unit, d, tables, *networks = ctx.saved_tensors
        packed = pack(networks)
        sums = group_sums(packed)
        to_features = np.empty_like(ctx.features)
        _backward((ctx.features, array(d)), sizes_of(networks), packed, array(to_raw), array(to_rgb), to_features, sums)
        to_tables = torch.zeros(tables.shape)
        encode_backward(array(unit), to_features.view(np.float64), ctx.resolutions, pairs(to_tables))
        return None, None, to_tables, None, *unpack(tuple(s.sum(0) for s in sums), networks)


def hash_field(
    unit: Tensor, d: Tensor, tables: Tensor, resolutions: tuple[int, ...], networks: Networks
) -> tuple[Tensor, Tensor]:
    """See `reference.hash_field`; fused unless a gradient to the position or the direction is wanted."""
    if torch.is_grad_enabled() and (unit.requires_grad or d.requires_grad):
        features = hash_encode(unit, tables, resolutions)
        return reference.through_networks(features, spherical_harmonics(d), networks)
    return _HashField.apply(unit.contiguous(), d.contiguous(), tables, resolutions, *networks)
