"""A SceneChange on disk: ``change.json``, ``grid_<i>.npz`` and ``masks/``. JSON, arrays, PNGs; never pickle.

All poses are in the capture's world; ``world_from_cam`` has OpenCV camera axes. Files are named by index,
never by text that came from outside.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refield.scene import images
from refield.scene.capture import Capture, Frame
from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, Placement, SceneChange
from refield.scene.errors import InputError
from refield.scene.files import AnyPath, as_path, inside, read_json, write_bytes, write_json
from refield.scene.intrinsics import read_camera, write_camera

NAME = "change.json"
_MAX_GRID_BYTES = 1 << 30  # unpacked; a 512³ grid of floats is half of it
_PHOTO_MASKS = ("masks_in", "masks_out", "unexplained")
_REMEDY = "run the update again, or restore the file"


def save_change(folder: AnyPath, change: SceneChange) -> None:
    """Write ``change`` into an existing folder.

    The image of a used photo is recorded where it lies inside ``folder``; a caller who wants the folder to be
    self-contained copies the photos there first.
    """
    folder = as_path(folder, "the change's folder")
    objects = [_object_out(folder, i, o) for i, o in enumerate(change.objects)]
    photos = [_photo_out(folder, p) for p in change.photos]
    record: dict[str, Any] = {"objects": objects, "photos": photos, "why": change.why, "by_hand": change.by_hand}
    record["masks_in"] = _masks_out(folder, "photos_in", change.masks_in)
    record["masks_out"] = _masks_out(folder, "photos_out", change.masks_out)
    record["unexplained"] = _masks_out(folder, "photos_unexplained", change.unexplained)
    write_json(folder / NAME, record)


def load_change(
    folder: AnyPath,
    capture: Capture | None = None,
    *,
    photos: Sequence[Frame] = (),
    masks: bool = True,
    old_masks: bool = True,
) -> SceneChange:
    """Read what `save_change` wrote.

    With ``capture`` the masks are checked against its training frames. ``photos`` stand in, by name, for used
    photos whose image does not lie in ``folder``. Without ``masks`` there are none: reading them takes longest, and
    whoever renders the field asks for none. Without ``old_masks`` there are only those of the new photos.

    Raises:
        InputError: a file or key is missing, or holds what it cannot.
    """
    folder = as_path(folder, "the change's folder")
    record = read_json(folder / NAME)
    try:
        return SceneChange(
            objects=tuple(_object_in(folder, o, capture, masks and old_masks) for o in record["objects"]),
            photos=tuple(_photo_in(folder, p, {f.name: f for f in photos}) for p in record["photos"]),
            why=str(record.get("why", "")),
            by_hand=bool(record.get("by_hand", False)),
            **{kind: _photo_masks(folder, record.get(kind, []), masks) for kind in _PHOTO_MASKS},
        )
    except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else f"is not a change ({error})"
        raise InputError(folder / NAME, what, _REMEDY) from None


def _object_out(folder: Path, index: int, o: ObjectChange) -> dict[str, Any]:
    grid = f"grid_{index}.npz"
    buffer = io.BytesIO()
    np.savez_compressed(buffer, aabb=o.grid.aabb.cpu().numpy(), values=o.grid.values.cpu().numpy())
    write_bytes(folder / grid, buffer.getvalue())
    return {
        "kind": o.kind,
        "new_from_old": None if o.new_from_old is None else o.new_from_old.tolist(),
        "aabb": o.grid.tight_aabb().tolist(),
        "confidence": float(o.confidence),
        "grid": grid,
        "covariance": None if o.covariance is None else o.covariance.tolist(),
        "alternatives": [pose.tolist() for pose in o.alternatives],
        "note": o.note,
        "masks": _masks_out(folder, f"{index}_old", o.masks),
        "masks_in": _masks_out(folder, f"{index}_new", o.masks_in),
    }


def _photo_masks(folder: Path, names: list[str | None], masks: bool) -> tuple[Tensor, ...]:
    """Of the used new photos; empty if no masks are wanted."""
    return tuple(m for m in _masks_in(folder, names) if m is not None) if masks else ()


def _object_in(folder: Path, record: dict[str, Any], capture: Capture | None, masks: bool) -> ObjectChange:
    if record["kind"] not in ("moved", "removed", "added"):
        raise ValueError(f"the kind {record['kind']!r}")
    matrix, covariance = record["new_from_old"], record.get("covariance")
    o = ObjectChange(
        kind=record["kind"],
        grid=_read_grid(inside(folder, record["grid"], str(folder / NAME))),
        new_from_old=None if matrix is None else _matrix(matrix, 4),
        masks=_masks_in(folder, record.get("masks", [])) if masks else (),
        masks_in=_masks_in(folder, record.get("masks_in", [])) if masks else (),
        confidence=float(record["confidence"]),
        covariance=None if covariance is None else _matrix(covariance, 6),
        alternatives=tuple(_matrix(pose, 4) for pose in record.get("alternatives", [])),
        note=str(record.get("note", "")),
    )
    if capture is not None:
        _check_masks(folder, o, capture.train)
    return o


def _check_masks(folder: Path, o: ObjectChange, frames: Sequence[Frame]) -> None:
    for masks in (o.masks, o.masks_in):
        if masks and len(masks) != len(frames):
            what = f"holds {len(masks)} masks for {len(frames)} training frames"
            raise InputError(folder / NAME, what, _REMEDY)
        for frame, mask in zip(frames, masks):
            if mask is not None and mask.shape != (frame.camera.height, frame.camera.width):
                what = f"the mask of {frame.name!r} has another size than the photo"
                raise InputError(folder / NAME, what, _REMEDY)


def _photo_out(folder: Path, photo: PlacedPhoto) -> dict[str, Any]:
    record: dict[str, Any] = {"file": photo.name, "status": photo.status, "why": photo.why}
    if photo.placement is not None:
        record["placement"] = asdict(photo.placement)
    frame = photo.frame
    if frame is None:
        return record | {"world_from_cam": None}
    here = frame.path.resolve().is_relative_to(folder.resolve())
    image = frame.path.resolve().relative_to(folder.resolve()).as_posix() if here else None
    pose = frame.world_from_cam.tolist()
    return record | {"world_from_cam": pose, "camera": write_camera(frame.camera), "image": image}


def _photo_in(folder: Path, record: dict[str, Any], known: dict[str, Frame]) -> PlacedPhoto:
    name, status = str(record["file"]), record["status"]
    placement = _placement(record.get("placement"))
    if status not in ("used", "rejected"):
        raise ValueError(f"the photo status {status!r}")
    if status == "rejected":
        return PlacedPhoto(name, "rejected", str(record.get("why", "")), placement=placement)
    where = f"{folder / NAME}: photo {name!r}"
    pose = _matrix(record["world_from_cam"], 4)
    image = record.get("image")
    if image is None and name in known:
        frame = Frame(known[name].path, known[name].camera, name, pose)
    else:
        path = inside(folder, image, where) if image is not None else folder / name
        frame = Frame(path, read_camera(record["camera"], where, None), name, pose)
    return PlacedPhoto(name, "used", str(record.get("why", "")), frame, placement)


def _placement(record: dict[str, Any] | None) -> Placement | None:
    if record is None:
        return None
    inliers, matches = int(record["inliers"]), int(record["matches"])
    return Placement(inliers, matches, float(record["error"]), str(record.get("camera", "")))


def _masks_out(folder: Path, prefix: str, masks: Sequence[Tensor | None]) -> list[str | None]:
    """One PNG per mask; None stays None (§10.1.3: unsure, the frame is left out)."""
    names = [None if mask is None else f"masks/{prefix}_{i:04d}.png" for i, mask in enumerate(masks)]
    for name, mask in zip(names, masks):
        if name is not None and mask is not None:
            images.write_image(folder / name, mask.bool())
    return names


def _masks_in(folder: Path, names: list[str | None]) -> tuple[Tensor | None, ...]:
    where = str(folder / NAME)
    return tuple(None if n is None else images.read_mask(inside(folder, n, where)) for n in names)


def _matrix(rows: Any, size: int) -> Tensor:
    matrix = torch.tensor(rows, dtype=torch.float64)
    if matrix.shape != (size, size) or not bool(matrix.isfinite().all()):
        raise ValueError(f"a matrix that is not {size}x{size} and finite")
    return matrix


def _read_grid(path: Path) -> OccupancyGrid:
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MAX_GRID_BYTES:
                raise InputError(path, "unpacks to more than 1 GB", _REMEDY)
        with np.load(path, allow_pickle=False) as data:
            aabb, values = torch.from_numpy(data["aabb"]).float(), torch.from_numpy(data["values"]).float()
    except (OSError, zipfile.BadZipFile, ValueError, KeyError, EOFError) as error:
        raise InputError(path, f"is not a readable grid ({error})", _REMEDY) from None
    shaped = aabb.shape == (2, 3) and values.dim() == 3 and min(values.shape) >= 2
    if not shaped or not bool(aabb.isfinite().all() and (aabb[1] > aabb[0]).all()):
        raise InputError(path, "its box or shape is unusable", _REMEDY)
    if not bool(((values >= 0) & (values <= 1)).all()):
        raise InputError(path, "holds values outside [0, 1]", _REMEDY)
    return OccupancyGrid(aabb, values)
