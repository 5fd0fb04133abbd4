"""What real photos suffer and rendered ones do not: exposure, colour cast, vignetting, noise, blur,
JPEG, a pose a little off.

Each photo and each effect has its own random stream, so an effect that is switched on changes no other.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Frame
from refield.scene.errors import InputError
from refield.scene.images import frame_image, write_image
from refield.scene.load import load_capture
from refield.scene.pose import exp, invert, transform
from refield.scene.srgb import to_linear, to_srgb
from refield.scene.transforms_json import NAME, save_transforms
from refield.synthetic.state import Triple
from refield.synthetic.textures import blurred

_MID_GREY = 0.214  # linear; 0.5 on the sRGB curve
_SHOT = 0.95  # part of the noise's variance at mid grey that grows with the light; the rest is read noise
_GRID = 16  # points a side over which a pose error is measured
_ROUNDS, _EXACT = 50, 1e-10


@dataclass(frozen=True)
class Disturbance:
    """How strong each effect is; 0 (None for ``jpeg``) leaves it out."""

    exposure: float = 0.0
    """stops, standard deviation of a photo's gain; in linear light, what is too bright is clipped"""
    white_balance: float = 0.0
    """standard deviation of the logarithm of each channel's gain; the three multiply to 1"""
    noise: float = 0.0
    """of the sensor: standard deviation at mid grey on the sRGB curve in [0, 1]; shot and read noise"""
    blur: float = 0.0
    """pixels, standard deviation of a Gaussian"""
    pose_px: float = 0.0
    """pixels, root mean square over the picture by which a wrong pose displaces points at the scene's distance"""
    jpeg: int | None = None
    """quality, 1 to 100; the picture is compressed once, and stored as it looks then"""
    seed: int = 0
    vignetting: float = 0.0
    """part of the light lost in the corners, in every photo the same; it falls with the square of the radius"""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and value < 0:
                raise InputError(field.name, f"is {value}", "give 0 or more")
        if self.vignetting > 1:
            raise InputError("vignetting", f"is {self.vignetting}", "give at most 1")
        if self.jpeg is not None and not 1 <= self.jpeg <= 100:
            raise InputError("jpeg", f"is {self.jpeg}", "give a quality from 1 to 100")


def disturbed(capture_folder: Path, out: Path, disturbance: Disturbance, target: Triple = (0, 0, 0.15)) -> None:
    """Write a capture to the new folder ``out``, its photos and poses disturbed.

    Whatever else the folder holds (masks, depths) is copied: it belongs to the true poses. ``target`` is the
    point, world, whose distance from a camera is taken for the scene's.

    Raises:
        InputError: ``out`` is there already or lies in the capture, or the capture cannot be read.
    """
    capture_folder, out = capture_folder.resolve(), out.resolve()
    if out.exists() or out.is_relative_to(capture_folder):
        raise InputError(out, "is there already, or in the capture", "choose a new folder beside the capture")
    capture = load_capture(capture_folder)
    ours = {frame.path.resolve() for frame in capture.frames} | {capture_folder / NAME}
    shutil.copytree(capture_folder, out, ignore=lambda at, names: [n for n in names if Path(at, n).resolve() in ours])
    frames = []
    for frame in capture.frames:
        path = (out / frame.path.resolve().relative_to(capture_folder)).with_suffix(".png")
        write_image(path, disturbed_photo(frame_image(frame), disturbance, frame.name))
        distance = float((frame.centre - frame.centre.new_tensor(target)).norm())
        frames.append(replace(frame, path=path, world_from_cam=disturbed_pose(frame, disturbance, distance)))
    save_transforms(out / NAME, replace(capture, frames=tuple(frames)))


