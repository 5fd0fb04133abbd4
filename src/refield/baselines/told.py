"""What re-training may be told beside the photos, so that it is compared with what the update knows as well.

Re-training from photos alone has seen the changed scene in a few photos only. The pose change lets the old photos of
an object teach what it looks like at its new place, and what left leaves nothing where it stood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import binary_erosion, distance_transform_edt
from torch import Tensor

from refield.field.photos import Since
from refield.scene.capture import Capture, Frame
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.update.ground import rim
from refield.update.supervision import Place, places_of

_EDGE = 1  # pixels of an object's outline that show what is behind it as well


def carried_along(capture: Capture, since: Since, change: SceneChange) -> Since:
    """``since``, and the old training photos of each object that moved, as if their cameras had moved with it.

    Only pixels inside the object teach, in the light of then; a photo with an unsure mask is left out.
    """
    carried, valid = list(since.carried), dict(since.valid)
    for k, thing in enumerate(change.objects):
        for i, frame in enumerate(capture.train):
            mask = _inside(thing, i, frame)
            if thing.new_from_old is None or mask is None or not mask.any():
                continue
            name = f"carried {k}/{frame.name}"
            carried.append(replace(frame, name=name, world_from_cam=thing.new_from_old @ frame.world_from_cam))
            valid[name] = mask
    return replace(since, carried=tuple(carried), valid=valid)


def _inside(thing: ObjectChange, index: int, frame: Frame) -> Tensor | None:
    """Pixels of an old training photo that show the object and nothing else, (H, W) bool; None if unsure.

    Where the change tells no masks they are the object's silhouette, whatever stands before it.
    """
    mask = Place(thing.masks, thing.grid, arrived_only=False).mask(index, frame)
    return None if mask is None else torch.from_numpy(binary_erosion(mask, iterations=_EDGE))


def left_empty(change: SceneChange) -> tuple[OccupancyGrid, ...]:
    """Where nothing is any more, for sure: deep inside what left its place, and not where something is now."""
    now = [p.grid for p in places_of(change).now]
    return tuple(_deep(o.grid, now) for o in change.objects if o.kind != "added")


def _deep(grid: OccupancyGrid, taken: Sequence[OccupancyGrid]) -> OccupancyGrid:
    """What of a grid lies deeper than its rim, where none of those ``taken`` holds anything."""
    within = np.pad((grid.values > 0.5).numpy(), 1)  # nothing is known beyond the grid
    inside = distance_transform_edt(within, sampling=grid.cell.tolist())[1:-1, 1:-1, 1:-1]
    free = torch.from_numpy(inside > rim(grid))
    for other in taken:
        free &= ~other.contains(grid.nodes())
    return replace(grid, values=free.float())
