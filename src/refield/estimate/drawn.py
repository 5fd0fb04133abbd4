"""An object's own picture by its surface points alone: coarse, and far quicker than its field.

Each pixel shows the mean colour of the points that fall on it, face it and are the nearest there; where points are
sparser than pixels there are gaps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from refield.estimate.carve_kernels import Window, draw_points, packed
from refield.estimate.look import Seen
from refield.estimate.objects import Cloud
from refield.scene.pose import rotate, transform


def drawn(cloud: Cloud, new_from_old: Tensor, windows: Sequence[Window], thickness: float) -> Seen:
    """Colour (P, 3), distance (P,) and opacity (P,), which is 0 or 1, of a moved object in all pixels of some windows,
    window by window.

    Args:
        thickness: world units; points of one pixel that are nearer to each other are of one surface.
    """
    lenses, depths = packed(windows)
    eyes = np.stack([w.world_from_cam[:3, 3].numpy() for w in windows])
    points = transform(new_from_old, torch.from_numpy(cloud.points).double()).numpy()
    normals = rotate(new_from_old, torch.from_numpy(cloud.normals).double()).numpy()
    depth, total = np.full(len(depths), np.inf, np.float32), np.zeros((len(depths), 4), np.float32)
    draw_points(points, normals, cloud.colours, lenses, eyes, thickness, depth, total)
    rgb = total[:, :3] / np.maximum(total[:, 3:], 1)
    return Seen(torch.from_numpy(rgb), torch.from_numpy(depth), torch.from_numpy(np.minimum(total[:, 3], 1)))