def disturbed_photo(image: Tensor, disturbance: Disturbance, name: str) -> Tensor:
    """A photo (H, W, 3) uint8 as a worse camera takes it, same shape; ``name`` chooses the random stream."""
    light = to_linear(image.numpy().astype(np.float32) / np.float32(255))
    if disturbance.blur > 0:
        light = blurred(light, disturbance.blur)
    light = light * gains(disturbance, name) * falloff(disturbance, image.shape[0], image.shape[1])
    light = light + _sensor_noise(light, disturbance, _stream(disturbance, "noise", name))
    pixels = np.rint(to_srgb(light) * 255).astype(np.uint8)  # what is too bright is clipped here
    return torch.from_numpy(pixels if disturbance.jpeg is None else _compressed(pixels, disturbance.jpeg))


def gains(disturbance: Disturbance, name: str) -> NDArray[np.float32]:
    """(3,) linear gains of a photo's channels: its exposure times its white balance."""
    stops = disturbance.exposure * _stream(disturbance, "exposure", name).normal()
    cast = disturbance.white_balance * _stream(disturbance, "white_balance", name).normal(size=3)
    return (2.0**stops * np.exp(cast - cast.mean())).astype(np.float32)


def falloff(disturbance: Disturbance, height: int, width: int) -> NDArray[np.float32]:
    """(H, W, 1) part of the light that reaches each pixel: 1 in the middle, 1 - ``vignetting`` in the corners."""
    v, u = ((np.arange(n) + 0.5) / n * 2 - 1 for n in (height, width))
    squared = (height * v[:, None]) ** 2 + (width * u[None]) ** 2
    return (1 - disturbance.vignetting * squared / (height**2 + width**2))[..., None].astype(np.float32)


def disturbed_pose(frame: Frame, disturbance: Disturbance, distance: float) -> Tensor:
    """world_from_cam (4, 4) float64, turned and shifted at random by exactly ``pose_px`` at ``distance``.

    Raises:
        ValueError: no such pose is found, because the error asked for is of the picture's own size.
    """
    if disturbance.pose_px == 0:
        return frame.world_from_cam
    draw = _stream(disturbance, "pose_px", frame.name).normal(size=6)
    # a turn and a shift of distance times as much move the scene's points about equally
    twist = 1e-6 * torch.from_numpy(draw) * torch.tensor([distance] * 3 + [1.0] * 3, dtype=torch.float64)
    for _ in range(_ROUNDS):
        factor = disturbance.pose_px / displacement(frame.camera, exp(twist), distance)
        twist = factor * twist
        if abs(factor - 1) < _EXACT:
            return frame.world_from_cam @ exp(twist)
    raise ValueError(f"{frame.name}: no pose is {disturbance.pose_px} pixels off")


def displacement(camera: Camera, true_from_wrong: Tensor, distance: float) -> float:
    """Pixels, root mean square: how far points ``distance`` along each ray appear from their true pixels.

    ``true_from_wrong`` (4, 4) float64 carries the wrong camera's axes to the true one's.
    """
    part = (torch.arange(_GRID, dtype=torch.float64) + 0.5) / _GRID
    pixels = torch.cartesian_prod(part * camera.width, part * camera.height)
    points = camera.unproject(pixels) * distance
    moved, _ = camera.project(transform(invert(true_from_wrong), points))
    return float((moved - pixels).square().sum(-1).mean().sqrt())


def _stream(disturbance: Disturbance, effect: str, name: str) -> np.random.Generator:
    return np.random.default_rng([disturbance.seed, *f"{effect} {name}".encode()])


def _sensor_noise(
    light: NDArray[np.float32], disturbance: Disturbance, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Linear noise (H, W, 3) whose variance rises with the light."""
    slope = 1.055 / 2.4 * _MID_GREY ** (1 / 2.4 - 1)  # of the sRGB curve at mid grey
    std = disturbance.noise / slope * np.sqrt(_SHOT * light / _MID_GREY + 1 - _SHOT)
    return (std * rng.normal(size=light.shape)).astype(np.float32)


def _compressed(pixels: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    _, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    seen = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert seen is not None  # what was encoded just now decodes
    return np.ascontiguousarray(seen[..., ::-1]).astype(np.uint8)
