"""A camera that is known from nothing but one photo's matches: pose, focal length, centre and one radial term at once.

A cropped photo's principal point lies anywhere; held in the middle it drags the pose along by percents of the scene.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.pose import exp

ENOUGH = 60
"""matches, from which on the centre can be told"""
_MOST = 600  # matches that are used
_CENTRE_PRIOR = 0.15  # of the longer side: how far off the middle the principal point may well be (1 σ)

_F64 = NDArray[np.float64]


def refined(pose: Tensor, camera: Camera, xy: _F64, xyz: _F64) -> tuple[Tensor, Camera]:
    """Pose (4, 4) and camera that bring world points (N, 3) nearest to their pixels (N, 2), from good first values."""
    pick = np.linspace(0, len(xy) - 1, min(len(xy), _MOST)).astype(np.int64)
    pixels, points = torch.from_numpy(xy[pick]), torch.from_numpy(xyz[pick])
    longer = max(camera.width, camera.height)
    middle = np.array([camera.width, camera.height]) / 2 / longer

    def at(x: _F64) -> tuple[Tensor, Camera]:
        focal = camera.fx * float(np.exp(x[6]))
        cx, cy = camera.cx + longer * float(x[7]), camera.cy + longer * float(x[8])
        changed = replace(camera, fx=focal, fy=focal, cx=cx, cy=cy, k1=camera.k1 + float(x[9]))
        return pose @ exp(torch.from_numpy(x[:6] * scale)), changed

    def off(x: _F64) -> _F64:
        moved, changed = at(x)
        seen, _ = changed.project((points - moved[:3, 3]) @ moved[:3, :3])
        centre = np.array([changed.cx, changed.cy]) / longer - middle
        return np.concatenate([(seen - pixels).numpy().ravel(), centre / _CENTRE_PRIOR])

    depth = float(((points - pose[:3, 3]) @ pose[:3, 2]).median())
    scale = np.array([depth] * 3 + [1.0] * 3)
    return at(least_squares(off, np.zeros(10), loss="soft_l1", max_nfev=40).x)
