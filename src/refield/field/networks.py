"""The networks that fields are made of: matrices without bias, a hash grid with one hidden layer.

Letters: S points.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from refield.field.encoding import HashGrid


class HashNetwork(nn.Module):
    """Hash grid → one hidden layer of relu → outputs, over the contracted cube."""

    def __init__(self, levels: tuple[int, ...], log2_table: int, sizes: tuple[int, int], g: torch.Generator) -> None:
        """``levels`` are the grid's resolutions, ``sizes`` the hidden layer's width and the number of outputs."""
        super().__init__()
        self.encoding = HashGrid(levels, 1 << log2_table, g)
        self.into = weight(sizes[0], self.encoding.width, g)
        self.out = weight(sizes[1], sizes[0], g)

    def forward(self, y: Tensor, outputs: slice = slice(None)) -> Tensor:
        """Contracted (S, 3) -> the chosen ``outputs``, (S, O)."""
        return functional.linear(functional.relu(functional.linear(self.encoding(y), self.into)), self.out[outputs])


def weight(rows: int, columns: int, g: torch.Generator) -> nn.Parameter:
    """A matrix (rows, columns), He-uniform."""
    bound = (6 / columns) ** 0.5
    return nn.Parameter((torch.rand(rows, columns, generator=g) * 2 - 1) * bound)
