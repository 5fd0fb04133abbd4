"""The object's masks on every old photo (§4.2.4, §10.2.4).

The projection check of the paper is done in `objects`. Where the object was is read from what the field shows there, so
occlusion is right; where it is now is its grid reprojected and closed, whatever stands before it (§10.2.4).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from refield.estimate.lattice import grown
from refield.estimate.objects import Old, box_in, corners_of, patch_rays
from refield.scene.capture import Frame
from refield.scene.change import OccupancyGrid
from refield.vision import pixels

_PIXELS = 1 << 18  # of a photo, in which a place is projected; larger photos' masks are scaled up


def masks_out(frames: Sequence[Frame], old: Old) -> tuple[Tensor | None, ...]:
    """Per old frame, (H, W) bool: where the object was seen."""
    near = grown(old.voxels, 1)
    found: dict[str, Tensor] = {}
    for patch in old.patches:
        on = old.lattice.holds(near, patch.points)
        c, (x0, y0, x1, y1) = patch.camera, patch.box
        full = np.zeros((c.height, c.width), bool)
        full[y0:y1, x0:x1] = on
        found[patch.frame.name] = _full_size(full, patch.frame)
    return tuple(found.get(f.name, torch.zeros(f.camera.height, f.camera.width, dtype=torch.bool)) for f in frames)


def masks_in(frames: Sequence[Frame], grid: OccupancyGrid) -> tuple[Tensor | None, ...]:
    """Per old frame, (H, W) bool: where a place projects to."""
    return tuple(_projected(f, grid) for f in frames)


def _full_size(mask: np.ndarray, frame: Frame) -> Tensor:
    mask = pixels.enlarged(mask, (frame.camera.height, frame.camera.width))
    return torch.from_numpy(pixels.fill_holes(pixels.close(mask, 5), 0.02 * mask.size))


def _projected(frame: Frame, grid: OccupancyGrid) -> Tensor:
    camera = frame.camera.within(_PIXELS)
    out = np.zeros((camera.height, camera.width), bool)
    low, high = grid.tight_aabb().numpy()
    box = box_in(camera, frame, corners_of(low, high))
    if box is not None:
        x0, y0, x1, y1 = box
        hit = grid.met_by(patch_rays(camera, frame, box))
        out[y0:y1, x0:x1] = hit.reshape(y1 - y0, x1 - x0).numpy()
    return _full_size(out, frame)
