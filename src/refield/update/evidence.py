"""Do the new photos agree with what earlier visits know of a place (`refield.update.recall`)?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from refield.field.render import render_many
from refield.scene.capture import Frame
from refield.update.composite import UpdatedField
from refield.update.supervision import Lessons, silhouette

_PIXELS = 20_000  # compared
# What an earlier visit says of a place may be so many times as wrong as what did not change (a helper's ground, a
# shadow that went), and so much more: squared error, 26 dB
_TRUST, _BLUNDER = 3.0, 2.5e-3


def as_remembered(
    cut: UpdatedField,
    sparse: Lessons,
    changed: Sequence[np.ndarray],
    recalled: Sequence[np.ndarray],
    draw: torch.Generator,
) -> bool:
    """Whether the new photos show what earlier visits say is there, about as well as what did not change at all.

    ``sparse`` are pixels of the change's photos, ``changed`` the changed ones of each, ``recalled`` its
    `recalled_pixels`, (H, W) bool each.
    """
    known, still = sparse.within(recalled), ~sparse.within(changed)
    told, same = (_error(cut, sparse, which, draw) for which in (known, still))
    return told < _TRUST * same + _BLUNDER


def recalled_pixels(cut: UpdatedField, frame: Frame) -> np.ndarray:
    """Pixels of a new photo that show what only an earlier visit knows, (H, W) bool."""
    objects, earlier = cut.change.objects, cut.earlier
    if not earlier:
        return np.zeros((frame.camera.height, frame.camera.width), bool)
    known = [objects[p.object].grid for p in earlier.undone + earlier.left]
    known += [now for p in earlier.undone if (now := objects[p.object].grid_now) is not None]
    other = [m.grid.moved(m.new_from_old) for m in cut.moves] + [o.grid for o in cut.to_learn.objects]
    other += earlier.unknown.grids
    return silhouette(known, frame) & ~silhouette(other, frame)


def _error(field: UpdatedField, seen: Lessons, which: torch.Tensor, draw: torch.Generator) -> float:
    """Mean squared error of some of the pixels; 0 if there are none."""
    rows = which.nonzero()[:, 0]
    some = seen[rows[torch.randperm(len(rows), generator=draw)[:_PIXELS]]]
    return float((render_many(field, some.rays).rgb - some.rgb).square().mean()) if len(rows) else 0.0
