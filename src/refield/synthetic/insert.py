"""Solids put into a photograph: cast, shaded and shadowed in linear light, hidden behind what was photographed.

The photograph's own look is kept: its exposure, blur and noise. Pixels that neither a solid nor its shadow reaches
stay as they are, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import camera_rays
from refield.scene.pose import invert, transform
from refield.scene.srgb import to_linear, to_srgb
from refield.synthetic.looks import Look
from refield.synthetic.shading import Light, shaded
from refield.synthetic.state import State
from refield.synthetic.visibility import Hits, first_hits

Window = tuple[slice, slice]
"""rows and columns of a picture"""
Shadow = Callable[[Tensor], Tensor]
"""world points (N, 3) -> the part of the light that still reaches them, (N,)"""

_FINE = 3  # rays a side of a pixel on an outline
_SHADOW_POINTS = 20_000  # a picture, at most; a soft shadow between them is interpolated
_LEAST_SHADE = 2e-3  # a darkening that 8 bits do not show


@dataclass(frozen=True)
class Shot:
    """A photograph, and how far off what it shows is."""

    image: Tensor
    """(H, W, 3) uint8"""
    camera: Camera
    world_from_cam: Tensor
    """(4, 4) float64"""
    surface: Tensor
    """(H, W) float32: distance of what was photographed, along the ray; inf where nothing is known"""
    limit: Tensor
    """(H, W) float32: what is farther off is hidden; ``surface`` and its uncertainty"""
    look: Look


@dataclass(frozen=True)
class Inserted:
    """A photograph with solids in it."""

    image: Tensor
    """(H, W, 3) uint8"""
    item: Tensor
    """(H, W) int64: the item that a pixel's centre shows; -1 for none"""
    depth: Tensor
    """(H, W) float32: of an item where one is seen, else of what was photographed"""


def inserted(shot: Shot, state: State, light: Light, shadow: Shadow, seed: int = 0) -> Inserted:
    """The photograph as if the items of ``state`` had been there. ``seed`` is of the grain on them."""
    height, width = shot.surface.shape
    seen = Inserted(shot.image, torch.full((height, width), -1), shot.surface)
    window = _window(shot, state, 0.0)
    if window is None:
        return seen
    item, depth, colour, alpha = _layer(shot, state, light, window)
    seen.item[window] = item
    picture = to_linear(shot.image.numpy().astype(np.float32) / np.float32(255))
    dark = _shade(shot, state, shadow)
    picture *= dark[..., None]
    over, cover = _blurred(shot, window, colour * shot.look.gain.numpy(), alpha)
    picture = picture * (1 - cover[..., None]) + over
    grain = np.random.default_rng(seed).normal(0, shot.look.noise, picture.shape) * cover[..., None]
    out = np.rint((to_srgb(picture) + grain).clip(0, 1) * 255).astype(np.uint8)
    touched = torch.from_numpy((cover > 0) | (dark < 1 - _LEAST_SHADE))
    image = torch.where(touched[..., None], torch.from_numpy(out), shot.image)
    distance = shot.surface.clone()
    distance[window] = torch.where(item >= 0, depth, distance[window])
    return Inserted(image, seen.item, distance)


def seen_in(shot: Shot, state: State) -> Tensor:
    """Which item each pixel's centre would show, as `Inserted.item`, without the picture itself."""
    item = torch.full(shot.surface.shape, -1)
    window = _window(shot, state, 0.0)
    if window is not None:
        rays = camera_rays(shot.camera, shot.world_from_cam, _centres(window))
        hits, limit = first_hits(state, rays), shot.limit[window]
        item[window] = torch.where(hits.depth.reshape(limit.shape) <= limit, hits.item.reshape(limit.shape), -1)
    return item


def _window(shot: Shot, state: State, margin: float) -> Window | None:
    """The part of the picture that holds the items, each with so many times its size around it."""
    corners = []
    for item in state.items:
        lo, hi = item.box()
        reach = margin * (hi - lo).norm()
        corners.append(torch.cartesian_prod(*torch.stack([lo - reach, hi + reach]).T))
    if not corners:
        return None
    camera = shot.camera
    pixels, z = camera.project(transform(invert(shot.world_from_cam), torch.cat(corners)))
    if not bool((z > 0).any()):
        return None
    if not bool((z > 0).all()):
        return slice(0, camera.height), slice(0, camera.width)
    spare = 3 + 4 * shot.look.blur
    lo, hi = (pixels.amin(0) - spare).floor().long().tolist(), (pixels.amax(0) + spare).ceil().long().tolist()
    x, y = (slice(max(lo[i], 0), min(hi[i], (camera.width, camera.height)[i])) for i in range(2))
    return (y, x) if x.start < x.stop and y.start < y.stop else None


