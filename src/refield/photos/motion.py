"""Structure from motion (§10.1.1): photos without poses → a capture with poses and points, by pycolmap.

What is done is kept in the cache, so that a run that was interrupted goes on, and photos can be added. The world is
COLMAP's own: its axes and its unit are those of the first pair, and are kept as they are.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refield.photos.database import Database, Pair, all_pairs, likely_pairs
from refield.photos.gather import OnProgress
from refield.photos.lens import Lens
from refield.photos.taken import Taken
from refield.scene.capture import Capture, Frame
from refield.scene.colmap import camera_of, points_of, quiet_pycolmap, world_from_cam_of
from refield.scene.errors import InputError
from refield.scene.left_out import named
from refield.vision.vlad import learn_words, vlad

Counting = Callable[[str], OnProgress]
"""Called with what is counted; gives what is called with how many are done, and how many there are"""


def silent(what: str) -> OnProgress:
    """Counts nothing aloud."""
    return lambda done, total: None


_FULL_LENS = 8  # photos of one camera, from which on its whole distortion is looked for
_CENTRE = 30  # and its principal point: of fewer it comes out worse than the middle


@dataclass(frozen=True)
class MotionConfig:
    """How camera poses are found."""

    features: int = 3000
    """SIFT features a photo, the strongest"""
    exhaustive: int = 40
    """photos up to which every pair is matched"""
    similar: int = 20
    """of more photos, each is matched with so many that look like it"""
    neighbours: int = 5
    """and with so many that follow it in the order of their names"""
    least_share: float = 0.5
    """if fewer of the photos can be placed in one model, that is an error"""


@dataclass(frozen=True)
class Motion:
    """What structure from motion found."""

    capture: Capture
    model: Any
    """pycolmap's reconstruction, the largest; its images are named by the photos' keys"""
    unplaced: tuple[str, ...]
    """names of the photos that are not part of it"""
    parts: tuple[int, ...]
    """photos in each separate model, the largest first"""


def need_three(what: Path | str, count: int) -> None:
    """Raises InputError: from so few photos nobody can tell where they were taken."""
    if count < 3:
        fault = f"{count} photos are too few to find where they were taken"
        raise InputError(what, fault, "give 50 or more, from many sides")


def reconstruct(
    photos: Sequence[Taken], database: Database, config: MotionConfig, counting: Counting | None = None
) -> Motion:
    """Poses of photos that show one scene.

    Raises:
        InputError: too few photos, or too few of them that belong together.
    """
    need_three("photos", len(photos))
    count = counting or silent
    database.set_cameras(photos, first_cameras(photos))
    database.add_features(photos, count("features"))
    database.add_matches(pairs_of(photos, database, config), count("matches"))
    models = _mapped(photos, database, count("poses"))
    if not models:
        raise _apart(photos, "no two photos of which the motion of the camera can be told")
    model, parts = models[0], tuple(m.num_reg_images() for m in models)
    _centred(model)
    capture = capture_of(model, photos)
    placed = {frame.name for frame in capture.frames}
    unplaced = tuple(photo.name for photo in photos if photo.name not in placed)
    if len(placed) < max(config.least_share * len(photos), 3):
        more = f"; separate parts of {', '.join(map(str, parts))} photos" if len(parts) > 1 else ""
        raise _apart(photos, f"only {len(placed)} of {len(photos)} photos can be placed in one model{more}")
    return Motion(capture, model, unplaced, parts)


def first_cameras(photos: Sequence[Taken]) -> list[Any]:
    """A COLMAP camera per photo, one object for all of one lens and size; its focal length by EXIF where that tells."""
    pycolmap = quiet_pycolmap()
    groups = [(p.lens, p.width, p.height) for p in photos]
    counts = Counter(groups)
    cameras: dict[tuple[Lens, int, int], Any] = {}
    for lens, width, height in counts:
        model = "OPENCV" if counts[lens, width, height] >= _FULL_LENS else "SIMPLE_RADIAL"
        camera = pycolmap.Camera.create_from_model_name(0, model, lens.guess(width, height), width, height)
        camera.has_prior_focal_length = lens.focal(width, height) is not None
        cameras[lens, width, height] = camera
    return [cameras[g] for g in groups]


def pairs_of(photos: Sequence[Taken], database: Database, config: MotionConfig) -> list[Pair]:
    """Which photos to match with which: all, or those that look alike or follow each other."""
    known = database.images
    numbers = [known[photo.key] for photo in photos]
    if len(photos) <= config.exhaustive:
        return all_pairs(numbers)
    words = words_of(database, numbers)
    return likely_pairs(numbers, globals_of(database, numbers, words), config.similar, config.neighbours)


def words_of(database: Database, numbers: Sequence[int]) -> Tensor:
    """The visual words of a set of images: the k-means of every so-many-th descriptor."""
    step = max(len(numbers) * 3000 // 40_000, 1)
    return learn_words([database.units(n)[::step] for n in numbers])


def globals_of(database: Database, numbers: Sequence[int], words: Tensor) -> Tensor:
    """(F, D): one vector per image, to tell which look alike."""
    return torch.stack([vlad(database.units(n), words) for n in numbers])


def capture_of(model: Any, photos: Sequence[Taken]) -> Capture:
    """The registered photos, in their own order, and the model's points."""
    images = {model.images[i].name: model.images[i] for i in model.reg_image_ids()}
    frames = []
    for photo in photos:
        image = images.get(photo.key)
        if image is not None:
            camera = camera_of(model.cameras[image.camera_id], photo.name)
            frames.append(Frame(photo.path, camera, photo.name, world_from_cam_of(image)))
    return Capture(tuple(frames), points=points_of(model))


def _mapped(photos: Sequence[Taken], database: Database, on_progress: OnProgress) -> list[Any]:
    """Models by incremental mapping, the largest first."""
    pycolmap = quiet_pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.extract_colors = False
    options.min_model_size = max(min(10, len(photos) // 2), 3)
    options.image_names = [photo.key for photo in photos]
    done = 0

    def one_more() -> None:
        nonlocal done
        done = min(done + 1, len(photos))
        on_progress(done, len(photos))

    out = database.path.parent / "models"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    found = pycolmap.incremental_mapping(
        str(database.path), str(photos[0].path.parent), str(out), options,
        initial_image_pair_callback=one_more, next_image_callback=one_more,
    )  # fmt: skip
    return sorted(found.values(), key=lambda m: -m.num_reg_images())


def _centred(model: Any) -> None:
    """Refine the principal points too, now that everything is in place: half a degree of a pose may hang on it.

    Cameras of a few photos, of which it cannot be told, stay as they are.
    """
    pycolmap = quiet_pycolmap()
    seen = Counter(model.images[i].camera_id for i in model.reg_image_ids())
    if max(seen.values()) < _CENTRE:
        return
    config, options = pycolmap.BundleAdjustmentConfig(), pycolmap.BundleAdjustmentOptions()
    for number in model.reg_image_ids():
        config.add_image(number)
    for camera, count in seen.items():
        if count < _CENTRE:
            config.set_constant_cam_intrinsics(camera)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options.refine_principal_point, options.print_summary = True, False
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _apart(photos: Sequence[Taken], what: str) -> InputError:
    remedy = "photos must overlap and be taken from different places; add some between those that are far apart"
    return InputError(f"{len(photos)} photos ({named([p.name for p in photos])})", what, remedy)
