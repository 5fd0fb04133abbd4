"""How many pixels of a residual count as one: neighbours err together, as the field and the light do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from refield.estimate.look import Array


def pixels_as_one(pictures: Sequence[Array]) -> float:
    """The sum of the squared autocorrelation ρ of residuals (H, W, C) over all lags, at least 1.

    What a pose is drawn by is the sum of residuals times slopes. Where the slopes, which are those of the same
    surface, are correlated as the residuals are, the products are as ρ², so that the sum's variance is this many times
    that of independent pixels.
    """
    height, width = (max((p.shape[k] for p in pictures), default=1) for k in (0, 1))
    # twice the size, so that nothing meets itself around the edge
    shape = tuple(fft.next_fast_len(2 * n, real=True) for n in (height, width))
    power = np.zeros((shape[0], shape[1] // 2 + 1))
    for picture in pictures:
        power += (np.abs(fft.rfft2(picture.astype(np.float64), shape, axes=(0, 1))) ** 2).sum(-1)
    together = fft.irfft2(power, shape)
    return max(1.0, float((together**2).sum() / together[0, 0] ** 2)) if together[0, 0] > 0 else 1.0
