"""Which parts of the occupancy grid's cells hold something, in plain torch: truths as those in `reference`.

A cell has 4^3 sub-cells, and its mask, an int64, a bit for each: (i * 4 + j) * 4 + k. Letters: R cells a side of the
grid, K = R^3 of them, S samples.
"""

from __future__ import annotations

import torch
from torch import Tensor

ASKED_NOW, SHOWN_NOW, ASKED, SHOWN, FADING = range(5)
"""columns of what is known of cells, see `note` and `narrow`"""


def signed(bits: int) -> int:
    """64 bits as a number that an int64 can hold."""
    return bits - (1 << 64) if bits >> 63 else bits


AXES = tuple(
    (shift, signed(low), signed(low << 3 * shift))
    for shift, low in ((16, 0x000000000000FFFF), (4, 0x000F000F000F000F), (1, 0x1111111111111111))
)
"""of each axis: how far apart neighbours' bits are, and the bits of the first and of the last along it"""


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

    Left out are sub-cells that were asked and are empty: where nothing was opaque, neither there nor beside it, in the
    last two rounds that asked. 0 is a cell that is empty altogether.
    """
    rows = (grid.reshape(-1) > 0).nonzero()[:, 0]
    now, opaque, asked, shown, fading = known[rows].unbind(1)
    missed = now & ~opaque
    asked, fading, shown = asked | now, (fading & ~missed) | (shown & missed), opaque | (shown & ~missed)
    known[rows] = torch.stack([torch.zeros_like(now), torch.zeros_like(now), asked, shown, fading], 1)
    full, unknown = torch.zeros(2, *grid.shape, dtype=torch.int64, device=grid.device)
    full.view(-1)[rows], unknown.view(-1)[rows] = shown | fading, ~asked
    return torch.where(grid > 0, spread(full) | unknown, 0)


def spread(masks: Tensor) -> Tensor:
    """Masks (R, R, R) int64 with the 26 sub-cells beside each that is set, in other cells, too."""
    for axis, (shift, low, high) in enumerate(AXES):
        none = torch.zeros_like(masks.narrow(axis, 0, 1))
        inner = masks.shape[axis] - 1
        before = torch.cat([none, masks.narrow(axis, 0, inner)], axis)
        behind = torch.cat([masks.narrow(axis, 1, inner), none], axis)
        within = ((masks << shift) & ~low) | ((masks >> shift) & ~high)
        masks = masks | within | ((before >> 3 * shift) & low) | ((behind << 3 * shift) & high)
    return masks
