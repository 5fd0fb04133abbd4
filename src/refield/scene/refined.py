"""What a fit found out about photos, beside what their capture says: ``refined.json``.

The capture's own file stays as it was given; reading puts the two together.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, centres
from refield.scene.errors import InputError
from refield.scene.exposure import Exposure
from refield.scene.files import read_json, write_json
from refield.scene.pose import invert, transform

NAME = "refined.json"


def write_refined(path: Path, given: Capture, found: Capture) -> None:
    """Note in what the frames of ``found`` differ from those of ``given``, which are of the same names; no file if in
    nothing."""
    before = {f.name: f for f in given.frames}
    entries = {f.name: entry for f in found.frames if (entry := _entry(before[f.name], f))}
    if entries:
        write_json(path, {"frames": entries})


def refined(capture: Capture, path: Path) -> Capture:
    """The capture with what `write_refined` noted; itself without the file.

    Raises:
        InputError: the file does not describe the capture's frames.
    """
    if not path.is_file():
        return capture
    entries = read_json(path).get("frames")
    if not isinstance(entries, dict):
        raise InputError(path, "holds no frames", "train again")
    strange = entries.keys() - {f.name for f in capture.frames}
    if strange:
        raise InputError(path, f"does not describe the photos ({min(strange)} is none of them)", "train again")
    try:
        frames = tuple(_refined(f, entries[f.name]) if f.name in entries else f for f in capture.frames)
    except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise InputError(path, f"does not describe the photos ({error})", "train again") from None
    return replace(capture, frames=frames)


def in_words(given: Capture, found: Capture) -> str:
    """One line: in what the frames of ``found`` differ from those of ``given``, which are of the same names; "" if in
    nothing."""
    before = {f.name: f for f in given.frames}
    pairs = [(before[f.name], f) for f in found.frames]
    stops = [f.exposure.stops for _, f in pairs if f.exposure is not None]
    said = []
    if any(f.exposure != g.exposure for g, f in pairs):
        said.append(f"exposures differ by up to {max(stops) - min(stops):.1f} stops")
    moved = [(g, f) for g, f in pairs if not torch.equal(g.world_from_cam, f.world_from_cam)]
    if moved:
        far = (centres(given.frames) - centres(given.frames).mean(0)).norm(dim=-1).median()
        pixels = torch.stack([_moved(g, f, float(far)) for g, f in moved]).median()
        said.append(f"poses moved by {float(pixels):.1f} pixels (median)")
    focal = max(abs(f.camera.fx / g.camera.fx - 1) for g, f in pairs)
    if any(f.camera != g.camera for g, f in pairs):
        said.append(f"focal lengths changed by up to {100 * focal:.1f} %")
    return "; ".join(said)


def _moved(given: Frame, found: Frame, depth: float) -> Tensor:
    """By how many pixels four points of the picture, that far away, move with the pose, ()."""
    c = given.camera
    pixels = torch.tensor([[x * c.width, y * c.height] for x in (0.25, 0.75) for y in (0.25, 0.75)]).double()
    points = transform(given.world_from_cam, c.unproject(pixels) * depth)
    return (c.project(transform(invert(found.world_from_cam), points))[0] - pixels).norm(dim=-1).mean()


def _entry(given: Frame, found: Frame) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if not torch.equal(found.world_from_cam, given.world_from_cam):
        out["world_from_cam"] = found.world_from_cam.tolist()
    if found.camera != given.camera:
        out["camera"] = asdict(found.camera)
    if found.exposure is not None and found.exposure != given.exposure:
        out["exposure"] = asdict(found.exposure)
    return out


def _refined(frame: Frame, entry: dict[str, Any]) -> Frame:
    if not isinstance(entry, dict):
        raise ValueError(f"{frame.name} is not described by names")
    pose, camera, exposure = frame.world_from_cam, frame.camera, frame.exposure
    if "world_from_cam" in entry:
        pose = torch.tensor(entry["world_from_cam"], dtype=torch.float64).reshape(4, 4)
        if not bool(pose.isfinite().all()):
            raise ValueError(f"{frame.name} is nowhere")
    if "camera" in entry:
        camera = Camera(**entry["camera"])
        if not all(isinstance(v, int | float) and math.isfinite(v) for v in asdict(camera).values()):
            raise ValueError(f"the lens of {frame.name} is not described by numbers")
        if (camera.width, camera.height) != (frame.camera.width, frame.camera.height):
            raise ValueError(f"{frame.name} is of another size")
    if "exposure" in entry:
        exposure = Exposure(_three(entry["exposure"]["gains"]), _three(entry["exposure"]["vignetting"]))
        if min(exposure.gains) <= 0:
            raise ValueError(f"{frame.name} has a gain that is none")
    return replace(frame, world_from_cam=pose, camera=camera, exposure=exposure)


def _three(values: Any) -> tuple[float, float, float]:
    a, b, c = (float(v) for v in values)
    if not all(math.isfinite(v) for v in (a, b, c)):
        raise ValueError("a number that is not finite")
    return a, b, c
