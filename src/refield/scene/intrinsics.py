"""The camera keys of a transforms.json: ``w h fl_x fl_y cx cy k1 …``, or fields of view ⇄ Camera."""

from __future__ import annotations

import math
from typing import Any

from refield.scene import images
from refield.scene.camera import Camera
from refield.scene.errors import InputError

MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL")
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
_UNSUPPORTED = ("k4", "k5", "k6")

Entry = dict[str, Any]


def read_camera(entry: Entry, where: str, size: tuple[int, int] | None) -> Camera:
    """The camera of one frame; missing w, h are the image's ``size``, a missing centre is the middle.

    Raises:
        InputError: a key is missing, no finite number or out of range, or the model is not supported.
    """
    model = entry.get("camera_model", "OPENCV")
    if model not in MODELS:
        remedy = f"undistort to one of {', '.join(MODELS)}"
        raise InputError(f"{where}: camera_model", f"{model!r} is not supported", remedy)
    if entry.get("is_fisheye"):
        raise InputError(f"{where}: is_fisheye", "fisheye cameras are not supported", "undistort the images")
    for key in _UNSUPPORTED:
        if number(entry, key, where, 0.0):
            raise InputError(f"{where}: {key}", "this distortion term is not supported", "undistort the images")
    width, height = _size(entry, where, size)
    fx, fy = _focal(entry, where, width, height)
    cx, cy = number(entry, "cx", where, width / 2), number(entry, "cy", where, height / 2)
    distortion = {key: number(entry, key, where, 0.0) for key in DISTORTION}
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, **distortion)


def write_camera(camera: Camera) -> Entry:
    """The same keys back."""
    out: Entry = {"camera_model": camera.model, "w": camera.width, "h": camera.height}
    out |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return out | {key: getattr(camera, key) for key in DISTORTION if camera.is_distorted}


def fitted(camera: Camera, size: tuple[int, int], where: str) -> Camera:
    """The camera on an image of ``size`` that may have been scaled; another aspect is another picture.

    Raises:
        InputError: width and height were scaled differently.
    """
    width, height = size
    if size == (camera.width, camera.height):
        return camera
    # rounding each side to whole pixels moves the ratio by half a pixel at either end
    if abs(width - camera.width * height / camera.height) >= 1 + width / camera.width / 2:
        what = f"the image has {width}x{height} pixels but w, h say {camera.width}x{camera.height}"
        remedy = "correct w and h, or give the image as it was calibrated (cropping and turning are not undone)"
        raise InputError(where, what, remedy)
    return camera.scaled(width, height)


def number(entry: Entry, key: str, where: str, default: float | None) -> float:
    """``entry[key]`` as a finite float.

    Raises:
        InputError: missing without a default, not a number, or beyond 1e12.
    """
    value = entry.get(key, default)
    if value is None:
        raise InputError(f"{where}: {key}", "is missing", f"add {key} to the frame or at the top of the file")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {key}", f"{value!r} is not a number", "write a plain number")
    if not abs(value) < 1e12:
        raise InputError(f"{where}: {key}", "is out of range", "write a plain number")
    return float(value)


def _size(entry: Entry, where: str, size: tuple[int, int] | None) -> tuple[int, int]:
    out = []
    for axis, key in enumerate(("w", "h")):
        value = number(entry, key, where, None if size is None else float(size[axis]))
        if value != round(value) or not 1 <= value <= 65535:
            raise InputError(f"{where}: {key}", f"{value:g} is not a number of pixels", "give a whole number")
        out.append(int(value))
    if out[0] * out[1] > images.MAX_PIXELS:
        raise InputError(f"{where}: w, h", f"{out[0]}x{out[1]} pixels are too many", "scale the images down")
    return out[0], out[1]


def _focal(entry: Entry, where: str, width: int, height: int) -> tuple[float, float]:
    """fl_x, fl_y or a field of view; one axis alone serves both (square pixels)."""
    found: dict[str, float] = {}
    for axis, pixels in (("x", width), ("y", height)):
        if f"fl_{axis}" in entry:
            found[axis] = number(entry, f"fl_{axis}", where, None)
        elif f"camera_angle_{axis}" in entry:
            angle = number(entry, f"camera_angle_{axis}", where, None)
            if not 0 < angle < math.pi:
                raise InputError(f"{where}: camera_angle_{axis}", f"{angle:g} is not in (0, pi)", "give radians")
            found[axis] = pixels / 2 / math.tan(angle / 2)
    if not found or ("x" not in found and "fl_y" in entry):
        raise InputError(f"{where}: fl_x", "no focal length is given", "add fl_x in pixels, or camera_angle_x")
    for axis, focal in found.items():
        if focal <= 0:
            raise InputError(f"{where}: fl_{axis}", f"{focal:g} is not a focal length", "give positive pixels")
    return found.get("x", found.get("y", 0.0)), found.get("y", found.get("x", 0.0))
