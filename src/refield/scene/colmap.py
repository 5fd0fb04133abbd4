"""A COLMAP model (text or binary, read by pycolmap) ⇄ Capture with its points.

COLMAP's axes and pixel centres (0.5, 0.5) are ours; its poses are ``cam_from_world``.
"""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.errors import InputError
from refield.scene.files import inside, log_warning
from refield.scene.intrinsics import fitted
from refield.scene.left_out import LeftOut, Warn
from refield.scene.pose import invert, rigid

PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""The models understood, with the order of their parameters; others are refused by name."""


def find_models(folder: Path) -> list[Path]:
    """Folders below ``folder`` (itself, sparse/*, colmap/sparse/*) that hold a COLMAP model."""
    places = [folder, folder / "sparse", folder / "colmap" / "sparse"]
    places += [p for base in places[1:] for p in sorted(base.glob("*"))]
    return [p for p in places if (p / "cameras.bin").is_file() or (p / "cameras.txt").is_file()]


def load_colmap(folder: Path, *, images_folder: Path | None = None, warn: Warn = log_warning) -> Capture:
    """The largest model found in ``folder``, with the images in ``images/`` beside it.

    Raises:
        InputError: no model, an unreadable one, an unsupported camera, or images that do not fit.
    """
    model_path, model = _largest(folder, warn)
    root = images_folder or _images_folder(folder, model_path)
    frames, left_out = [], LeftOut()
    registered = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    for image in registered:
        where = f"{model_path}: image {image.name!r}"
        camera = camera_of(model.cameras[image.camera_id], where)
        path = inside(root, image.name, where)
        size = left_out.size_of(path, image.name)
        if size is not None:
            frames.append(Frame(path, fitted(camera, size, where), image.name, world_from_cam_of(image)))
    left_out.report(model_path, len(registered), warn)
    _report_rescaled(model_path, model, frames, warn)
    return Capture(tuple(frames), points=points_of(model))


def save_colmap(folder: Path, capture: Capture, *, text: bool = False) -> None:
    """Write a capture's cameras, poses and points as a COLMAP model into ``folder`` (images are not copied)."""
    pycolmap = quiet_pycolmap()
    model = pycolmap.Reconstruction()
    known: dict[Camera, int] = {}
    for index, frame in enumerate(capture.frames, start=1):
        if frame.camera not in known:
            known[frame.camera] = len(known) + 1
            model.add_camera_with_trivial_rig(colmap_camera(pycolmap, frame.camera, known[frame.camera]))
        image = pycolmap.Image(name=frame.path.name, camera_id=known[frame.camera], image_id=index)
        pose = invert(frame.world_from_cam)[:3].numpy()
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.ascontiguousarray(pose)))
    for point in capture.points.double().numpy():
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write)(str(folder))


def quiet_pycolmap() -> Any:
    """The module, quiet, and without the handler of SIGTERM that it installs: it would kill before we clear up."""
    import pycolmap

    pycolmap.logging.minloglevel = 2  # its progress lines would drown ours
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    return pycolmap


def _largest(folder: Path, warn: Warn) -> tuple[Path, Any]:
    """The model with the most registered images, and its folder."""
    pycolmap = quiet_pycolmap()
    models = []
    for path in find_models(folder):
        try:
            models.append((path, pycolmap.Reconstruction(str(path))))
        except Exception as error:  # the reader raises several C++ types; all mean an unusable file
            reason = str(error).strip().splitlines()[-1][-120:] if str(error).strip() else type(error).__name__
            raise InputError(path, f"is not a readable COLMAP model ({reason})", "export the model again") from None
    if not models:
        raise InputError(folder, "holds no COLMAP model", "give a folder with sparse/0/cameras.bin or .txt")
    path, model = max(models, key=lambda m: m[1].num_reg_images())
    if model.num_reg_images() == 0:
        raise InputError(path, "the COLMAP model has no registered image", "run the reconstruction again")
    if len(models) > 1:
        sizes = ", ".join(f"{p.name}: {m.num_reg_images()}" for p, m in models)
        warn(f"{folder}: {len(models)} COLMAP models (registered images: {sizes}); {path.name} is used")
    return path, model


def _images_folder(folder: Path, model_path: Path) -> Path:
    """``images/`` in the folder given or above the model, else the folder itself."""
    for place in (folder, *list(model_path.parents)[:3]):
        if (place / "images").is_dir():
            return place / "images"
    return folder


def camera_of(camera: Any, where: str) -> Camera:
    """A COLMAP camera as ours.

    Raises:
        InputError: its model is not supported, or its numbers are unusable; ``where`` says whose it is.
    """
    name = camera.model.name
    if name not in PARAMETERS:
        known = ", ".join(PARAMETERS)
        raise InputError(where, f"its camera model {name} is not supported", f"undistort to one of {known}")
    values = dict(zip(PARAMETERS[name], (float(v) for v in camera.params)))
    focal = values.pop("f", 0.0)
    values = {"fx": focal, "fy": focal, **values}
    if not np.isfinite(list(values.values())).all() or min(values["fx"], values["fy"]) <= 0:
        raise InputError(where, f"its {name} camera has unusable parameters {values}", "calibrate it again")
    return Camera(width=int(camera.width), height=int(camera.height), **values)


def colmap_camera(pycolmap: Any, camera: Camera, camera_id: int) -> Any:
    """Ours as a COLMAP camera; one with k3, which OPENCV lacks, as FULL_OPENCV."""
    model = "FULL_OPENCV" if camera.k3 else camera.model
    keys = (*PARAMETERS["OPENCV"], "k3") if camera.k3 else PARAMETERS[model]
    params = [getattr(camera, key) for key in keys] + ([0.0] * 3 if camera.k3 else [])
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params, camera_id=camera_id)


def world_from_cam_of(image: Any) -> Tensor:
    """(4, 4) float64 of a registered COLMAP image."""
    matrix = torch.from_numpy(np.array(image.cam_from_world().matrix(), np.float64))
    return invert(rigid(matrix[:, :3], matrix[:, 3]))


def points_of(model: Any) -> Tensor:
    """(P, 3) float32: the model's points, by their number."""
    if not len(model.points3D):
        return torch.zeros(0, 3)
    xyz = np.stack([model.points3D[i].xyz for i in sorted(model.points3D)]).astype(np.float32)
    return torch.from_numpy(xyz[np.isfinite(xyz).all(-1)])


def _report_rescaled(model_path: Path, model: Any, frames: list[Frame], warn: Warn) -> None:
    sizes = {(int(c.width), int(c.height)) for c in model.cameras.values()}
    other = [f.camera for f in frames if (f.camera.width, f.camera.height) not in sizes]
    if other:
        warn(f"{model_path}: intrinsics are scaled to the images' {other[0].width}x{other[0].height}")
