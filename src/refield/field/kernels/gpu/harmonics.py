"""Spherical harmonics inside a Triton kernel."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def _four(a, b, c, d):  # type: ignore[no-untyped-def]
    """Four columns (B,) -> (B, 4). A join adds the last, fastest axis, so partners are those two columns apart."""
    return tl.reshape(tl.join(tl.join(a, c), tl.join(b, d)), (a.shape[0], 4))


@triton.jit
def harmonics(x, y, z):  # type: ignore[no-untyped-def]
    """`reference.spherical_harmonics` of directions (B,) x 3 -> (B, 16), each thread holding whole rows."""
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    # columns j, j + 4, j + 8, j + 12 together; interleaving the four groups then puts them in order
    a = _four(
        tl.zeros_like(x) + 0.28209479177387814,
        1.0925484305920792 * xy,
        0.5462742152960396 * (xx - yy),
        0.3731763325901154 * z * (5 * zz - 3),
    )
    b = _four(
        -0.4886025119029199 * y,
        -1.0925484305920792 * yz,
        0.5900435899266435 * y * (-3 * xx + yy),
        0.4570457994644657 * x * (1 - 5 * zz),
    )
    c = _four(
        0.4886025119029199 * z,
        0.9461746957575601 * zz - 0.31539156525251999,
        2.890611442640554 * xy * z,
        1.445305721320277 * z * (xx - yy),
    )
    d = _four(
        -0.4886025119029199 * x,
        -1.0925484305920792 * xz,
        0.4570457994644657 * y * (1 - 5 * zz),
        0.5900435899266435 * x * (-xx + 3 * yy),
    )
    return tl.reshape(tl.join(tl.join(a, c), tl.join(b, d)), (x.shape[0], 16))
