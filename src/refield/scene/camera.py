"""A pinhole camera with Brown distortion: pixels ⇄ rays ⇄ points.

Axes are OpenCV's: +x right, +y down, +z forward. The top-left pixel's centre is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

_UNDISTORT_STEPS = 12  # Newton; double precision is reached in 4-6 for the lenses we accept
_UNDISTORTED = 1e-10  # a step so small leaves an error of its square


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one view, in pixels. The distortion is OpenCV's (k1 k2 p1 p2, then k3)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def model(self) -> str:
        """COLMAP's name for the model."""
        return "OPENCV" if self.is_distorted else "PINHOLE"

    @property
    def is_distorted(self) -> bool:
        return any((self.k1, self.k2, self.p1, self.p2, self.k3))

    def shrunk(self, part: float) -> Camera:
        """The same lens on a sensor of so many times as many pixels a side, one at least."""
        return self.scaled(max(round(self.width * part), 1), max(round(self.height * part), 1))

    def within(self, most: int) -> Camera:
        """The same lens on a sensor of about so many pixels; of its own, if they are no more."""
        return self.shrunk(min(1.0, (most / (self.width * self.height)) ** 0.5))

    def scaled(self, width: int, height: int) -> Camera:
        """The same lens seen on a sensor resampled to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., 3) in camera axes -> pixels (..., 2) and z_depth (...,). Behind the camera z <= 0."""
        z = points_cam[..., 2]
        xy = points_cam[..., :2] / z.abs().clamp_min(1e-12)[..., None]
        xy = self._distort(xy) if self.is_distorted else xy
        return xy * xy.new_tensor([self.fx, self.fy]) + xy.new_tensor([self.cx, self.cy]), z

    def shows(self, pixels: Tensor, z: Tensor) -> Tensor:
        """Whether projected points, pixels (..., 2) and depths along the axis (...,), fall in the picture, (...,)."""
        size = pixels.new_tensor([self.width, self.height])
        return (z > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)

    def unproject(self, pixels: Tensor) -> Tensor:
        """Pixels (..., 2) -> unit directions (..., 3) in camera axes."""
        xy = (pixels - pixels.new_tensor([self.cx, self.cy])) / pixels.new_tensor([self.fx, self.fy])
        xy = self._undistort(xy) if self.is_distorted else xy
        d = torch.cat([xy, torch.ones_like(xy[..., :1])], -1)
        return d / d.norm(dim=-1, keepdim=True)

    def pixel_centres(self, device: torch.device | None = None) -> Tensor:
        """(height * width, 2) float64, row by row."""
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=torch.float64, device=device) + 0.5,
            torch.arange(self.width, dtype=torch.float64, device=device) + 0.5,
            indexing="ij",
        )
        return torch.stack([u, v], -1).reshape(-1, 2)

    def _distort(self, xy: Tensor) -> Tensor:
        x, y = xy.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        dx = 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        dy = self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return torch.stack([x * radial + dx, y * radial + dy], -1)

    def _undistort(self, distorted: Tensor) -> Tensor:
        """Invert :meth:`_distort` by Newton's method, in float64."""
        goal = distorted.double()
        xy = goal.clone()
        for _ in range(_UNDISTORT_STEPS):
            x, y = xy.unbind(-1)
            r2 = x * x + y * y
            radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
            slope = 2 * self.k1 + r2 * (4 * self.k2 + 6 * r2 * self.k3)  # d radial / d(r2) * 2
            j11 = radial + x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
            j22 = radial + y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
            j12 = x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
            e = self._distort(xy) - goal
            det = j11 * j22 - j12 * j12
            step_x = (j22 * e[..., 0] - j12 * e[..., 1]) / det
            step_y = (j11 * e[..., 1] - j12 * e[..., 0]) / det
            step = torch.stack([step_x, step_y], -1)
            xy = xy - step
            if not bool((step.abs() > _UNDISTORTED).any()):
                break
        return xy.to(distorted.dtype)
