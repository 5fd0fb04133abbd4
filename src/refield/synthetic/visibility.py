"""What a world shows where, exactly: the first solid along each ray."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Rays, camera_rays
from refield.scene.pose import invert, rotate, transform
from refield.synthetic.state import State


@dataclass(frozen=True)
class Hits:
    """First hits; leading shape (N,) or (H, W)."""

    depth: Tensor
    """(...,) float32 along the unit direction; inf where nothing is hit"""
    item: Tensor
    """(...,) int64 index into ``state.items``; -1 where nothing is hit"""


def first_hits(state: State, rays: Rays) -> Hits:
    """Cast N rays into a state."""
    depths = []
    for item in state.items:
        item_from_world = invert(item.world_from_item)
        origins = transform(item_from_world, rays.origins.double())
        directions = rotate(item_from_world, rays.directions.double())
        depths.append(item.solid.hit(origins, directions))
    depth, index = torch.stack(depths).min(0)
    return Hits(depth.float(), torch.where(depth.isfinite(), index, -1))


def view_hits(state: State, camera: Camera, world_from_cam: Tensor) -> Hits:
    """Cast a ray through every pixel centre; leading shape (H, W)."""
    hits = first_hits(state, camera_rays(camera, world_from_cam))
    shape = (camera.height, camera.width)
    return Hits(hits.depth.reshape(shape), hits.item.reshape(shape))


def silhouette(state: State, name: str, camera: Camera, world_from_cam: Tensor) -> Tensor:
    """Pixels whose centre shows the named item, (H, W) bool; all False where it is not in the scene."""
    names = [item.name for item in state.items]
    if name not in names:
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)
    return view_hits(state, camera, world_from_cam).item == names.index(name)
