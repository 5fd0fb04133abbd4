"""The whole field in one Triton kernel: hash encoding, density network, colour network; and its backward pass.

A block of samples stays on the chip from its features to its colour. The backward pass computes the activations anew,
which is cheaper than to keep 150 numbers a sample, but not the features: those cost 80 gathers a sample, and to keep
them 80 bytes. Its programs stay for many blocks each and hold the networks' gradients in registers until the end, where
each writes its own row of a buffer that is summed: no atomics and the same sum every time. Only the tables' gradients
are scattered with atomics.

Letters: S samples, B of a block, L levels, H width, K geometry features; P behind a letter is its padding for tl.dot.
The colour network's first layer is taken as two, over the density network's K + 1 outputs (the raw density times zero)
and over the 16 harmonics, so that nothing is cut or joined along columns.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd import Function
from torch.nn import functional

from refield.field.kernels import reference
from refield.field.kernels.gpu.encoding import encoded, hash_encode, level_table, padded_levels, place, scatter, words
from refield.field.kernels.gpu.harmonics import harmonics
from refield.field.kernels.reference import DensityNet, Networks

Precision = Literal["tf32", "tf32x3", "ieee", "bf16"]
"""of the factors in the networks' products; sums are float32. fp16 is left out: the gradients of a mean underflow it"""

_FORWARD = {"BLOCK": 64, "num_warps": 4}  # with 8 warps for 64 rows, colours are wrong on Hopper
_BACKWARD = {"BLOCK": 64, "num_warps": 4, "num_stages": 1}
_PROGRAMS_PER_SM = 2  # of the backward pass; as many as its registers let live at once


@triton.jit
def dot(a, b, PRECISION: tl.constexpr):  # type: ignore[no-untyped-def]
    """a @ b, summed in float32."""
    if PRECISION == "bf16":
        return tl.dot(a.to(tl.bfloat16), b.to(tl.bfloat16))
    else:
        return tl.dot(a, b, input_precision=PRECISION)


