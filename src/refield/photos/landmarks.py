"""Landmarks: a capture's points with what they look like, which is what new photos are placed by (§4.2.1).

    landmarks.safetensors   points, descriptors, who saw what, visual words; lenses and sharpness in its header

Letters: P points, M observations of them, F frames, D length of a frame's vector.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refield.photos.database import Database
from refield.photos.lens import Lens
from refield.photos.look import Look, look_at, usual_sharpness
from refield.photos.motion import Counting, MotionConfig, globals_of, pairs_of, silent, words_of
from refield.photos.taken import Taken
from refield.scene.capture import Capture
from refield.scene.colmap import colmap_camera, quiet_pycolmap
from refield.scene.errors import InputError
from refield.scene.files import write_bytes
from refield.scene.images import read_image
from refield.scene.pose import invert
from refield.vision.vlad import vlad

NAME = "landmarks.safetensors"
LEAST = 50
"""points, with fewer of which nothing can be placed"""


@dataclass(frozen=True)
class Landmarks:
    """What is known of a capture, in its own world and in the order of its frames."""

    points: Tensor
    """(P, 3) float64"""
    descriptors: Tensor
    """(M, 128) uint8, root-SIFT"""
    point_of: Tensor
    """(M,) int64"""
    frame_of: Tensor
    """(M,) int64, ascending"""
    words: Tensor
    """(K, 128) visual words"""
    globals_: Tensor
    """(F, D) unit vectors: which frames look alike"""
    poses: Tensor
    """(F, 4, 4) float64, ``world_from_cam``: which capture and which world these are of"""
    lenses: tuple[Lens, ...]
    """(F)"""
    sharpness: float
    """usual one of the old photos"""

    def seen_by(self, frames: Tensor) -> Tensor:
        """The observations (indices into M) of some frames."""
        return torch.isin(self.frame_of, frames).nonzero()[:, 0]


def landmarks_of(model: Any, database: Database, photos: Sequence[Taken], capture: Capture) -> Landmarks:
    """What a COLMAP model knows of a capture's photos, which go with its frames.

    Raises:
        InputError: it has hardly any points.
    """
    index = {number: i for i, number in enumerate(sorted(model.points3D))}
    if len(index) < LEAST:
        what = f"only {len(index)} points of its photos agree with their poses"
        raise InputError("the capture", what, "check its poses, or give photos with more texture and overlap")
    known = database.images
    numbers = [known[photo.key] for photo in photos]
    observed = [_observed(model.images[n], index) for n in numbers]
    rows = [torch.from_numpy(database.descriptors(n)[at].copy()) for n, (at, _) in zip(numbers, observed)]
    words = words_of(database, numbers)
    return Landmarks(
        points=torch.from_numpy(np.stack([model.points3D[i].xyz for i in index])),
        descriptors=torch.cat(rows),
        point_of=torch.from_numpy(np.concatenate([who for _, who in observed])),
        frame_of=torch.repeat_interleave(torch.arange(len(rows)), torch.tensor([len(r) for r in rows])),
        words=words,
        globals_=globals_of(database, numbers, words),
        poses=poses_of(capture),
        lenses=tuple(photo.lens for photo in photos),
        sharpness=usual_sharpness([photo.look for photo in photos]),
    )


def triangulated(
    capture: Capture, cache: Path, config: MotionConfig | None = None, counting: Counting | None = None
) -> Landmarks:
    """Landmarks of a capture that came with poses: its photos' features, triangulated from where they were taken.

    Raises:
        InputError: a photo cannot be read, or hardly any points agree with the poses.
    """
    pycolmap, config = quiet_pycolmap(), config or MotionConfig()
    count = counting or silent
    photos = _as_taken(capture)
    with Database.opened(cache, config.features) as database:
        shared = {c: colmap_camera(pycolmap, c, 0) for c in {f.camera for f in capture.frames}}
        database.set_cameras(photos, [shared[f.camera] for f in capture.frames])
        database.add_features(photos, count("features"))
        database.add_matches(pairs_of(photos, database, config), count("matches"))
        model = _posed(database, capture, photos)
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = 0
        options.extract_colors = False
        with tempfile.TemporaryDirectory(prefix="refield-") as out:
            found = pycolmap.triangulate_points(model, str(database.path), out, out, options=options)
        return landmarks_of(found, database, photos, capture)


def write_landmarks(path: Path, landmarks: Landmarks) -> None:
    """Write them at once."""
    from safetensors.torch import save

    tensors = {f.name: getattr(landmarks, f.name) for f in fields(landmarks) if f.name not in ("lenses", "sharpness")}
    facts = {"lenses": [asdict(lens) for lens in landmarks.lenses], "sharpness": landmarks.sharpness}
    data = save({k: v.contiguous() for k, v in tensors.items()}, {"facts": json.dumps(facts, allow_nan=False)})
    write_bytes(path, data)


def read_landmarks(path: Path, capture: Capture) -> Landmarks | None:
    """What `write_landmarks` wrote for this capture; None if there is nothing, or it is of another."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        return None
    try:
        with safe_open(str(path), "pt") as file:
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            facts = json.loads((file.metadata() or {})["facts"])
        found = Landmarks(
            **tensors, lenses=tuple(Lens(**lens) for lens in facts["lenses"]), sharpness=float(facts["sharpness"])
        )
        return found if _fits(found, capture) else None
    except (SafetensorError, OSError, KeyError, TypeError, ValueError):
        return None


