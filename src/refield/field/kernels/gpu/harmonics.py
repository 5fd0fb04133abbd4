"""Spherical harmonics inside a Triton kernel."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def harmonics(x, y, z):  # type: ignore[no-untyped-def]
    """`reference.spherical_harmonics` of directions (B,) x 3 -> (B, 16).

    Column by column into its place: sixteen that are joined in four steps are a shape that Triton 3.6 cannot hand to a
    product of matrices on Hopper.
    """
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    column = tl.arange(0, 16)[None, :]
    out = tl.zeros((x.shape[0], 16), tl.float32) + 0.28209479177387814
    out = tl.where(column == 1, (-0.4886025119029199 * y)[:, None], out)
    out = tl.where(column == 2, (0.4886025119029199 * z)[:, None], out)
    out = tl.where(column == 3, (-0.4886025119029199 * x)[:, None], out)
    out = tl.where(column == 4, (1.0925484305920792 * xy)[:, None], out)
    out = tl.where(column == 5, (-1.0925484305920792 * yz)[:, None], out)
    out = tl.where(column == 6, (0.9461746957575601 * zz - 0.31539156525251999)[:, None], out)
    out = tl.where(column == 7, (-1.0925484305920792 * xz)[:, None], out)
    out = tl.where(column == 8, (0.5462742152960396 * (xx - yy))[:, None], out)
    out = tl.where(column == 9, (0.5900435899266435 * y * (-3 * xx + yy))[:, None], out)
    out = tl.where(column == 10, (2.890611442640554 * xy * z)[:, None], out)
    out = tl.where(column == 11, (0.4570457994644657 * y * (1 - 5 * zz))[:, None], out)
    out = tl.where(column == 12, (0.3731763325901154 * z * (5 * zz - 3))[:, None], out)
    out = tl.where(column == 13, (0.4570457994644657 * x * (1 - 5 * zz))[:, None], out)
    out = tl.where(column == 14, (1.445305721320277 * z * (xx - yy))[:, None], out)
    out = tl.where(column == 15, (0.5900435899266435 * x * (-xx + 3 * yy))[:, None], out)
    return out
