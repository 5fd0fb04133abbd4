"""What is known of the occupancy grid's cells: how far it is to the next that holds something, and what parts do."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from refield.field.kernels.cpu.encoding import array
from refield.field.kernels.cpu.simd import JIT
from refield.field.kernels.masks import ASKED, ASKED_NOW, FADING, SHOWN, SHOWN_NOW

_BLOCK, _FAR = 4, 8  # cells a side of a block; the furthest that is looked for, in blocks
_AROUND = _BLOCK + 1  # the furthest that is looked for, in cells: where something is in a neighbour's block
_NO_MASKS = np.zeros((0, 0, 0), np.int64)
_ONE_BIT = np.int64(1)
_BIT, _LAST = np.uint64(1), np.uint64(63)


def _reach(grid: np.ndarray) -> np.ndarray:
    """Per cell: 0 where something is, else a chessboard distance in cells within which nothing is.

    The distance itself up to _AROUND; further off by how many blocks of cells are empty around its own.
    """
    r = grid.shape[0]
    side = -(-r // _BLOCK)
    full = np.ascontiguousarray(np.pad(grid, (0, side * _BLOCK - r)))
    rows = full.view(np.uint32) != 0  # _BLOCK cells of one byte
    blocks = _distances(rows.reshape(side, _BLOCK, side, _BLOCK, side).any((1, 3)).astype(np.uint8), _FAR)
    far = np.where(blocks > 1, (blocks - 1) * np.uint8(_BLOCK) + np.uint8(1), 0).astype(np.uint8)
    for axis in range(3):
        far = far.repeat(_BLOCK, axis)
    return np.maximum(_distances((grid > 0).view(np.uint8), _AROUND), far[:r, :r, :r])


def _distances(full: np.ndarray, most: int) -> np.ndarray:
    """Chessboard distance to the next that is 1, of 0 and 1 on a lattice (R, R, R), at most ``most``."""
    r, out = full.shape[-1], 1 - full
    # 64 along the last axis at once
    near = np.packbits(np.pad(full, ((0, 0), (0, 0), (0, -r % 64))), axis=-1, bitorder="little").view(np.uint64)
    for _ in range(most - 1):
        wide = near | near << _BIT | near >> _BIT
        wide[..., 1:] |= near[..., :-1] >> _LAST
        wide[..., :-1] |= near[..., 1:] << _LAST
        for axis in range(2):
            here, wide = wide, wide.copy()
            there, onto = np.moveaxis(here, axis, 0), np.moveaxis(wide, axis, 0)
            onto[1:] |= there[:-1]
            onto[:-1] |= there[1:]
        near = wide
        out += 1 - np.unpackbits(near.view(np.uint8), axis=-1, count=r, bitorder="little")
    return out


_reaches: list[tuple[Any, int, np.ndarray]] = []


def reach(grid: Tensor) -> np.ndarray:
    """How far it is from each cell to the next that may hold something, in cells, (R, R, R); never more than it is.

    Kept while the grid lives and is not written to.
    """
    if grid.is_inference():  # does not say when it is written to
        return _reach(array(grid))
    for known, version, found in _reaches:
        if known() is grid and version == grid._version:
            return found
    found = _reach(array(grid))
    _reaches[:] = [(weakref.ref(grid), grid._version, found), *_reaches[:7]]
    return found


def grids_of(grid: Tensor, fine: Tensor | None) -> tuple[np.ndarray, np.ndarray]:
    """What the walk looks at: how far it may go without another look, see :func:`reach`, and sub-cells if known."""
    return reach(grid), _NO_MASKS if fine is None else array(fine)


# --- parts of cells --------------------------------------------------------------------------------------------------


@njit(**JIT)
def _note(known, cells, parts, opaque):  # type: ignore[no-untyped-def]
    for i in range(len(cells)):
        cell, bit = known[cells[i]], _ONE_BIT << parts[i]
        cell[ASKED_NOW] |= bit
        if opaque[i]:
            cell[SHOWN_NOW] |= bit


def note(known: Tensor, cells: Tensor, parts: Tensor, opaque: Tensor) -> None:
    """See `masks.note`."""
    _note(known.numpy(), array(cells), array(parts), array(opaque))


@njit(**JIT)
def _end_round(known, grid, out, begin, end):  # type: ignore[no-untyped-def]
    """Of cells ``begin : end``, and their masks."""
    for c in range(begin, end):
        out[c] = 0
        if grid[c] == 0:
            continue
        cell = known[c]
        if cell[ASKED_NOW] != 0:
            missed = cell[ASKED_NOW] & ~cell[SHOWN_NOW]
            cell[FADING] = (cell[FADING] & ~missed) | (cell[SHOWN] & missed)
            cell[SHOWN] = cell[SHOWN_NOW] | (cell[SHOWN] & ~missed)
            cell[ASKED] |= cell[ASKED_NOW]
            cell[ASKED_NOW], cell[SHOWN_NOW] = 0, 0
        out[c] = cell[SHOWN] | cell[FADING] | ~cell[ASKED]


@njit(parallel=True, **JIT)
def _end_rounds(known, grid, out, side):  # type: ignore[no-untyped-def]
    for i in prange(side):
        _end_round(known, grid, out, i * side * side, (i + 1) * side * side)


def narrow(known: Tensor, grid: Tensor) -> Tensor:
    """See `masks.narrow`."""
    out = torch.empty(grid.shape, dtype=torch.int64)
    _end_rounds(known.numpy(), array(grid).reshape(-1), out.numpy().reshape(-1), len(grid))
    return out
