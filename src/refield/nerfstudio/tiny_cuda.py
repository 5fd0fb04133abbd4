"""What tiny-cuda-nn keeps in one flat tensor: the matrices of a network, the levels of a hash grid.

Its layout is that of its sources: a network has no biases; its matrices (out, in) follow one another row by row, with
inputs and outputs padded to a multiple of 16 (8 where it has to do without fused kernels). Inputs that are padded are
one where they come from outside, so that their columns are a bias, and zero behind a hash grid. A grid's level is
indexed directly where its vertices fit its table, x first, and hashed elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from refield.nerfstudio.tables import GridSettings, Level

Layers = list[tuple[Tensor, Tensor]]
"""weights (out, in) and biases (out,)"""
_ALIGNMENTS = (16, 8)


def network_layers(packed: Tensor, widths: tuple[int, ...], *, ones: bool) -> Layers:
    """The layers between ``widths`` (inputs, hidden ones, outputs); ``ones``: padded inputs are one, not zero.

    Raises:
        ValueError: there are more numbers, or fewer.
    """
    for alignment in _ALIGNMENTS:
        padded = (_up(widths[0], alignment), *widths[1:-1], _up(widths[-1], alignment))
        shapes = [(b, a) for a, b in pairwise(padded)]
        if sum(a * b for a, b in shapes) == len(packed):
            break
    else:
        raise ValueError(f"{len(packed)} packed weights are not those of a network {widths}")
    parts = packed.float().split([a * b for a, b in shapes])
    matrices = [part.reshape(shape) for part, shape in zip(parts, shapes)]
    layers = [(m[:n], torch.zeros(n)) for m, n in zip(matrices, widths[1:])]
    first, bias = layers[0]
    layers[0] = first[:, : widths[0]], first[:, widths[0] :].sum(1) if ones else bias
    return layers


def grid_size(settings: GridSettings) -> int:
    """How many numbers a hash grid is."""
    return sum(_sizes(settings)) * settings.features_per_level


def grid_levels(packed: Tensor, settings: GridSettings) -> tuple[list[Level], tuple[float, ...]]:
    """The levels of a hash grid, and their scales (see `GridShape`).

    Raises:
        ValueError: there are more numbers, or fewer.
    """
    if len(packed) != grid_size(settings):
        raise ValueError(f"{len(packed)} packed features are not those of {settings}")
    scales, sizes = _scales(settings), _sizes(settings)
    features = packed.float().reshape(-1, settings.features_per_level).split(sizes)
    levels = []
    for side, size, rows in zip(map(_side, scales), sizes, features):
        levels.append(Level(side, rows, _index(side, size) if side**3 <= size else None))
    return levels, scales


def _index(side: int, size: int) -> Callable[[Tensor], Tensor]:
    """Rows of the vertices of a lattice that fits its table; those one beyond its end come round."""

    def rows(corners: Tensor) -> Tensor:
        x, y, z = corners.unbind(-1)
        return (x + (y + z * side) * side) % size

    return rows


def _scales(settings: GridSettings) -> tuple[float, ...]:
    """In single precision, as there."""
    growth = np.log2(np.float32(settings.growth))
    steps = np.exp2(np.arange(settings.num_levels, dtype=np.float32) * growth)
    return tuple(float(s) for s in steps * np.float32(settings.base_res) - np.float32(1))


def _side(scale: float) -> int:
    """Vertices along a side."""
    return int(np.ceil(scale)) + 1


def _sizes(settings: GridSettings) -> list[int]:
    """Rows of each level."""
    return [min(_up(_side(s) ** 3, 8), 1 << settings.log2_hashmap_size) for s in _scales(settings)]


def _up(count: int, alignment: int) -> int:
    return -(-count // alignment) * alignment
