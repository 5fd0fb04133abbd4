"""Which parts of the occupancy grid's cells hold something, in plain torch: truths as those in `reference`.

A cell has 4^3 sub-cells, and its mask, an int64, a bit for each: (i * 4 + j) * 4 + k. Letters: R cells a side of the
grid, K = R^3 of them, S samples.
"""

from __future__ import annotations

import torch
from torch import Tensor

ASKED_NOW, SHOWN_NOW, ASKED, SHOWN, FADING = range(5)
"""columns of what is known of cells, see `note` and `narrow`"""


def marked(places: Tensor, grid: Tensor, fine: Tensor | None) -> Tensor:
    """Whether something may be at places (S, 3), given in cells, -> (S,) bool.

    ``grid`` (R, R, R) uint8 is not 0 in cells that may hold something. ``fine`` (R, R, R) int64 has a bit for each of a
    cell's 4^3 sub-cells, (i * 4 + j) * 4 + k, set where it may be; 0 says nothing, so that all of the cell may be full.
    """
    quarter = (places * 4).long().clamp_(0, 4 * grid.shape[0] - 1)
    i, j, k = (quarter >> 2).unbind(-1)
    full = grid[i, j, k] > 0
    if fine is None:
        return full
    mask = fine[i, j, k]
    return full & ((mask == 0) | ((mask >> part_of(quarter)) & 1 > 0))


def part_of(quarter: Tensor) -> Tensor:
    """Which of its cell's sub-cells each of S places is in; ``quarter`` (S, 3) int64 counts quarters of cells."""
    i, j, k = (quarter & 3).unbind(-1)
    return (i * 4 + j) * 4 + k


def note(known: Tensor, cells: Tensor, parts: Tensor, opaque: Tensor) -> None:
    """Note in ``known`` (K, 5) int64 that there were samples in parts (S,) of cells (S,), and which were opaque."""
    for column, which in ((ASKED_NOW, slice(None)), (SHOWN_NOW, opaque)):
        each = (cells[which] * 64 + parts[which]).unique()
        bits = torch.ones_like(each) << (each & 63)
        new = torch.zeros_like(known[:, column]).index_add_(0, each >> 6, bits)  # each bit once: a sum is a union
        known[:, column] |= new


def narrow(known: Tensor, grid: Tensor) -> Tensor:
    """End a round of `note`; masks (R, R, R) int64 of the cells that ``grid`` (R, R, R) uint8 shows.

    Left out are parts that are empty: nothing in them was opaque in the last two rounds that asked, or the first if
    nothing ever was. 0 is a cell that is empty altogether.
    """
    rows = (grid.reshape(-1) > 0).nonzero()[:, 0]
    now, opaque, asked, shown, fading = known[rows].unbind(1)
    missed = now & ~opaque
    asked, fading, shown = asked | now, (fading & ~missed) | (shown & missed), opaque | (shown & ~missed)
    known[rows] = torch.stack([torch.zeros_like(now), torch.zeros_like(now), asked, shown, fading], 1)
    out = torch.zeros(grid.shape, dtype=torch.int64, device=grid.device)
    out.view(-1)[rows] = shown | fading | ~asked
    return out
