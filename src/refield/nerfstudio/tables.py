"""nerfstudio's hash tables and networks, laid out as our kernels read them.

Only the layout changes: every corner of a level's lattice keeps its features. Letters: L levels, T entries of a level's
table, F features a level, R cells a side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refield.field.encoding import large_zeros
from refield.field.kernels.reference import level_index
from refield.field.nerfstudio import GridShape


@dataclass(frozen=True)
class GridSettings:
    """What a hash grid of nerfstudio is told, under nerfstudio's names."""

    num_levels: int
    base_res: int
    max_res: int
    log2_hashmap_size: int
    features_per_level: int = 2

    @property
    def growth(self) -> float:
        """From a level's resolution to the next."""
        if self.num_levels == 1:
            return 1.0
        return float(np.exp((np.log(self.max_res) - np.log(self.base_res)) / (self.num_levels - 1)))


@dataclass(frozen=True)
class Level:
    """One level as it was kept."""

    resolution: int
    """R"""
    features: Tensor
    """(T', F) by row"""
    row: Callable[[Tensor], Tensor] | None
    """lattice corners (K, 3) int64 -> their rows (K,); None where they are hashed, by Instant-NGP's hash"""


def torch_levels(table: Tensor, settings: GridSettings) -> list[Level]:
    """Of nerfstudio's torch implementation: (L * T, F), every level hashed.

    Raises:
        ValueError: the table is not of that size.
    """
    size = 1 << settings.log2_hashmap_size
    if table.shape != (size * settings.num_levels, settings.features_per_level):
        raise ValueError(f"a hash table of {tuple(table.shape)} is not that of {settings}")
    # in float32, as there: the last level may come out one cell short of max_res
    cells = torch.floor(settings.base_res * settings.growth ** torch.arange(settings.num_levels)).long().tolist()
    return [Level(r, features, None) for r, features in zip(cells, table.float().split(size))]


def laid_out(levels: list[Level], log2_table: int, scales: tuple[float, ...] = ()) -> tuple[Tensor, GridShape]:
    """Tables (L', T, 2) and their shape; L' is L for two features a level, and 2 L for four."""
    # our lattice is indexed directly where it fits; one that was, has to be
    while any(level.row is not None and (level.resolution + 1) ** 3 > 1 << log2_table for level in levels):
        log2_table += 1
    pairs = (levels[0].features.shape[1] + 1) // 2
    tables = large_zeros(len(levels) * pairs, 1 << log2_table, 2)
    for i, level in enumerate(levels):
        features = torch.nn.functional.pad(level.features, (0, level.features.shape[1] % 2)).reshape(-1, pairs, 2)
        tables[i * pairs : (i + 1) * pairs] = _rows(level, features, 1 << log2_table).transpose(0, 1)
    each = [level.resolution for level in levels for _ in range(pairs)]
    return tables, GridShape(tuple(each), log2_table, tuple(s for s in scales for _ in range(pairs)))


def _rows(level: Level, features: Tensor, size: int) -> Tensor:
    """A level's features (T', …) at our rows, (size, …)."""
    side = level.resolution + 1
    if side**3 > size:
        return features.repeat(size // len(features), *[1] * (features.ndim - 1))
    corners = torch.cartesian_prod(*[torch.arange(side)] * 3)
    theirs = level_index(corners, _HASHED, len(features)) if level.row is None else level.row(corners)
    out = features.new_zeros(size, *features.shape[1:])
    out[level_index(corners, level.resolution, size)] = features[theirs]
    return out


_HASHED = 1 << 20  # cells a side of a lattice that no table holds


def features_in(weight: Tensor, settings: GridSettings) -> Tensor:
    """The columns of a first layer (W, L * F), with one of zeros where an odd F was made even."""
    f = settings.features_per_level
    columns = weight[:, : settings.num_levels * f].reshape(len(weight), settings.num_levels, f)
    return torch.nn.functional.pad(columns, (0, f % 2)).reshape(len(weight), -1)
