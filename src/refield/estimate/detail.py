"""What old photos show of an object beyond what the field does: texture finer than the field has learnt.

A pose is found by comparing photos with pictures of the field, and is no more exact than those. What these lack
beside the old photos is carried along with the object's surface, from photos that looked at it as the new ones do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from refield.estimate.look import Array, View
from refield.estimate.objects import Old, Patch, box_in, corners_of, look_around
from refield.field.radiance import Field
from refield.scene.capture import Frame
from refield.scene.images import scaled_image
from refield.scene.pose import invert, transform

_SAME = 2.0  # pixels' widths; what lies this close to the surface that an old photo shows is on it
_STRAIGHT = 4  # power of the cosine between two looks with which the older one counts
_LEAST = 1e-3  # of such weight, to say anything


@dataclass(frozen=True)
class Detail:
    """What the field's pictures of an object lack beside some old photos."""

    patches: tuple[Patch, ...]
    missing: tuple[Array, ...]
    """per patch (h, w, 3): the photo less the field's picture"""

    def at(self, points: Tensor, eye: Tensor) -> Tensor:
        """What the field lacks at surface points (N, 3) of the object at its old place, seen from ``eye`` (3,) there;
        (N, 3), zero where no old photo tells."""
        x = points.float()
        look = functional.normalize(x - eye.float(), dim=-1)
        total, weight = torch.zeros(len(x), 3), torch.zeros(len(x))
        if len(x) == 0:
            return total
        for patch, missing in zip(self.patches, self.missing):
            before = x - torch.from_numpy(patch.centre)
            distance = before.norm(dim=-1).clamp_min(1e-9)
            straight = (look * before).sum(-1) / distance
            shown = patch.behind_surface(x).abs() < _SAME / patch.camera.fx * distance
            counts = shown * straight.clamp_min(0) ** _STRAIGHT
            total += counts[:, None] * _looked_up(missing, patch, x)
            weight += counts
        return torch.where((weight > _LEAST)[:, None], total / weight.clamp_min(_LEAST)[:, None], 0.0)


def _looked_up(missing: Array, patch: Patch, x: Tensor) -> Tensor:
    """The picture's value (N, 3) where world points (N, 3) project to, bilinear."""
    uv, _ = patch.project(x)
    h, w = patch.depth.shape
    unit = (uv - torch.tensor(patch.box[:2])) / torch.tensor([w, h]) * 2 - 1
    image, at = torch.from_numpy(missing).permute(2, 0, 1)[None], unit[None, :, None]
    return functional.grid_sample(image, at, padding_mode="border", align_corners=False)[0, :, :, 0].T


def looking_alike(
    old: Old, frames: Sequence[Frame], views: Sequence[View], new_from_old: Tensor, each: int
) -> list[Frame]:
    """Those of some old photos that looked at an object most as new ones do where ``new_from_old`` moves it: ``each``
    of the new ones takes so many."""
    middle = torch.from_numpy(old.centre).double()
    corners = corners_of(*old.grid.tight_aabb().numpy())
    frames = [f for f in frames if box_in(f.camera, f, corners) is not None]
    if not frames:
        return []
    ways = functional.normalize(torch.stack([f.centre for f in frames]).double() - middle, dim=-1)
    chosen: set[int] = set()
    for view in views:
        eye = transform(invert(new_from_old), view.frame.centre.double())
        alike = ways @ functional.normalize(eye - middle, dim=-1)
        chosen.update(alike.topk(min(each, len(frames))).indices.tolist())
    return [frames[k] for k in sorted(chosen)]


def detail_of(field: Field, old: Old, frames: Sequence[Frame], rays: int) -> Detail:
    """The detail of an object in some old photos.

    ``rays``: looked along in all; more are avoided by scaling the photos down.
    """
    patches = look_around(field, frames, corners_of(*old.grid.tight_aabb().numpy()), rays)
    return Detail(tuple(patches), tuple(_missing(p) for p in patches))


def _missing(patch: Patch) -> Array:
    """The photo less the field's picture, but for what its whole exposure explains."""
    x0, y0, x1, y1 = patch.box
    left = scaled_image(patch.frame, patch.camera).numpy()[y0:y1, x0:x1] - patch.rgb
    return np.ascontiguousarray(left - np.median(left.reshape(-1, 3), axis=0), np.float32)