def poses_of(capture: Capture) -> Tensor:
    """(F, 4, 4) float64."""
    return torch.stack([frame.world_from_cam for frame in capture.frames])


def _fits(found: Landmarks, capture: Capture) -> bool:
    observations, frames = len(found.descriptors), len(capture.frames)
    inside = len(found.point_of) == len(found.frame_of) == observations > 0
    inside = inside and 0 <= int(found.point_of.min()) <= int(found.point_of.max()) < len(found.points)
    inside = inside and int(found.frame_of.max()) < frames and bool(found.points.isfinite().all())
    inside = inside and len(found.globals_) == len(found.lenses) == len(found.poses) == frames
    return inside and bool(torch.allclose(found.poses, poses_of(capture), atol=1e-6))


def describe(landmarks: Landmarks, units: Tensor) -> Tensor:
    """The (D,) vector of a photo's descriptors (N, 128), to be compared with ``globals_``."""
    return vlad(units, landmarks.words)


def _observed(image: Any, index: dict[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints of an image that show a point, and which."""
    pairs = [(i, index[p.point3D_id]) for i, p in enumerate(image.points2D) if p.has_point3D()]
    at = np.array(pairs, np.int64).reshape(-1, 2)
    return at[:, 0], at[:, 1]


def _as_taken(capture: Capture) -> list[Taken]:
    out = []
    for i, frame in enumerate(capture.frames):
        look: Look = look_at(read_image(frame.path).numpy())
        camera = frame.camera
        # by content: the cache may be of other photos
        digest = hashlib.sha256(frame.path.read_bytes()).hexdigest()[:16]
        out.append(Taken(frame.name, frame.path, f"{digest}-{i}", camera.width, camera.height, Lens(), look))
    return out


def _posed(database: Database, capture: Capture, photos: Sequence[Taken]) -> Any:
    """A COLMAP model with the capture's poses and no points, under the database's numbers."""
    pycolmap = quiet_pycolmap()
    model, known, cameras = pycolmap.Reconstruction(), database.images, set()
    for frame, photo in zip(capture.frames, photos):
        number = known[photo.key]
        camera_id = database.camera_id(number)
        if camera_id not in cameras:
            cameras.add(camera_id)
            model.add_camera_with_trivial_rig(colmap_camera(pycolmap, frame.camera, camera_id))
        image = pycolmap.Image(name=photo.key, camera_id=camera_id, image_id=number)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in database.keypoints(number).astype(float)])
        pose = pycolmap.Rigid3d(np.ascontiguousarray(invert(frame.world_from_cam)[:3].numpy()))
        model.add_image_with_trivial_frame(image, pose)
    return model
