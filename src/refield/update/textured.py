"""A part of a plane with a texture: the ground that an object stood on, as the new photos show it.

A helper learns a volume, and few photos agree on many of those. A plane that is known leaves only its colours open.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from refield.scene.capture import Rays

_ALONG = 1e-3  # a ray is along the plane if its direction's component across it is smaller


@dataclass(frozen=True)
class TexturedPlane:
    """Opaque from a plane down to some depth, where its texels are known; nothing is right above them.

    Letters: (U, V) texels, N points or rays.
    """

    normal: Tensor
    """(3,) float32 unit, to the side that it is seen from"""
    origin: Tensor
    """(3,) float32 world: the centre of texel (0, 0)"""
    axes: Tensor
    """(2, 3) float32 unit, in the plane, along U and V"""
    texel: float
    """world units"""
    depth: float
    """world units beneath the plane that are opaque"""
    clear: float
    """world units above the plane in which nothing else is"""
    rgb: Tensor
    """(U, V, 3) float32 in [0, 1]"""
    known: Tensor
    """(U, V) bool"""

    def __post_init__(self) -> None:
        if self.rgb.shape != (*self.known.shape, 3) or min(self.known.shape) < 2:
            raise ValueError(f"a texture of {tuple(self.rgb.shape)} and its mask of {tuple(self.known.shape)} differ")

    @cached_property
    def box(self) -> Tensor:
        """(2, 3) float32 world box of what it holds."""
        known = self.known.nonzero().float()
        flat = torch.stack([known.amin(0) - 0.5, known.amax(0) + 0.5]) if len(known) else torch.zeros(2, 2)
        corners = self.at(torch.cartesian_prod(*flat.T))
        both = torch.cat([corners - self.depth * self.normal, corners + self.clear * self.normal])
        return torch.stack([both.amin(0), both.amax(0)])

    @cached_property
    def nodes(self) -> Tensor:
        """(U * V, 3) world: the texels' centres."""
        return self.at(torch.cartesian_prod(*(torch.arange(float(n)) for n in self.known.shape)))

    def at(self, texels: Tensor) -> Tensor:
        """Places in texels (N, 2) -> world points (N, 3)."""
        return self.origin + self.texel * (texels @ self.axes)

    def texels(self, x: Tensor) -> Tensor:
        """World points (N, 3), projected onto the plane -> their places in texels (N, 2)."""
        return (x - self.origin) @ self.axes.T / self.texel

    def height(self, x: Tensor) -> Tensor:
        """World points (N, 3) -> world units above the plane, (N,)."""
        return (x - self.origin) @ self.normal

    def over(self, which: Tensor, x: Tensor) -> Tensor:
        """Whether world points (N, 3) are above or beneath a texel of ``which`` (U, V) bool, (N,) bool."""
        ij = self.texels(x).round()
        size = torch.tensor(which.shape, device=x.device)
        inside = ((ij >= 0) & (ij < size)).all(-1)
        ij = torch.minimum(ij.clamp_min(0), size - 1.0).long()
        return inside & which[ij[:, 0], ij[:, 1]]

    def contains(self, x: Tensor) -> Tensor:
        """Whether it says what is at world points (N, 3), (N,) bool: that they are opaque, or that they are empty."""
        height = self.height(x)
        inside = (height <= self.clear) & (height > -self.depth)
        rows = inside.nonzero()[:, 0]
        return inside.index_copy(0, rows, self.over(self.known, x[rows]))

    def opaque(self, x: Tensor) -> Tensor:
        """Which of the points (N, 3) that it contains are opaque, (N,) bool."""
        return self.height(x) <= 0

    def met(self, rays: Rays) -> Tensor:
        """Distances (N,) at which rays come to the plane from the front, texels or not; infinite where they do not."""
        down = -(rays.directions @ self.normal)
        t = self.height(rays.origins) / down.clamp_min(_ALONG)
        return torch.where((down > _ALONG) & (t > 0), t, torch.inf)

    def hit(self, rays: Rays) -> Tensor:
        """Whether rays come to a known texel, if nothing is in their way, (N,) bool."""
        t = self.met(rays)
        found = t.isfinite()
        rows = found.nonzero()[:, 0]
        x = rays.origins[rows] + t[rows, None] * rays.directions[rows]
        return found.index_copy(0, rows, self.over(self.known, x))

    def colours(self, x: Tensor, d: Tensor) -> Tensor:
        """Colours (N, 3) where rays that are at world points (N, 3) along unit directions (N, 3) met the plane.

        A point of a ray is up to a sample beneath the plane: the texel right above it is another.
        """
        across = d @ self.normal
        steep = across.abs() > _ALONG
        back = torch.where(steep, self.height(x) / torch.where(steep, across, 1.0), 0.0)
        p = self.texels(x - d * back[:, None])
        size = torch.tensor(self.known.shape, device=x.device)
        p = torch.minimum(p.clamp_min(0), size - 1.0)
        i = torch.minimum(p.long(), size - 2)
        f = (p - i)[..., None]
        rows = [self.rgb[i[:, 0] + a, i[:, 1] + b] for a in (0, 1) for b in (0, 1)]
        u, v = f[:, 0], f[:, 1]
        return (1 - u) * ((1 - v) * rows[0] + v * rows[1]) + u * ((1 - v) * rows[2] + v * rows[3])
