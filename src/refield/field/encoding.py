"""Where a point lies and how it looks to the networks: contraction, hash grid, spherical harmonics."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from refield.field import kernels
from refield.field.kernels import reference


@dataclass(frozen=True)
class Contraction:
    """The whole world in the open cube (-2, 2)^3: affine within ``radius`` of the centre, shrinking outside.

    This is mip-NeRF 360's contraction in the L-infinity norm (as MERF has it), so that the core is a cube and a
    regular grid wastes nothing. It is the field's own business: the world keeps its units and axes.
    """

    centre: Tensor
    """(3,) float32, world"""
    radius: float
    """half the side of the core cube, world units"""

    def __call__(self, x: Tensor) -> Tensor:
        """World (..., 3) -> contracted (..., 3)."""
        return kernels.contract(x, self.centre, self.radius)

    def inverse(self, y: Tensor) -> Tensor:
        """Contracted (..., 3) -> world (..., 3)."""
        return reference.uncontract(y, self.centre, self.radius)


class HashGrid(nn.Module):
    """Multi-resolution hash encoding of the contracted cube (Instant-NGP), two features a level."""

    def __init__(self, resolutions: tuple[int, ...], table_size: int, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.resolutions = resolutions
        self.width = 2 * len(resolutions)
        table = torch.rand(len(resolutions), table_size, 2, generator=generator)
        self.tables = nn.Parameter((table * 2 - 1) * 1e-4)

    def forward(self, y: Tensor) -> Tensor:
        """Contracted (S, 3) -> features (S, width)."""
        return kernels.hash_encode((y + 2) / 4, self.tables, self.resolutions)


def geometric_levels(coarsest: int, finest: int, count: int) -> tuple[int, ...]:
    """Resolutions that grow by a constant factor, Instant-NGP's Eq. 2."""
    growth = (finest / coarsest) ** (1 / max(count - 1, 1))
    return tuple(round(coarsest * growth**i) for i in range(count))
