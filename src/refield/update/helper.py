"""The helper: a small hash field over the region around what changed, trained from scratch (§4.1.2)."""

from __future__ import annotations

import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from refield.field.occupancy import OccupancyTrainer
from refield.field.radiance import Field, HashField, HashFieldConfig
from refield.field.sampling import OccupancySampler
from refield.scene.capture import Frame
from refield.scene.change import SceneChange

_RESOLUTION = 128
_DEPTH = 0.12  # of an object's mean side: so far inside, nothing that stood there can have been


def new_helper(region: OccupancySampler, frames: tuple[Frame, ...], seed: int) -> HashField:
    """A fresh helper that looks everywhere in ``region``; its finest cells are 1.5 pixels of the nearest photo."""
    space = region.contraction
    pixel = min(float((f.centre.float() - space.centre).norm()) / max(f.camera.fx, f.camera.fy) for f in frames)
    finest = int(min(max(4 * space.radius / (1.5 * pixel), 64), 2048))
    return HashField(HashFieldConfig(levels=8, coarsest=16, finest=finest, log2_table=15), region, seed)


def step_near(field: Field, point: Tensor) -> float:
    """Length of the old field's samples at a world point (3,), world units."""
    s = field.sampler
    reach = float(((point - s.contraction.centre) / s.contraction.radius).abs().max())
    return s.step * max(reach, 1.0) ** 1.5


def emptiness(change: SceneChange, cells: OccupancySampler) -> Tensor:
    """How deep inside an object that left each cell lies, (R**3,) float32: 0 outside and at its surface, 1 deep inside.

    What stood in the way of everything is not there any more; only near its surface may something else begin: the
    ground under it, the wall behind it.
    """
    r = cells.resolution
    depth = torch.zeros(r**3)
    centres = cells.points_in(torch.arange(r**3), jitter=False)
    for o in change.objects:
        if o.kind == "added":
            continue
        inside = o.grid.contains(centres).reshape(r, r, r)
        box = o.grid.tight_aabb()
        reach = float((box[1] - box[0]).mean()) * _DEPTH
        cell = 4 * cells.contraction.radius / r
        distance = torch.from_numpy(distance_transform_edt(inside.numpy())).float().reshape(-1) * cell
        depth = torch.maximum(depth, (distance / reach - 1).clamp(0, 1))
    return depth


class HelperOccupancy:
    """The helper's occupancy grid in training: the engine's, never outside the region."""

    def __init__(self, helper: HashField, cull_from: int = 64) -> None:
        self.helper = helper
        self.allowed = helper.sampler.grid.clone()
        self.trainer = OccupancyTrainer(helper, cull_from)

    def observe(self, step: int, x: Tensor, w: Tensor, sigmas: Tensor) -> None:
        """After each step: samples' positions (S, 3), weights (S,) and densities (S,)."""
        self.trainer.observe(step, x, w, sigmas)
        self.helper.looking_where(self.helper.sampler.grid & self.allowed)
