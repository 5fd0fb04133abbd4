"""nerfstudio's and instant-ngp's ``transforms.json`` ⇄ Capture. The only file that knows OpenGL axes.

In the file a camera looks along its -z with +y up; inside, along +z with +y down. The world is
the file's own.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from refield.scene import images, ply
from refield.scene.capture import Capture, Frame
from refield.scene.errors import InputError
from refield.scene.files import inside, log_warning, read_json, write_json
from refield.scene.intrinsics import FOCAL, Entry, fitted, number, read_camera, write_camera
from refield.scene.left_out import LeftOut, Warn, named
from refield.scene.pose import nearest_rotation

NAME = "transforms.json"
ROTATION_TOLERANCE = 1e-3
"""Frobenius norm of RᵀR - I above which a matrix is refused; below it the nearest rotation is taken."""
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # OpenGL camera axes ⇄ OpenCV's


def load_transforms(path: Path, *, warn: Warn = log_warning, decode: bool = True) -> Capture:
    """The capture described by a transforms.json, or by the one in a folder.

    Images that are missing, doubled or (up to a tenth) unreadable are left out and named through ``warn``,
    as is a rescaling of intrinsics to images of another size. Without ``decode`` only headers are looked at.

    Raises:
        InputError: the file, a frame's key, pose, camera or path is unusable, or no image is left.
    """
    json_path, data = _read(path)
    entries, frames, left_out = list(_unique(json_path, data, warn)), [], LeftOut(decode)
    for entry in entries:
        image = _find_image(json_path, entry)
        size = left_out.size_of(image, entry["file_path"])
        if image is not None and size is not None:
            frames.append(_frame(json_path, entry, image, size))
    left_out.report(json_path, len(entries), warn)
    _report_rescaled(json_path, entries, frames, warn)
    return Capture(frames=tuple(frames), points=_points(json_path, data))


def load_photos(path: Path, *, warn: Warn = log_warning) -> list[Frame]:
    """The few new photos of a transforms.json, placed; each counts, so one that cannot be used is an error.

    Raises:
        InputError: as `load_transforms`, and for any missing or unreadable image.
    """
    json_path, data = _read(path)
    entries, frames = list(_unique(json_path, data, warn)), []
    for entry in entries:
        image = _find_image(json_path, entry)
        if image is None:
            raise InputError(_where(json_path, entry), "there is no such image", "add it or remove the frame")
        images.read_image(image)  # a truncated photo is found here, before any work
        frames.append(_frame(json_path, entry, image, images.read_size(image)))
    _report_rescaled(json_path, entries, frames, warn)
    return frames


def load_cameras(path: Path, *, warn: Warn = log_warning) -> list[Frame]:
    """Views to render: as `load_photos`, but the images need not exist where the file gives w and h."""
    json_path, data = _read(path)
    frames = []
    for entry in _unique(json_path, data, warn):
        image = None if "w" in entry and "h" in entry else _find_image(json_path, entry)
        size = None if image is None else images.read_size(image)
        frames.append(_frame(json_path, entry, image or json_path.parent / entry["file_path"], size))
    return frames


def save_transforms(path: Path, capture: Capture) -> None:
    """Write a capture as ``path`` (or ``path/transforms.json``); its images must lie in that folder or below.

    SfM points go to ``points.ply`` beside it.
    """
    json_path = path / NAME if path.is_dir() else path
    root = json_path.parent.resolve()
    one_camera = len({frame.camera for frame in capture.frames}) == 1
    out: dict[str, Any] = write_camera(capture.frames[0].camera) if one_camera else {}
    if len(capture.points):
        ply.write_points(json_path.parent / "points.ply", capture.points)
        out["ply_file_path"] = "points.ply"
    out["frames"] = [
        {
            "file_path": frame.path.resolve().relative_to(root).as_posix(),
            **({} if one_camera else write_camera(frame.camera)),
            "transform_matrix": opengl_pose(frame.world_from_cam).tolist(),
        }
        for frame in capture.frames
    ]
    write_json(json_path, out)


def opengl_pose(world_from_cam: Tensor) -> Tensor:
    """A pose (4, 4) of OpenCV camera axes as one of OpenGL's, which Blender and glTF have too; float64."""
    return world_from_cam.double().cpu() @ _FLIP


def stem(frame: Frame) -> str:
    """The name a picture of this view is written under: the file's name without an image suffix."""
    return stem_of(frame.name)


def stem_of(name: str) -> str:
    """The same of a photo's name."""
    name = PurePosixPath(name.replace("\\", "/")).name
    known = (*images.SUFFIXES, ".exr", ".hdr", ".heic", ".heif", ".hif", ".avif", ".gif")
    return name[: -len(PurePosixPath(name).suffix)] if name.lower().endswith(known) else name


