"""The cameras around the points, from above and from the side, as one picture."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from refield.scene.capture import Capture, Frame, centres
from refield.scene.world import World

_SIDE, _CAPTION, _FINER = 640, 28, 2
_CAMERA, _HELD_OUT, _INK, _PAPER = (217, 95, 2), (117, 112, 179), (60, 60, 67), (255, 255, 255)
_MOST_POINTS = 20_000


def camera_picture(capture: Capture, world: World) -> Tensor:
    """(H, W, 3) uint8: points in grey, each camera as the pyramid it sees through; the same scale in both halves."""
    axes = _axes(world)
    at = centres(capture.frames)
    middle, reach = _shown(at, capture.points.double())
    halves = [
        _half(capture, (axes[0], axes[1]), middle, reach),
        _half(capture, (axes[0], -axes[2]), middle, reach),
    ]
    sheet = Image.new("RGB", (2 * _SIDE + 8, _SIDE + _CAPTION), _PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(15)
    for i, half in enumerate(halves):
        sheet.paste(half, (i * (_SIDE + 8), _CAPTION))
    unit = 10 ** math.floor(math.log10(max(reach, 1e-12)))
    above = f"from above: {len(capture.frames)} cameras (violet: held out), {len(capture.points)} points"
    draw.text((8, 6), above, fill=_INK, font=font)
    side = f"from the side; the bar is {unit:g} unit{'' if unit == 1 else 's'}"
    draw.text((_SIDE + 16, 6), side, fill=_INK, font=font)
    length = unit / reach * _SIDE / 2
    draw.line([(2 * _SIDE - length - 8, 20), (2 * _SIDE - 8, 20)], fill=_INK, width=3)
    return torch.from_numpy(np.array(sheet))


def _axes(world: World) -> Tensor:
    """(3, 3): right, away and up, rows."""
    up = torch.tensor(world.up, dtype=torch.float64)
    other = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    right = torch.nn.functional.normalize(torch.linalg.cross(other, up), dim=0)
    return torch.stack([right, torch.linalg.cross(right, up), up])


def _shown(at: Tensor, points: Tensor) -> tuple[Tensor, float]:
    """Middle and half side of what is shown: all cameras, and the points but for those far out."""
    inner = at
    if len(points) > 10:
        middle = points.median(0).values
        near = (points - middle).norm(dim=1)
        inner = torch.cat([at, points[near <= near.quantile(0.9) if len(near) < 1e6 else near <= near.mean() * 2]])
    low, high = inner.min(0).values, inner.max(0).values
    return (low + high) / 2, max(float((high - low).max()) / 2 * 1.08, 1e-9)


def _half(capture: Capture, axes: tuple[Tensor, Tensor], middle: Tensor, reach: float) -> Image.Image:
    size = _SIDE * _FINER
    plane = torch.stack(axes)

    def on_paper(points: Tensor) -> NDArray[np.float64]:
        return (((points - middle) @ plane.T / reach + 1) * size / 2).numpy()

    half = Image.fromarray(_cloud(on_paper(capture.points[:: _step(capture)].double()), size))
    draw = ImageDraw.Draw(half)
    held_out = {frame.name for frame in capture.held_out}
    for frame in capture.frames:
        corners = on_paper(_pyramid(frame, reach * 0.05))
        ink = _HELD_OUT if frame.name in held_out else _CAMERA
        for k in range(4):
            draw.line([tuple(corners[0]), tuple(corners[1 + k])], fill=ink, width=_FINER)
            draw.line([tuple(corners[1 + k]), tuple(corners[1 + (k + 1) % 4])], fill=ink, width=_FINER)
    draw.rectangle([0, 0, size - 1, size - 1], outline=(210, 210, 215), width=_FINER)
    return half.resize((_SIDE, _SIDE), Image.Resampling.LANCZOS)


def _step(capture: Capture) -> int:
    return max(len(capture.points) // _MOST_POINTS, 1)


def _cloud(xy: NDArray[np.float64], size: int) -> NDArray[np.uint8]:
    """Points as dots that grow darker where there are many."""
    paper = np.zeros((size, size), np.float32)
    at = np.floor(xy).astype(np.int64)
    at = at[((at >= 1) & (at < size - 2)).all(1)]
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        np.add.at(paper, (at[:, 1] + dy, at[:, 0] + dx), 1.0)
    grey = 255 - 175 * (1 - np.exp(-0.6 * paper))
    return np.repeat(grey[..., None], 3, 2).astype(np.uint8)


def _pyramid(frame: Frame, length: float) -> Tensor:
    """(5, 3): the camera's centre and the corners of what it sees, ``length`` away."""
    c = frame.camera
    corners = torch.tensor([[0.0, 0], [c.width, 0], [c.width, c.height], [0, c.height]], dtype=torch.float64)
    rays = c.unproject(corners) @ frame.world_from_cam[:3, :3].T
    return torch.cat([frame.centre[None], frame.centre + length * rays])
