"""What an object that left had stood on or leant against: planes that go on where it was.

A few new photos agree on many geometries; what is known of the ground keeps haze out of the place where the object was.
"""

from __future__ import annotations

import torch
from torch import Tensor

from refield.scene.planes import Plane, rough_planes

_POINTS = 6000  # that planes are looked for among


def planes_around(points: Tensor, box: Tensor, eyes: Tensor, resolved: float) -> list[Plane]:
    """Planes among surface points (N, 3) in and around a world box (2, 3).

    Args:
        eyes: (C, 3) camera centres, from which the planes are seen.
        resolved: how exact the points are, world units.
    """
    near = points[((points - box.mean(0)).abs() < (box[1] - box[0]).max()).all(-1)]
    some = near[torch.randperm(len(near))[:_POINTS]].double().numpy()
    return rough_planes(some, eyes.double().numpy(), resolved)
