"""COLMAP's database as the memory of structure from motion: cameras, features and matches, each done once.

Features and the geometry of pairs are pycolmap's, the pairing of features is ours (`refield.vision.sift`). Images are
named by the content of their photos, so that a photo that is added later finds what is known of the others.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.photos.features import photo_features
from refield.photos.gather import OnProgress
from refield.photos.taken import Taken, pixels_of
from refield.scene.colmap import quiet_pycolmap
from refield.scene.files import log_warning
from refield.scene.left_out import Warn
from refield.vision.sift import DIM, match_mutual, unit

NAME = "features.db"
LEAST = 15
"""matches of a pair that are worth looking at"""
_BLOCK = 64  # pairs between two moments at which what is done is kept
Pair = tuple[int, int]


class Database:
    """An open database of photos; images are known by the photos' keys."""

    def __init__(self, path: Path, db: Any, features: int) -> None:
        self.path, self._db, self._features = path, db, features
        self._units: dict[int, Tensor] = {}

    @staticmethod
    @contextlib.contextmanager
    def opened(cache: Path, features: int, warn: Warn = log_warning) -> Iterator[Database]:
        """The one in ``cache``, made if need be; one that cannot be read is made again."""
        pycolmap = quiet_pycolmap()
        cache.mkdir(parents=True, exist_ok=True)
        path = cache / f"{features}-{NAME}"
        try:
            db = pycolmap.Database.open(str(path))
            db.read_all_images()
        except Exception as error:  # the reader raises several C++ types
            reason = (str(error).strip().splitlines() or [type(error).__name__])[-1][-120:]
            warn(f"{path}: cannot be read ({reason}) and is made again")
            path.unlink(missing_ok=True)
            db = pycolmap.Database.open(str(path))
        try:
            yield Database(path, db, features)
        finally:
            db.close()

    @property
    def images(self) -> dict[str, int]:
        """Numbers by key."""
        return {image.name: image.image_id for image in self._db.read_all_images()}

    def set_cameras(self, photos: Sequence[Taken], cameras: Sequence[Any]) -> None:
        """Enter photos with their cameras, a COLMAP camera each; photos that are there get theirs anew."""
        pycolmap = quiet_pycolmap()
        ids: dict[int, int] = {}  # of the cameras given, by object
        known = self.images
        for photo, camera in zip(photos, cameras):
            here = ids.get(id(camera))
            there = self._db.read_image(known[photo.key]) if photo.key in known else None
            if here is None:
                here = there.camera_id if there is not None and there.camera_id not in ids.values() else None
                here = self._entered(camera, here)
                ids[id(camera)] = here
            if there is None:
                self._db.write_image(pycolmap.Image(name=photo.key, camera_id=here))
            elif there.camera_id != here:
                there.camera_id = here
                self._db.update_image(there)

    def _entered(self, camera: Any, number: int | None) -> int:
        if number is None:
            return int(self._db.write_camera(camera))
        camera.camera_id = number
        self._db.update_camera(camera)
        return number

    def add_features(self, photos: Sequence[Taken], on_progress: OnProgress | None = None) -> None:
        """Find the features of photos that have none yet."""
        pycolmap, numbers = quiet_pycolmap(), self.images
        for i, photo in enumerate(photos):
            number = numbers[photo.key]
            if not self._db.exists_descriptors(number):
                found = photo_features(pixels_of(photo), self._features)
                self._db.write_keypoints(number, found.xy)
                rows = found.descriptors.reshape(-1, DIM)
                kind = pycolmap.FeatureExtractorType.SIFT
                self._db.write_descriptors(number, pycolmap.FeatureDescriptors(kind, rows))
            if on_progress is not None:
                on_progress(i + 1, len(photos))

    def camera_id(self, number: int) -> int:
        """Of an image."""
        return int(self._db.read_image(number).camera_id)

    def descriptors(self, number: int) -> NDArray[np.uint8]:
        """(N, 128) of an image."""
        return np.asarray(self._db.read_descriptors(number).data, np.uint8).reshape(-1, DIM)

    def keypoints(self, number: int) -> NDArray[np.float32]:
        """(N, 2) pixels."""
        return np.asarray(self._db.read_keypoints(number), np.float32)[:, :2]

    def units(self, number: int) -> Tensor:
        """The descriptors as unit vectors; the last images' are kept."""
        if number not in self._units:
            if len(self._units) > 400:  # 1.5 MB each
                self._units.clear()
            self._units[number] = unit(self.descriptors(number))
        return self._units[number]

    def add_matches(self, pairs: Sequence[Pair], on_progress: OnProgress | None = None) -> None:
        """Match pairs of images that have not been, and verify their geometry."""
        new = [pair for pair in pairs if not self._db.exists_matches(*pair)]
        unverified = [p for p in pairs if self._db.exists_matches(*p) and not self._verified(p)]
        self._verify(unverified)
        for start in range(0, len(new), _BLOCK):
            block = new[start : start + _BLOCK]
            for a, b in block:
                self._db.write_matches(a, b, match_mutual(self.units(a), self.units(b)))
            self._verify(block)
            if on_progress is not None:
                on_progress(start + len(block), len(new))

    def verified(self, pair: Pair) -> int:
        """How many matches of a pair agree with one motion of the camera."""
        if not self._db.exists_two_view_geometry(*pair):
            return 0
        return int(self._db.read_two_view_geometry_num_inliers(*pair))

    def _verified(self, pair: Pair) -> bool:
        return self._count(pair) < LEAST or bool(self._db.exists_two_view_geometry(*pair))

    def _count(self, pair: Pair) -> int:
        return len(self._db.read_matches(*pair))

    def _verify(self, pairs: Sequence[Pair]) -> None:
        pycolmap = quiet_pycolmap()
        names = {number: key for key, number in self.images.items()}
        lines = [f"{names[a]} {names[b]}\n" for a, b in pairs if self._count((a, b)) >= LEAST]
        if not lines:
            return
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = 0
        with tempfile.NamedTemporaryFile("w", suffix=".txt", encoding="utf-8") as file:
            file.writelines(lines)
            file.flush()
            pycolmap.verify_matches(str(self.path), file.name, options)


def all_pairs(numbers: Sequence[int]) -> list[Pair]:
    """Every pair once."""
    return [(a, b) for i, b in enumerate(numbers) for a in numbers[:i]]


def likely_pairs(numbers: Sequence[int], globals_: Tensor, similar: int, neighbours: int) -> list[Pair]:
    """Pairs of photos that look alike, by vectors (F, D) in the order of ``numbers``, or follow each other."""
    alike = globals_ @ globals_.T
    alike.fill_diagonal_(-torch.inf)
    nearest = alike.topk(min(similar, len(numbers) - 1), dim=1).indices.tolist()
    found = {(min(i, j), max(i, j)) for i, row in enumerate(nearest) for j in row}
    found |= {(i, i + k) for k in range(1, neighbours + 1) for i in range(len(numbers) - k)}
    return [(numbers[i], numbers[j]) for i, j in sorted(found)]
