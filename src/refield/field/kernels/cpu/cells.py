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

BLOCKS, _FAR = 4, 8  # cells a side that are skipped together; the furthest that is looked for, in blocks
_NO_MASKS = np.zeros((0, 0, 0), np.int64)
_ONE_BIT = np.int64(1)


def _reach(grid: np.ndarray) -> np.ndarray:
    """Per block of BLOCKS^3 cells: chessboard distance to the next with something in it, in blocks, at most _FAR."""
    side = -(-grid.shape[0] // BLOCKS)
    full = np.ascontiguousarray(np.pad(grid, (0, side * BLOCKS - grid.shape[0])))
    rows = full.view(np.uint32) != 0  # BLOCKS cells of one byte
    near = rows.reshape(side, BLOCKS, side, BLOCKS, side).any((1, 3)).astype(np.uint8)
    out = np.zeros_like(near)
    for _ in range(_FAR):
        out += 1 - near
        for axis in range(3):
            here = np.moveaxis(near, axis, 0)
            wide = here.copy()
            np.maximum(wide[1:], here[:-1], out=wide[1:])
            np.maximum(wide[:-1], here[1:], out=wide[:-1])
            near = np.moveaxis(wide, 0, axis)
    return out


_reaches: list[tuple[Any, int, np.ndarray]] = []


def reach(grid: Tensor) -> np.ndarray:
    """How far rays may go without a look at the grid; kept while the grid lives and is not written to."""
    if grid.is_inference():  # does not say when it is written to
        return _reach(array(grid))
    for known, version, found in _reaches:
        if known() is grid and version == grid._version:
            return found
    found = _reach(array(grid))
    _reaches[:] = [(weakref.ref(grid), grid._version, found), *_reaches[:7]]
    return found


def grids_of(grid: Tensor, fine: Tensor | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the walk looks at: cells, how far it may go without a look at them, and their sub-cells if known."""
    return array(grid), reach(grid), _NO_MASKS if fine is None else array(fine)


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
