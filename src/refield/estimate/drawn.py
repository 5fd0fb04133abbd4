"""An object's own picture by its surface points alone: coarse, and a hundredth of the time that its field would take.

Each pixel shows the mean colour of the points that fall on it, face it and are the nearest there; where points are
sparser than pixels there are gaps (numba).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from refield.estimate.carve_kernels import JIT, Window, look_up, packed
from refield.estimate.look import Array, Seen
from refield.estimate.objects import Cloud
from refield.scene.pose import rotate, transform


def drawn(cloud: Cloud, new_from_old: Tensor, windows: Sequence[Window], thickness: float) -> Seen:
    """Colour (N, 3), distance (N,) and opacity (N,), which is 0 or 1, of a moved object in all pixels of some windows,
    window by window.

    Args:
        thickness: world units; points of one pixel that are nearer to each other are of one surface.
    """
    lenses, _ = packed(windows)
    eyes = np.stack([w.world_from_cam[:3, 3].numpy() for w in windows])
    points = transform(new_from_old, torch.from_numpy(cloud.points).double()).numpy()
    normals = rotate(new_from_old, torch.from_numpy(cloud.normals).double()).numpy()
    size = sum(w.depth.size for w in windows)
    depth, total = np.full(size, np.inf, np.float32), np.zeros((size, 4), np.float32)
    _draw(points, normals, cloud.colours, lenses, eyes, thickness, depth, total)
    rgb = total[:, :3] / np.maximum(total[:, 3:], 1)
    return Seen(torch.from_numpy(rgb), torch.from_numpy(depth), torch.from_numpy(np.minimum(total[:, 3], 1)))


@njit(parallel=True, **JIT)
def _draw(
    points: Array, normals: Array, colours: Array, lenses: Array, eyes: Array, thickness: float, depth: Array,
    total: Array,
) -> None:  # fmt: skip
    """``depth`` (P,): the nearest of the points (N, 3) on each pixel that face it; ``total`` (P, 4): the colours, and
    the number, of those that are no more than ``thickness`` behind."""
    for v in prange(len(lenses)):
        for nearest in (True, False):
            for n in range(len(points)):
                x, y, z = points[n, 0], points[n, 1], points[n, 2]
                ex, ey, ez = x - eyes[v, 0], y - eyes[v, 1], z - eyes[v, 2]
                if ex * normals[n, 0] + ey * normals[n, 1] + ez * normals[n, 2] >= 0:
                    continue
                at, distance = look_up(lenses[v], x, y, z)
                if at < 0:
                    continue
                if nearest:
                    depth[at] = min(depth[at], distance)
                elif distance <= depth[at] + thickness:
                    for k in range(3):
                        total[at, k] += colours[n, k]
                    total[at, 3] += 1