def _layer(
    shot: Shot, state: State, light: Light, window: Window
) -> tuple[Tensor, Tensor, NDArray[np.float32], NDArray[np.float32]]:
    """Of a window (h, w): item seen and its depth; linear colour (h, w, 3), times alpha (h, w)."""
    pixels = _centres(window)
    limit = shot.limit[window].reshape(-1)
    item, hits, colour = _seen(shot, state, light, pixels, limit)
    alpha = (item >= 0).float()
    shape = (window[0].stop - window[0].start, window[1].stop - window[1].start)
    at = (_outline(item.reshape(shape)) | _outline(hits.item.reshape(shape))).reshape(-1)
    if at.any():
        steps = (torch.arange(_FINE, dtype=torch.float64) + 0.5) / _FINE - 0.5
        offsets = torch.cartesian_prod(steps, steps)
        fine = (pixels[at][:, None] + offsets).reshape(-1, 2)
        within, _, paint = _seen(shot, state, light, fine, limit[at].repeat_interleave(_FINE**2))
        colour[at] = paint.reshape(-1, _FINE**2, 3).mean(1)
        alpha[at] = (within >= 0).float().reshape(-1, _FINE**2).mean(1)
    return (
        item.reshape(shape),
        hits.depth.reshape(shape),
        colour.reshape(*shape, 3).numpy(),
        alpha.reshape(shape).numpy(),
    )


def _seen(shot: Shot, state: State, light: Light, pixels: Tensor, limit: Tensor) -> tuple[Tensor, Hits, Tensor]:
    """Of pixels (N, 2): the item seen (N,), the first one along the ray whatever is in front of it, and the linear
    colour (N, 3) of what is seen, black where none is."""
    rays = camera_rays(shot.camera, shot.world_from_cam, pixels)
    hits = first_hits(state, rays)
    item = torch.where(hits.depth <= limit, hits.item, -1)
    colour = torch.zeros(len(pixels), 3)
    for i in torch.unique(item[item >= 0]).tolist():
        mine = item == i
        points = rays.origins[mine].double() + rays.directions[mine].double() * hits.depth[mine, None].double()
        colour[mine] = shaded(state, i, points, rays.directions[mine].double(), light).float()
    return item, hits, colour


def _outline(item: Tensor) -> Tensor:
    """Pixels (h, w) with a neighbour that shows something else."""
    image = item.numpy().astype(np.int16)
    cross = np.ones((3, 3), np.uint8)
    return torch.from_numpy(cv2.dilate(image, cross) != cv2.erode(image, cross))


def _centres(window: Window, stride: int = 1) -> Tensor:
    """Pixel centres (N, 2) of a window, row by row; with a stride those of its blocks."""
    rows, columns = (torch.arange(s.start, s.stop, stride, dtype=torch.float64) + stride / 2 for s in window)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2)


def _shade(shot: Shot, state: State, shadow: Shadow) -> NDArray[np.float32]:
    """(H, W): by how much the items darken what was photographed."""
    height, width = shot.surface.shape
    out = np.ones((height, width), np.float32)
    window = _window(shot, state, 1.5)
    if window is None:
        return out
    size = (window[0].stop - window[0].start) * (window[1].stop - window[1].start)
    stride = max(1, round((size / _SHADOW_POINTS) ** 0.5))
    pixels = _centres(window, stride)
    rays = camera_rays(shot.camera, shot.world_from_cam, pixels)
    at = pixels.long()
    depth = shot.surface[at[:, 1].clamp(max=height - 1), at[:, 0].clamp(max=width - 1)]
    known = depth.isfinite()
    factor = torch.ones(len(pixels))
    factor[known] = shadow(rays.origins[known] + rays.directions[known] * depth[known, None]).float()
    blocks = tuple(-(-(s.stop - s.start) // stride) for s in window)
    coarse = factor.reshape(blocks).numpy()
    full = cv2.resize(coarse, (blocks[1] * stride, blocks[0] * stride), interpolation=cv2.INTER_LINEAR)
    out[window] = full[: window[0].stop - window[0].start, : window[1].stop - window[1].start]
    return out


def _blurred(
    shot: Shot, window: Window, colour: NDArray[np.float32], alpha: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colour times alpha and alpha in the whole picture, as blurred as the photo."""
    height, width = shot.surface.shape
    over, cover = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    if shot.look.blur > 0:
        colour = np.asarray(
            cv2.GaussianBlur(colour, (0, 0), shot.look.blur, borderType=cv2.BORDER_REPLICATE), np.float32
        )
        alpha = np.asarray(cv2.GaussianBlur(alpha, (0, 0), shot.look.blur, borderType=cv2.BORDER_REPLICATE), np.float32)
    over[window], cover[window] = colour, np.where(alpha < _LEAST_SHADE, 0, alpha)
    over[cover == 0] = 0
    return over, cover