@triton.jit
def relu(x):  # type: ignore[no-untyped-def]
    """max(x, 0), where NaN stays NaN: a plain maximum would hide that a fit has gone wrong."""
    return tl.maximum(x, 0.0, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
def raw_density(features, hidden_in, out):  # type: ignore[no-untyped-def]
    """The density alone, (B, 2 LP) -> (B,), from matrices (HP, 2 LP) and (1, HP); in full precision.

    Where a ray ends hangs on an exponential of it.
    """
    return tl.sum(relu(dot(features, tl.trans(hidden_in), "tf32x3")) * out, 1)


@triton.jit
def matrix(w, stride, rows, columns: tl.constexpr, RP: tl.constexpr, CP: tl.constexpr):  # type: ignore[no-untyped-def]
    """(rows, columns) of a row-major matrix, padded with zeros to (RP, CP)."""
    r, c = tl.arange(0, RP)[:, None], tl.arange(0, CP)[None, :]
    return tl.load(w + r * stride + c, mask=(r < rows) & (c < columns), other=0.0)


@triton.jit
def _weights(w0, w1, w2, w3, w4, L: tl.constexpr, H: tl.constexpr, K: tl.constexpr,  # type: ignore[no-untyped-def]
             FP: tl.constexpr, HP: tl.constexpr, KP: tl.constexpr):  # fmt: skip
    """The networks' matrices; the third as its two halves, the first of which starts with a column of zeros."""
    density_in = matrix(w0, 2 * L, H, 2 * L, HP, FP)
    density_out = matrix(w1, H, 1 + K, H, KP, HP)
    r, c = tl.arange(0, HP)[:, None], tl.arange(0, KP)[None, :]
    colour_geo = tl.load(w2 + r * (K + 16) + c - 1, mask=(r < H) & (c > 0) & (c <= K), other=0.0)
    colour_dir = matrix(w2 + K, K + 16, H, 16, HP, 16)
    colour_mid = matrix(w3, H, H, H, HP, HP)
    colour_out = matrix(w4, H, 3, H, 16, HP)
    return density_in, density_out, colour_geo, colour_dir, colour_mid, colour_out


@triton.jit
def _density(features, density_in, density_out, PRECISION: tl.constexpr):  # type: ignore[no-untyped-def]
    """Hidden (B, HP) and output (B, KP) of the density network."""
    hidden = relu(dot(features, tl.trans(density_in), PRECISION))
    return hidden, dot(hidden, tl.trans(density_out), PRECISION)


@triton.jit
def _colour(out, sh, geo, direction, mid, last, PRECISION: tl.constexpr):  # type: ignore[no-untyped-def]
    """Both hidden layers (B, HP) and the colour (B, 16), of which three columns count."""
    one = relu(dot(out, tl.trans(geo), PRECISION) + dot(sh, tl.trans(direction), PRECISION))
    two = relu(dot(one, tl.trans(mid), PRECISION))
    x = dot(two, tl.trans(last), PRECISION)
    small = tl.exp(-tl.abs(x))  # never overflows
    return one, two, tl.where(x < 0, small, 1.0) / (1 + small)


@triton.jit
def _forward(unit, d, tables, levels, w0, w1, w2, w3, w4, features, raw, rgb, n, size,  # type: ignore[no-untyped-def]
             L: tl.constexpr, H: tl.constexpr, K: tl.constexpr, LP: tl.constexpr, HP: tl.constexpr, KP: tl.constexpr,
             PRECISION: tl.constexpr, KEEP: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    s = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = s < n
    x, y, z = place(unit, s, inside)
    f = encoded(x, y, z, inside, tables, levels, size, L, LP)
    if KEEP:
        column = tl.arange(0, 2 * LP)[None, :]
        tl.store(features + s[:, None] * (2 * L) + column, f, mask=inside[:, None] & (column < 2 * L))
    density_in, density_out, geo, direction, mid, last = _weights(w0, w1, w2, w3, w4, L, H, K, 2 * LP, HP, KP)
    _, out = _density(f, density_in, density_out, PRECISION)
    x, y, z = place(d, s, inside)
    _, _, colour = _colour(out, harmonics(x, y, z), geo, direction, mid, last, PRECISION)
    column = tl.arange(0, KP)[None, :]
    tl.store(raw + s[:, None] + column, out, mask=inside[:, None] & (column < 1))
    column = tl.arange(0, 16)[None, :]
    tl.store(rgb + 3 * s[:, None] + column, colour, mask=inside[:, None] & (column < 3))


@triton.jit
def _backward(unit, d, levels, w0, w1, w2, w3, w4, features, to_raw, to_rgb, into, partial, n, size,  # type: ignore[no-untyped-def]
              L: tl.constexpr, H: tl.constexpr, K: tl.constexpr, LP: tl.constexpr, HP: tl.constexpr, KP: tl.constexpr,
              PRECISION: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    density_in, density_out, geo, direction, mid, last = _weights(w0, w1, w2, w3, w4, L, H, K, 2 * LP, HP, KP)
    g_in = tl.zeros((HP, 2 * LP), tl.float32)
    g_out = tl.zeros((KP, HP), tl.float32)
    g_geo = tl.zeros((HP, KP), tl.float32)
    g_dir = tl.zeros((HP, 16), tl.float32)
    g_mid = tl.zeros((HP, HP), tl.float32)
    g_last = tl.zeros((16, HP), tl.float32)
    for block in range(tl.program_id(0), tl.cdiv(n, BLOCK), tl.num_programs(0)):
        s = block * BLOCK + tl.arange(0, BLOCK)
        inside = s < n
        f = matrix(features + block * BLOCK * 2 * L, 2 * L, n - block * BLOCK, 2 * L, BLOCK, 2 * LP)
        x, y, z = place(d, s, inside)
        sh = harmonics(x, y, z)
        hidden, out = _density(f, density_in, density_out, PRECISION)
        one, two, colour = _colour(out, sh, geo, direction, mid, last, PRECISION)
        column = tl.arange(0, 16)[None, :]
        g = tl.load(to_rgb + 3 * s[:, None] + column, mask=inside[:, None] & (column < 3), other=0.0)
        g = g * colour * (1 - colour)
        g_last += dot(tl.trans(g), two, PRECISION)
        g = tl.where(two > 0, dot(g, last, PRECISION), 0.0)
        g_mid += dot(tl.trans(g), one, PRECISION)
        g = tl.where(one > 0, dot(g, mid, PRECISION), 0.0)
        g_geo += dot(tl.trans(g), out, PRECISION)
        g_dir += dot(tl.trans(g), sh, PRECISION)
        density = tl.load(to_raw + s, mask=inside, other=0.0)[:, None]
        g = dot(g, geo, PRECISION) + tl.where(tl.arange(0, KP)[None, :] == 0, density, 0.0)
        g_out += dot(tl.trans(g), hidden, PRECISION)
        g = tl.where(hidden > 0, dot(g, density_out, PRECISION), 0.0)
        g_in += dot(tl.trans(g), f, PRECISION)
        x, y, z = place(unit, s, inside)
        scatter(x, y, z, inside, dot(g, density_in, PRECISION), into, levels, size, L, LP)
    row = partial + tl.program_id(0) * (H * 2 * L + (1 + K) * H + H * (K + 16) + H * H + 3 * H)
    _put(row, g_in, 2 * L, H, 2 * L, HP, 2 * LP)
    _put(row + H * 2 * L, g_out, H, 1 + K, H, KP, HP)
    row += H * 2 * L + (1 + K) * H
    r, c = tl.arange(0, HP)[:, None], tl.arange(0, KP)[None, :]
    tl.store(row + r * (K + 16) + c - 1, g_geo, mask=(r < H) & (c > 0) & (c <= K))
    _put(row + K, g_dir, K + 16, H, 16, HP, 16)
    _put(row + H * (K + 16), g_mid, H, H, H, HP, HP)
    _put(row + H * (K + 16) + H * H, g_last, H, 3, H, 16, HP)


@triton.jit
def _put(w, value, stride, rows: tl.constexpr, columns: tl.constexpr, RP: tl.constexpr, CP: tl.constexpr):  # type: ignore[no-untyped-def]
    """Inverse of `matrix`."""
    r, c = tl.arange(0, RP)[:, None], tl.arange(0, CP)[None, :]
    tl.store(w + r * stride + c, value, mask=(r < rows) & (c < columns))


@triton.jit
def _density_alone(unit, tables, levels, w_in, w_out, raw, n, size, L: tl.constexpr, LP: tl.constexpr,  # type: ignore[no-untyped-def]
                   H: tl.constexpr, HP: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    s = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y, z = place(unit, s, s < n)
    features = encoded(x, y, z, s < n, tables, levels, size, L, LP)
    h = tl.arange(0, HP)
    out = tl.load(w_out + h, mask=h < H, other=0.0)[None, :]
    tl.store(raw + s, raw_density(features, matrix(w_in, 2 * L, H, 2 * L, HP, 2 * LP), out), mask=s < n)


def hash_density(unit: Tensor, net: DensityNet) -> Tensor:
    """See `reference.hash_density`."""
    tables, resolutions, w_in, w_out = net
    n, size, width = len(unit), tables.shape[1], len(w_out)
    levels = level_table(tuple(resolutions), size, unit.device)
    matrices = (w_in.detach().contiguous(), w_out.detach().contiguous())
    raw = unit.new_empty(n)
    _density_alone[(triton.cdiv(n, _FORWARD["BLOCK"]),)](
        unit.detach().contiguous(), words(tables), levels, *matrices, raw, n, size,
        **density_shape(len(resolutions), width), **_FORWARD,
    )  # fmt: skip
    return raw


def density_shape(levels: int, width: int) -> dict[str, int]:
    """Sizes and padded sizes of the density network."""
    return {"L": levels, "LP": padded_levels(levels), "H": width, "HP": max(16, triton.next_power_of_2(width))}


def _shape(networks: tuple[Tensor, ...], levels: int) -> dict[str, int]:
    geometry = networks[1].shape[0] - 1
    return density_shape(levels, networks[0].shape[0]) | {
        "K": geometry,
        "KP": max(16, triton.next_power_of_2(1 + geometry)),
    }


def _programs(device: torch.device, blocks: int) -> int:
    """Of the backward pass; on the interpreter a few, so that each has several blocks there too."""
    if device.type != "cuda":
        return max(1, min(blocks, 3))
    return max(1, min(blocks, _PROGRAMS_PER_SM * torch.cuda.get_device_properties(device).multi_processor_count))


class _HashField(Function):
    @staticmethod
    def forward(ctx: Any, unit: Tensor, d: Tensor, tables: Tensor, resolutions: tuple[int, ...],
                precision: Precision, keep: bool, *networks: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
        unit, d = unit.contiguous(), d.contiguous()
        small = [w.detach().contiguous() for w in networks]
        n, size = len(unit), tables.shape[1]
        levels = level_table(resolutions, size, unit.device)
        ctx.shape = _shape(networks, len(resolutions)) | {"PRECISION": precision}
        features = unit.new_empty(n if keep else 0, 2 * len(resolutions))
        raw, rgb = unit.new_empty(n), unit.new_empty(n, 3)
        grid = (triton.cdiv(n, _FORWARD["BLOCK"]),)
        _forward[grid](
            unit, d, words(tables), levels, *small, features, raw, rgb, n, size, **ctx.shape, KEEP=keep, **_FORWARD
        )
        ctx.save_for_backward(unit, d, tables, levels, features, *networks)
        return raw, rgb

    @staticmethod
    def backward(ctx: Any, to_raw: Tensor, to_rgb: Tensor) -> tuple[Tensor | None, ...]:
        unit, d, tables, levels, features, *networks = ctx.saved_tensors
        small = [w.detach().contiguous() for w in networks]
        n, size = len(unit), tables.shape[1]
        into = torch.zeros_like(tables, memory_format=torch.contiguous_format)
        sizes = [w.numel() for w in small]
        programs = _programs(unit.device, triton.cdiv(n, _BACKWARD["BLOCK"]))
        partial = unit.new_empty(programs, sum(sizes))
        to_raw, to_rgb = to_raw.contiguous(), to_rgb.contiguous()
        _backward[(programs,)](
            unit, d, levels, *small, features, to_raw, to_rgb, into, partial, n, size, **ctx.shape, **_BACKWARD
        )
        parts = partial.sum(0).split(sizes)
        return None, None, into, None, None, None, *(p.view_as(w) for p, w in zip(parts, small))


def hash_field(
    unit: Tensor,
    d: Tensor,
    tables: Tensor,
    resolutions: tuple[int, ...],
    networks: Networks,
    precision: Precision = "tf32",
) -> tuple[Tensor, Tensor]:
    """Unit places (S, 3) in [0, 1], unit directions (S, 3) -> raw density (S,) before its exponential, rgb (S, 3).

    Differentiable in the tables (L, T, 2) and the networks. Where a gradient to the places or directions is wanted, the
    same is computed step by step.
    """
    wanted = torch.is_grad_enabled()
    if wanted and (unit.requires_grad or d.requires_grad):
        return _unfused(unit, d, tables, tuple(resolutions), networks)
    keep = wanted and any(w.requires_grad for w in (tables, *networks))
    return _HashField.apply(unit, d, tables, tuple(resolutions), precision, keep, *networks)


def _unfused(
    unit: Tensor, d: Tensor, tables: Tensor, resolutions: tuple[int, ...], networks: Networks
) -> tuple[Tensor, Tensor]:
    density_in, density_out, colour_in, colour_mid, colour_out = networks
    hidden = functional.relu(functional.linear(hash_encode(unit, tables, resolutions), density_in))
    out = functional.linear(hidden, density_out)
    c = torch.cat([out[:, 1:], reference.spherical_harmonics(d)], -1)
    c = functional.relu(functional.linear(c, colour_in))
    c = functional.relu(functional.linear(c, colour_mid))
    return out[:, 0], torch.sigmoid(functional.linear(c, colour_out))
