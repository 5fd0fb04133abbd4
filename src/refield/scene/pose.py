"""Rigid motions, SE(3), as (..., 4, 4) float64 tensors.

Names read ``a_from_b`` and chain where the inner names meet: ``world_from_cam @ cam_from_object``.
The paper's T (§4) is ``new_from_old``; its inverse is ``old_from_new``.
Twists are (..., 6): translation part rho first, then the rotation vector phi (radians).
"""

from __future__ import annotations

import torch
from torch import Tensor

_SMALL = 1e-4  # below this angle the closed forms lose digits in float64, the series do not


def skew(v: Tensor) -> Tensor:
    """(..., 3) -> (..., 3, 3) with ``skew(v) @ u == cross(v, u)``."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*v.shape[:-1], 3, 3)


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Assemble (..., 3, 3) and (..., 3) into (..., 4, 4)."""
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 0, 3] = 1.0
    return torch.cat([top, bottom], -2)


def invert(a_from_b: Tensor) -> Tensor:
    """``b_from_a``, using that the rotation's inverse is its transpose."""
    r_t = a_from_b[..., :3, :3].transpose(-1, -2)
    return rigid(r_t, -(r_t @ a_from_b[..., :3, 3:])[..., 0])


def transform(a_from_b: Tensor, points_b: Tensor) -> Tensor:
    """Move points (..., 3) from frame b to frame a, in the points' own dtype.

    One pose (4, 4) moves any number of points; many poses (..., 4, 4) go with the points' leading dimensions.
    """
    m = a_from_b.to(points_b.dtype)
    if m.ndim == 2:
        return points_b @ m[:3, :3].T + m[:3, 3]
    return (m[..., :3, :3] @ points_b[..., None])[..., 0] + m[..., :3, 3]


def rotate(a_from_b: Tensor, directions_b: Tensor) -> Tensor:
    """Turn directions (..., 3) from frame b to frame a, as `transform` moves points."""
    m = a_from_b.to(directions_b.dtype)
    if m.ndim == 2:
        return directions_b @ m[:3, :3].T
    return (m[..., :3, :3] @ directions_b[..., None])[..., 0]


def _coefficients(theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(t)/t, (1-cos(t))/t², (t-sin(t))/t³, stable at zero."""
    small = theta < _SMALL
    t = torch.where(small, torch.ones_like(theta), theta)
    t2 = theta * theta
    a = torch.where(small, 1 - t2 / 6, torch.sin(t) / t)
    b = torch.where(small, 0.5 - t2 / 24, (1 - torch.cos(t)) / t**2)
    c = torch.where(small, 1 / 6 - t2 / 120, (t - torch.sin(t)) / t**3)
    return a[..., None, None], b[..., None, None], c[..., None, None]


def exp(twist: Tensor) -> Tensor:
    """SE(3) exponential: twist (..., 6) -> (..., 4, 4)."""
    rho, phi = twist[..., :3], twist[..., 3:]
    k = skew(phi)
    a, b, c = _coefficients(phi.norm(dim=-1))
    eye = torch.eye(3, dtype=twist.dtype, device=twist.device)
    rotation = eye + a * k + b * (k @ k)
    left_jacobian = eye + b * k + c * (k @ k)
    return rigid(rotation, (left_jacobian @ rho[..., None])[..., 0])


def rotation_log(rotation: Tensor) -> Tensor:
    """(..., 3, 3) -> rotation vector (..., 3), angle in [0, pi]; stable at both ends (by the quaternion)."""
    q = _quaternion(rotation)
    w, v = q[..., :1], q[..., 1:]
    n = v.norm(dim=-1, keepdim=True)
    scale = torch.where(n < 1e-12, 2.0 / w.clamp_min(0.5), 2.0 * torch.atan2(n, w) / n.clamp_min(1e-300))
    return v * scale


def _quaternion(r: Tensor) -> Tensor:
    """Unit quaternion (..., 4) wxyz with w >= 0, from the best-conditioned of four forms."""
    d = r.diagonal(dim1=-2, dim2=-1)
    tr = d.sum(-1)
    x, y, z = d.unbind(-1)
    squares = torch.stack([1 + tr, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], -1)
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    e, f, g = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    s = squares.unbind(-1)
    rows = [
        torch.stack([s[0], a, b, c], -1),
        torch.stack([a, s[1], e, f], -1),
        torch.stack([b, e, s[2], g], -1),
        torch.stack([c, f, g, s[3]], -1),
    ]
    table = torch.stack(rows, -2)
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    q = table.gather(-2, best)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def log(a_from_b: Tensor) -> Tensor:
    """SE(3) logarithm: (..., 4, 4) -> twist (..., 6)."""
    phi = rotation_log(a_from_b[..., :3, :3])
    k = skew(phi)
    _, b, c = _coefficients(phi.norm(dim=-1))
    eye = torch.eye(3, dtype=k.dtype, device=k.device)
    left_jacobian = eye + b * k + c * (k @ k)
    rho = torch.linalg.solve(left_jacobian, a_from_b[..., :3, 3:])[..., 0]
    return torch.cat([rho, phi], -1)


def adjoint(a_from_b: Tensor) -> Tensor:
    """(6, 6): a twist in frame b -> the same motion's twist in frame a, ``T exp(t) T^-1 == exp(adjoint(T) t)``."""
    r = a_from_b[:3, :3]
    top = torch.cat([r, skew(a_from_b[:3, 3]) @ r], 1)
    return torch.cat([top, torch.cat([torch.zeros_like(r), r], 1)])


def angle_between(r1: Tensor, r2: Tensor) -> Tensor:
    """Angle in degrees between the rotations of two (..., 3|4, 3|4) poses."""
    relative = r1[..., :3, :3].transpose(-1, -2) @ r2[..., :3, :3]
    return torch.rad2deg(rotation_log(relative).norm(dim=-1))


def nearest_rotation(matrix: Tensor) -> Tensor:
    """The rotation closest to a (..., 3, 3) matrix (Frobenius norm), by SVD."""
    u, _, vt = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vt)
    fix = torch.ones_like(u[..., 0, :])
    fix[..., 2] = sign
    return (u * fix[..., None, :]) @ vt
