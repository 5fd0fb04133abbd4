"""The object's masks on every old photo (§4.2.4, §10.2.4).

The projection check of the paper is done in `objects`. Where the object was is read from what the field shows there, so
occlusion is right; where it is now is its grid reprojected and closed, whatever stands before it (§10.2.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.lattice import grown
from refield.estimate.objects import Old, box_in, corners_of, patch_rays
from refield.scene.capture import Frame
from refield.scene.change import OccupancyGrid
from refield.vision import pixels


def masks_out(frames: Sequence[Frame], old: Old) -> tuple[Tensor | None, ...]:
    """Per old frame, (H, W) bool: where the object was seen."""
    near = grown(old.voxels, 1)
    found: dict[str, Tensor] = {}
    for patch in old.patches:
        on = old.lattice.holds(near, patch.points)
        c, (x0, y0, x1, y1) = patch.camera, patch.box
        full: NDArray[Any] = np.zeros((c.height, c.width), np.uint8)
        full[y0:y1, x0:x1] = on * np.uint8(255)
        size = (patch.frame.camera.width, patch.frame.camera.height)
        if size != (c.width, c.height):
            full = cv2.resize(full, size, interpolation=cv2.INTER_LINEAR)
        found[patch.frame.name] = _tidy(full > 100)
    return tuple(found.get(f.name, torch.zeros(f.camera.height, f.camera.width, dtype=torch.bool)) for f in frames)


def masks_in(frames: Sequence[Frame], grid: OccupancyGrid) -> tuple[Tensor | None, ...]:
    """Per old frame, (H, W) bool: where a place projects to."""
    return tuple(_projected(f, grid) for f in frames)


def _tidy(mask: np.ndarray) -> Tensor:
    return torch.from_numpy(pixels.fill_holes(pixels.close(mask, 5), 0.02 * mask.size))


def _projected(frame: Frame, grid: OccupancyGrid) -> Tensor:
    camera = frame.camera
    out = np.zeros((camera.height, camera.width), bool)
    low, high = grid.tight_aabb().numpy()
    box = box_in(camera, frame, corners_of(low, high))
    if box is not None:
        x0, y0, x1, y1 = box
        hit = grid.met_by(patch_rays(camera, frame, box))
        out[y0:y1, x0:x1] = hit.reshape(y1 - y0, x1 - x0).numpy()
    return _tidy(out)