def checked_pose(matrix: Tensor, where: str) -> Tensor:
    """A (4, 4) float64 matrix if it is a rigid motion within tolerance, its rotation made exact.

    Raises:
        InputError: the last row is not 0 0 0 1, or the 3x3 part is scaled, sheared or mirrored.
    """
    rotation = matrix[:3, :3]
    if (matrix[3] - torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=matrix.dtype)).abs().max() > 1e-9:
        raise InputError(where, "its last row is not 0 0 0 1", "give a rigid camera-to-world matrix")
    off = float((rotation.T @ rotation - torch.eye(3, dtype=matrix.dtype)).norm())
    if off > ROTATION_TOLERANCE:
        what = f"its 3x3 part is no rotation (off by {off:.2g})"
        raise InputError(where, what, "remove scale and shear from it")
    if torch.linalg.det(rotation) < 0:
        raise InputError(where, "its 3x3 part is mirrored (determinant -1)", "flip one camera axis")
    out = matrix.clone()
    out[:3, :3] = nearest_rotation(rotation)
    return out


def _read(path: Path) -> tuple[Path, dict[str, Any]]:
    """The file's path and contents, with its list of frames checked for shape."""
    json_path = path / NAME if path.is_dir() else path
    data = read_json(json_path)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{json_path}: frames", "no list of frames is given", "list the photos under 'frames'")
    for i, entry in enumerate(frames):
        where = f"{json_path}: frames[{i}]"
        if not isinstance(entry, dict):
            raise InputError(where, "is not an object", "write {file_path: …, transform_matrix: …}")
        if not isinstance(entry.get("file_path"), str):
            raise InputError(f"{where}: file_path", "is missing or not text", "name the frame's image")
    return json_path, data


def _unique(json_path: Path, data: dict[str, Any], warn: Warn) -> Iterator[Entry]:
    """The frames with the shared intrinsics filled in; one named twice is left out and reported."""
    shared = {k: v for k, v in data.items() if k not in ("frames", "file_path", "transform_matrix")}
    seen: set[PurePosixPath] = set()
    twice = []
    for entry in data["frames"]:
        name = PurePosixPath(entry["file_path"])
        if name in seen:
            twice.append(str(name))
            continue
        seen.add(name)
        yield _merged(shared, entry)
    if twice:
        warn(f"{json_path}: listed twice, only the first of each is used: {named(twice)}")


def _merged(shared: Entry, entry: Entry) -> Entry:
    """A frame's own intrinsics win; its own focal length also hides a shared one given in another form."""
    own = any(key in entry for key in FOCAL)
    return {**{k: v for k, v in shared.items() if not (own and k in FOCAL)}, **entry}


def _where(json_path: Path, entry: Entry) -> str:
    return f"{json_path}: frame {entry['file_path']!r}"


def _find_image(json_path: Path, entry: Entry) -> Path | None:
    """The frame's image: as named, with a suffix added, or in ``images/`` (instant-ngp); None without one."""
    name, where = entry["file_path"], _where(json_path, entry)
    for folder in ("", "images"):
        for suffix in ("", *images.SUFFIXES, *(s.upper() for s in images.SUFFIXES)):
            path = inside(json_path.parent, str(PurePosixPath(folder, name + suffix)), where)
            if path.is_file():
                return path
    return None


def _frame(json_path: Path, entry: Entry, image: Path, size: tuple[int, int] | None) -> Frame:
    where = _where(json_path, entry)
    camera = read_camera(entry, where, size)
    camera = camera if size is None else fitted(camera, size, where)
    return Frame(path=image, camera=camera, name=entry["file_path"], world_from_cam=_pose(entry, where))


def _pose(entry: Entry, where: str) -> Tensor:
    """transform_matrix, 4x4 or 3x4, as ``world_from_cam`` in OpenCV axes."""
    where = f"{where}: transform_matrix"
    rows = entry.get("transform_matrix")
    if rows is None:
        raise InputError(where, "is missing", "add the camera-to-world matrix (OpenGL camera axes)")
    if not (isinstance(rows, list) and len(rows) in (3, 4) and all(isinstance(r, list) and len(r) == 4 for r in rows)):
        raise InputError(where, "is not a 4x4 or 3x4 matrix", "write it as a list of rows")
    numbers = [[number({"entry": v}, "entry", where, None) for v in row] for row in rows]
    matrix = torch.tensor(numbers + [[0.0, 0.0, 0.0, 1.0]] * (4 - len(rows)), dtype=torch.float64)
    return checked_pose(matrix, where) @ _FLIP


def _points(json_path: Path, data: dict[str, Any]) -> Tensor:
    """nerfstudio's optional ``ply_file_path``: the SfM points in the file's world."""
    name = data.get("ply_file_path")
    if not isinstance(name, str):
        return torch.zeros(0, 3)
    path = inside(json_path.parent, name, f"{json_path}: ply_file_path")
    return ply.read_points(path) if path.is_file() else torch.zeros(0, 3)


def _report_rescaled(json_path: Path, entries: list[Entry], frames: list[Frame], warn: Warn) -> None:
    given = {e["file_path"]: (e.get("w"), e.get("h")) for e in entries}
    for frame in frames:
        w, h = given[frame.name]
        now = (frame.camera.width, frame.camera.height)
        if w is not None and h is not None and (w, h) != now:
            warn(f"{json_path}: intrinsics given for {w}x{h} are scaled to the images' {now[0]}x{now[1]}")
            return
