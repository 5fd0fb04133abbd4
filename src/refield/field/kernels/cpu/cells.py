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
from refield.field.kernels.masks import ASKED, ASKED_NOW, AXES, FADING, SHOWN, SHOWN_NOW

BLOCKS, _FAR = 4, 8  # cells a side that are skipped together; the furthest that is looked for, in blocks
_NO_MASKS = np.zeros((0, 0, 0), np.int64)
_EMPTY, _ONE_BIT = np.int64(0), np.int64(1)


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
def _end_round(known, grid, full, begin, end):  # type: ignore[no-untyped-def]
    """Of cells ``begin : end``; what is full to ``full``."""
    for c in range(begin, end):
        full[c] = 0
        if grid[c] == 0:
            continue
        cell = known[c]
        if cell[ASKED_NOW] != 0:
            missed = cell[ASKED_NOW] & ~cell[SHOWN_NOW]
            cell[FADING] = (cell[FADING] & ~missed) | (cell[SHOWN] & missed)
            cell[SHOWN] = cell[SHOWN_NOW] | (cell[SHOWN] & ~missed)
            cell[ASKED] |= cell[ASKED_NOW]
            cell[ASKED_NOW], cell[SHOWN_NOW] = 0, 0
        full[c] = cell[SHOWN] | cell[FADING]


@njit(parallel=True, **JIT)
def _end_rounds(known, grid, full, side):  # type: ignore[no-untyped-def]
    for i in prange(side):
        _end_round(known, grid, full, i * side * side, (i + 1) * side * side)


@njit(**JIT)
def _unknown(known, grid, masks, begin, end):  # type: ignore[no-untyped-def]
    for c in range(begin, end):
        masks[c] = masks[c] | ~known[c, ASKED] if grid[c] > 0 else _EMPTY


@njit(parallel=True, **JIT)
def _open_unknown(known, grid, masks, side):  # type: ignore[no-untyped-def]
    for i in prange(side):
        _unknown(known, grid, masks, i * side * side, (i + 1) * side * side)


def narrow(known: Tensor, grid: Tensor) -> Tensor:
    """See `masks.narrow`."""
    full, side, flat = torch.empty(grid.shape, dtype=torch.int64), grid.shape[0], array(grid).reshape(-1)
    _end_rounds(known.numpy(), flat, full.numpy().reshape(-1), side)
    out = spread(full)
    _open_unknown(known.numpy(), flat, out.numpy().reshape(-1), side)
    return out


@njit(**JIT)
def _spread_row(here, before, behind, out, axis):  # type: ignore[no-untyped-def]
    """One row of cells, with the rows before and behind it along the axis."""
    shift, low, high = axis[0], axis[1], axis[2]
    for k in range(len(out)):
        m = here[k]
        within = ((m << shift) & ~low) | ((m >> shift) & ~high)
        out[k] = m | within | ((before[k] >> 3 * shift) & low) | ((behind[k] << 3 * shift) & high)


@njit(**JIT)
def _spread_slab(i, masks, out, room, axes):  # type: ignore[no-untyped-def]
    """The cells of one i, from those of its neighbours."""
    side = len(masks)
    none, whole, wide = room[0, :side], room[1 : side + 1, :side], room[side + 1]
    none[:] = 0
    for j in range(side):
        before = masks[i - 1, j] if i > 0 else none
        behind = masks[i + 1, j] if i + 1 < side else none
        _spread_row(masks[i, j], before, behind, whole[j], axes[0])
    for j in range(side):
        before = whole[j - 1] if j > 0 else none
        behind = whole[j + 1] if j + 1 < side else none
        wide[0], wide[side + 1] = 0, 0
        _spread_row(whole[j], before, behind, wide[1 : side + 1], axes[1])
        _spread_row(wide[1 : side + 1], wide[:side], wide[2:], out[i, j], axes[2])


@njit(parallel=True, **JIT)
def _spread(masks, out, room, axes):  # type: ignore[no-untyped-def]
    for i in prange(len(masks)):
        _spread_slab(i, masks, out, room[i], axes)


def spread(masks: Tensor) -> Tensor:
    """See `masks.spread`."""
    out, side = torch.empty_like(masks), len(masks)
    _spread(array(masks), out.numpy(), np.empty((side, side + 2, side + 2), np.int64), np.array(AXES, np.int64))
    return out
