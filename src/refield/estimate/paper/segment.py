"""The object in 3-D and on every old photo (§4.2.4, §10.2.4).

Masks of the new views and rendered depth make a point cloud; where it falls in an old photo the segmenter is asked; and
a grid's nodes that lie in nearly all of the segmenter's masks are the object. Letters: N points, K nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.detect import Mask
from refield.estimate.look import Array, View, full_size
from refield.estimate.paper.detect import Box, enlarged
from refield.scene.camera import Camera
from refield.scene.capture import Frame
from refield.scene.change import OccupancyGrid
from refield.scene.images import scaled_image
from refield.vision import pixels
from refield.vision.segmenter import Segmenter

_CHUNK = 200_000  # nodes projected at once


@dataclass(frozen=True)
class SegmentConfig:
    """How an object is cut out."""  # §10.2.4

    nearest: float = 0.95
    """of the cloud's points, those nearest to its centroid, are believed"""
    box: float = 1.05
    """size of the box that is asked about, against the projected cloud's"""
    confidence: float | None = None
    """of the segmenter; an old photo with less is left out. None: from which on it is sure, SAM's 0.95"""  # §10.1.3
    expanded: float = 3.0
    """size of the grid's box, against the cloud's"""
    nodes: int = 100
    """of the grid, a side"""
    agree: float = 0.95
    """of the masks of photos that see a node must hold it"""
    photos: int = 3
    """old photos with a mask that it takes at least"""


@dataclass(frozen=True)
class OldMask:
    """Where one old photo shows the object."""

    frame: Frame
    camera: Camera
    """the frame's, scaled to the working resolution"""
    mask: Mask | None
    """(H, W) bool; None where the segmenter was not sure"""

    def full(self) -> Tensor | None:
        """(H, W) bool at the photo's own size."""
        if self.mask is None:
            return None
        return full_size(self.mask, self.frame)


def object_cloud(shown: Sequence[tuple[View, Mask]], nearest: float) -> Array:
    """World points (N, 3) under the masks (H, W) of what was rendered: the part nearest to their centroid."""
    points = np.concatenate([np.zeros((0, 3), np.float32), *(v.surface[m] for v, m in shown)])
    points = points[np.isfinite(points).all(-1)]
    if len(points) == 0:
        return points
    distance = np.linalg.norm(points - points.mean(0), axis=-1)
    return points[np.argsort(distance, kind="stable")[: max(1, round(nearest * len(points)))]]


def old_masks(
    frames: Sequence[Frame], cloud: Array, segmenter: Segmenter, max_pixels: int, config: SegmentConfig
) -> list[OldMask]:
    """Ask the segmenter for an object's cloud (N, 3) in every old photo, scaled down to ``max_pixels``."""
    return [_old_mask(f, f.camera.within(max_pixels), cloud, segmenter, config) for f in frames]


def _old_mask(frame: Frame, camera: Camera, cloud: Array, segmenter: Segmenter, config: SegmentConfig) -> OldMask:
    box = projected_box(cloud, camera, frame.world_from_cam, config.box)
    if box is None:  # that it is not in the picture is known
        return OldMask(frame, camera, np.zeros((camera.height, camera.width), bool))
    masks, scores = segmenter.masks(pixels.to_bytes(scaled_image(frame, camera).numpy()), box[None])
    least = segmenter.sure if config.confidence is None else config.confidence
    sure = bool(scores[0] >= least and masks[0].any())
    return OldMask(frame, camera, masks[0] if sure else None)


def projected_box(cloud: Array, camera: Camera, world_from_cam: Tensor, factor: float) -> Box | None:
    """The box around the points (N, 3) that a camera sees, ``factor`` times as large; None if it sees none."""
    uv, inside = _projected(torch.from_numpy(cloud), camera, world_from_cam)
    if not inside.any():
        return None
    seen = uv[inside].double().numpy()
    return enlarged(np.concatenate([seen.min(0), seen.max(0)]), (camera.height, camera.width), factor)


def carved_grid(cloud: Array, seen: Sequence[OldMask], config: SegmentConfig) -> OccupancyGrid:
    """The grid over the cloud's box, tripled, with the nodes that pass the projection check at 1."""
    low, high = torch.from_numpy(cloud.min(0)).float(), torch.from_numpy(cloud.max(0)).float()
    half = ((high - low) / 2).clamp_min(1e-6) * config.expanded
    aabb = torch.stack([(low + high) / 2 - half, (low + high) / 2 + half])
    grid = OccupancyGrid(aabb, torch.zeros(config.nodes, config.nodes, config.nodes))
    nodes = grid.nodes().reshape(-1, 3)
    held = np.concatenate([projection_check(part, seen, config.agree) for part in nodes.split(_CHUNK)])
    return OccupancyGrid(aabb, torch.from_numpy(held).float().reshape(grid.values.shape))


def projection_check(nodes: Tensor, seen: Sequence[OldMask], agree: float) -> NDArray[np.bool_]:
    """Whether nodes (K, 3) lie in at least ``agree`` of the masks of those photos that see them, (K,).

    A node that more than 1 - ``agree`` of all photos have missed cannot pass any more and is not looked at again: most
    of the tripled box is out after a few photos.
    """
    sure = [(s, s.mask) for s in seen if s.mask is not None]
    misses, looks = np.zeros(len(nodes), np.int32), np.zeros(len(nodes), np.int32)
    left = np.arange(len(nodes))
    allowed = (1 - agree) * len(sure) + 1e-9
    for s, mask in sure:
        uv, inside = _projected(nodes[torch.from_numpy(left)], s.camera, s.frame.world_from_cam)
        at = uv[inside].long().numpy()
        rows = left[inside.numpy()]
        looks[rows] += 1
        misses[rows] += ~mask[at[:, 1], at[:, 0]]
        left = left[misses[left] <= allowed]
    return (looks > 0) & (misses <= (1 - agree) * looks + 1e-9)


def _projected(points: Tensor, camera: Camera, world_from_cam: Tensor) -> tuple[Tensor, Tensor]:
    """World points (K, 3) -> pixels (K, 2), and whether they are in the picture."""
    m = world_from_cam
    uv, z = camera.project((points - m[:3, 3].to(points.dtype)) @ m[:3, :3].to(points.dtype))
    size = uv.new_tensor([camera.width, camera.height])
    return uv, (z > 0) & (uv >= 0).all(-1) & (uv < size).all(-1)
