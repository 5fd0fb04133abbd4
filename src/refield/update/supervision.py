"""Which pixels may teach the helper, and in what colour (Fig. 12, §10.1.3).

New photos: every pixel whose ray meets the region. Old photos: a ring around where the objects were seen, without
what is there now and without the objects' shadow; a photo whose mask is unsure is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refield.field.pixels import PixelBank
from refield.field.radiance import Field
from refield.field.render import render_many
from refield.scene.capture import Frame, Rays, camera_rays
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.update.region import Region, meets
from refield.vision.pixels import dilate, fit_colours

_UNTOUCHED_MARGIN = 0.03  # of the width: changed areas grow by this before colours are compared across visits


@dataclass(frozen=True)
class Lessons:
    """Pixels that training may draw, as rays and the colours they should show."""

    rays: Rays
    rgb: Tensor
    """(N, 3) float32, in the old photos' exposure"""
    photo: Tensor
    """(N,) int64: index of the new photo, or -1 for an old one"""

    def __len__(self) -> int:
        return len(self.rgb)

    def __getitem__(self, chosen: Tensor) -> Lessons:
        return Lessons(self.rays[chosen], self.rgb[chosen], self.photo[chosen])


def old_ring(change: SceneChange, index: int, frame: Frame, shadow: float, far: float) -> Tensor | None:
    """Pixels of an old training photo that may teach, (H, W) bool; None if a mask of it is unsure (§10.1.3).

    ``shadow`` and ``far`` are the reach of the two dilations in image widths: around the objects' old masks, pixels
    beyond the first and within the second, where nothing moved in.
    """
    was = _seen(change, index, frame, old=True)
    now = _seen(change, index, frame, old=False)
    if was is None or now is None:
        return None
    width = frame.camera.width
    around = was if was.any() else now  # around a newcomer where nothing left
    added = [o for o in change.objects if o.kind == "added"]
    for o in added:
        around = around | _mask(o, o.masks_in, index, frame, o.grid)
    blocked = dilate(was, math.ceil(shadow * width)) | dilate(now, 1)
    return torch.from_numpy(dilate(around, math.ceil(far * width)) & ~blocked)


def _seen(change: SceneChange, index: int, frame: Frame, old: bool) -> np.ndarray | None:
    """All objects' masks at their old or new places in an old photo, (H, W); None if one is unsure."""
    total = np.zeros((frame.camera.height, frame.camera.width), bool)
    for o in change.objects:
        grid = (None if o.kind == "added" else o.grid) if old else o.grid_now
        if grid is None:
            continue
        masks = o.masks if old else o.masks_in
        if index < len(masks) and masks[index] is None:
            return None
        total |= _mask(o, masks, index, frame, grid)
    return total


def _mask(o: ObjectChange, masks: Sequence[Tensor | None], i: int, frame: Frame, grid: OccupancyGrid) -> np.ndarray:
    mask = masks[i] if i < len(masks) else None
    return (silhouette(grid, frame) if mask is None else mask).numpy()


def silhouette(grid: OccupancyGrid, frame: Frame) -> Tensor:
    """Where an occupancy grid projects in a photo, (H, W) bool."""
    region = Region((grid,))
    size = float((grid.aabb[1] - grid.aabb[0]).max())
    hit = meets(region.sampler(size / 100), camera_rays(frame.camera, frame.world_from_cam))
    return hit.reshape(frame.camera.height, frame.camera.width)


def changed_pixels(change: SceneChange, index: int, frame: Frame, margin: float = _UNTOUCHED_MARGIN) -> np.ndarray:
    """Pixels of a used new photo that show what arrived or what left, grown by ``margin`` widths, (H, W) bool."""
    total = np.zeros((frame.camera.height, frame.camera.width), bool)
    for o in change.objects:
        places = ([] if o.kind == "added" else [o.grid]) + ([o.grid_now] if o.grid_now is not None else [])
        for grid in places:
            total |= silhouette(grid, frame).numpy()
    for masks in (change.masks_in, change.masks_out):
        if index < len(masks):
            total |= masks[index].numpy()
    return dilate(total, math.ceil(margin * frame.camera.width))


def exposure(photo: Tensor, rendered: Tensor, changed: np.ndarray) -> Tensor:
    """Gain and offset a channel, (2, 3) float32, that bring a new photo to the old photos' colours.

    ``photo`` and ``rendered`` (H, W, 3) float32; fitted where nothing changed. Identity where it is within what a
    field's own error could feign.
    """
    still = torch.from_numpy(~changed)
    affine = fit_colours(photo[still][None].numpy(), rendered[still][None].numpy())
    affine = torch.from_numpy(affine).float()
    before = (photo[still] - rendered[still]).abs().median()
    after = (photo[still] * affine[0] + affine[1] - rendered[still]).abs().median()
    worth = before > 1.2 * after + 1e-3
    return affine if bool(worth) else torch.tensor([[1.0] * 3, [0.0] * 3])


def new_lessons(frames: Sequence[Frame], field: Field, change: SceneChange) -> tuple[Lessons, Tensor]:
    """Every pixel of the new photos, in the old photos' exposure, and what ``field`` shows there (N, 3).

    ``field`` is the old one with the objects cut out and moved.
    """
    bank = PixelBank(frames)
    everything = torch.arange(len(bank))
    rays, rgb = bank.rays(everything), bank.colours(everything)
    rendered = render_many(field, rays).rgb
    for i, frame in enumerate(frames):
        mine = slice(int(bank.starts[i]), int(bank.starts[i + 1]))
        shape = (frame.camera.height, frame.camera.width, 3)
        affine = exposure(rgb[mine].reshape(shape), rendered[mine].reshape(shape), changed_pixels(change, i, frame))
        rgb[mine] = (rgb[mine] * affine[0] + affine[1]).clamp(0, 1)
    return Lessons(rays, rgb, bank.frame_of(everything)), rendered
