"""The hot loop of colour differences (numba)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

_F32 = NDArray[Any]
_I64 = NDArray[Any]


@njit(parallel=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, cache=True, error_model="numpy")
def find_nearest(colours: _F32, image: _F32, rows: _I64, columns: _I64, reach: int, out: _F32) -> None:
    """``out`` (K,): the distance of each colour (K, 3) to the most similar one of an image (H, W, 3) within ``reach``
    pixels of (row, column)."""
    h, w = image.shape[:2]
    for k in prange(len(colours)):
        a, b, c = colours[k, 0], colours[k, 1], colours[k, 2]
        best = np.float32(np.inf)
        for i in range(rows[k] - reach, rows[k] + reach + 1):
            y = min(max(i, 0), h - 1)
            for j in range(columns[k] - reach, columns[k] + reach + 1):
                x = min(max(j, 0), w - 1)
                da, db, dc = a - image[y, x, 0], b - image[y, x, 1], c - image[y, x, 2]
                best = min(best, da * da + db * db + dc * dc)
        out[k] = np.sqrt(best)
