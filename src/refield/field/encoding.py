"""Where a point lies and how it looks to the networks: contraction, hash grid, spherical harmonics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
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

    def reach(self, x: Tensor) -> Tensor:
        """L-infinity distance of world points (..., 3) from the centre, in core radii, (...,)."""
        return ((x - self.centre) / self.radius).abs().amax(-1)


class HashGrid(nn.Module):
    """Multi-resolution hash encoding of the contracted cube (Instant-NGP), two features a level."""

    def __init__(self, resolutions: tuple[int, ...], table_size: int, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.resolutions = resolutions
        self.width = 2 * len(resolutions)
        table = large_zeros(len(resolutions), table_size, 2)
        self.tables = nn.Parameter(table.uniform_(-1e-4, 1e-4, generator=generator))

    def forward(self, y: Tensor) -> Tensor:
        """Contracted (S, 3) -> features (S, width)."""
        return kernels.hash_encode((y + 2) / 4, self.tables, self.resolutions)


def large_zeros(*shape: int) -> Tensor:
    """Zeros, float32. Numpy asks Linux for large pages, torch does not: random reads of a table miss the TLB less."""
    return torch.from_numpy(np.zeros(shape, np.float32))


def geometric_levels(coarsest: int, finest: int, count: int) -> tuple[int, ...]:
    """Resolutions that grow by a constant factor, Instant-NGP's Eq. 2."""
    growth = (finest / coarsest) ** (1 / max(count - 1, 1))
    return tuple(round(coarsest * growth**i) for i in range(count))
