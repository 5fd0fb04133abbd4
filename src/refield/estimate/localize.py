"""Where the new photos were taken (§4.2.1, §10.2.1): old photos that look alike, SIFT matches to the capture's
landmarks, absolute pose. A photo that cannot be placed is rejected and says why; it never gets a neighbour's pose.

The poses are refined against the field itself afterwards (`refield.estimate.place`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.absolute_pose import Solved, solve
from refield.estimate.intrinsics import guesses
from refield.photos.features import photo_features
from refield.photos.gather import Gathered, OnProgress, gather
from refield.photos.landmarks import Landmarks, describe, read_landmarks, triangulated, write_landmarks
from refield.photos.motion import Counting, silent
from refield.photos.taken import PhotoConfig, Taken, pixels_of
from refield.scene.capture import Capture, Frame, centres, check_capture
from refield.scene.change import PlacedPhoto, Placement
from refield.scene.errors import InputError, expect
from refield.scene.files import AnyPath, as_path
from refield.scene.images import read_image
from refield.scene.left_out import named
from refield.vision.describer import Describer
from refield.vision.sift import Features, match_landmarks, unit

_FURTHER = 5


@dataclass(frozen=True)
class LocalizeConfig:
    """How new photos without poses are placed."""

    similar: int = 12
    """old photos that a new one is matched with; five times as many if these do not suffice"""
    features: int = 3000
    """SIFT features a photo"""
    ratio: float = 0.85
    """Lowe's; the second nearest is that of another point"""
    most_error: float = 0.004
    """of the photo's longer side: how far a point may lie from where the pose puts it, and count"""
    least: int = 20
    """points that must agree with the pose"""
    least_share: float = 0.1
    """and of those that were recognised"""
    least_spread: int = 4
    """cells of the picture, of 64, that they must lie in"""


@dataclass(frozen=True)
class Known:
    """What new photos are placed in."""

    capture: Capture
    landmarks: Landmarks
    globals_: Tensor
    """(F, D) unit vectors of the old photos: the landmarks' own, or those of a network"""
    describer: Describer | None = None
    """that network"""


def localize(
    photos: Sequence[Taken],
    known: Known,
    config: LocalizeConfig = LocalizeConfig(),
    on_progress: OnProgress | None = None,
) -> list[PlacedPhoto]:
    """Each photo with its pose and intrinsics in the capture's world, or rejected with the reason, in their order."""
    out = []
    for i, photo in enumerate(photos):
        out.append(_localized(photo, known, config))
        if on_progress is not None:
            on_progress(i + 1, len(photos))
    return out


def localize_photos(
    folder: AnyPath,
    known: Known,
    cache: AnyPath,
    config: LocalizeConfig = LocalizeConfig(),
    photos: PhotoConfig | None = None,
    counting: Counting | None = None,
) -> list[PlacedPhoto]:
    """New photos without poses in ``folder``, each placed in the capture's world or rejected with the reason.

    Args:
        cache: gets their upright copies, which the frames refer to.
        photos: how they are taken in.

    Raises:
        InputError: there are no photos, or none that can be used.
    """
    expect("what the photos are placed in", known, Known, "what refield.known_by makes of a capture and its landmarks")
    place, kept = as_path(folder, "the new photos' folder"), as_path(cache, "the cache")
    return localize_taken(take_in(place, kept, photos, counting), known, config, counting)


def take_in(folder: Path, cache: Path, photos: PhotoConfig | None = None, counting: Counting | None = None) -> Gathered:
    """The first half of `localize_photos`, which needs nothing but the new photos.

    Raises:
        InputError: there are none, or none that can be used.
    """
    gathered = gather(folder, cache / "new", photos, (counting or silent)("photos"), among=False)
    if not gathered.photos:
        reasons = named([f"{name} {why}" for name, why in gathered.left_out])
        raise InputError(folder, f"none of its {len(gathered.left_out)} photos can be used ({reasons})", "replace them")
    return gathered


def localize_taken(
    gathered: Gathered, known: Known, config: LocalizeConfig = LocalizeConfig(), counting: Counting | None = None
) -> list[PlacedPhoto]:
    """The second half of `localize_photos`."""
    placed = localize(gathered.photos, known, config, (counting or silent)("placed"))
    return [*placed, *(PlacedPhoto(name, "rejected", why) for name, why in gathered.left_out)]


def kept_landmarks(path: AnyPath, capture: Capture, cache: AnyPath, counting: Counting | None = None) -> Landmarks:
    """The landmarks in the file ``path``; of a capture that came with poses they are made now, once.

    Raises:
        InputError: the capture's photos do not agree with its poses.
    """
    path, cache = as_path(path, "the landmarks' file"), as_path(cache, "the cache")
    check_capture(capture)
    landmarks = read_landmarks(path, capture)
    if landmarks is None:
        landmarks = triangulated(capture, cache / "posed", counting=counting)
        write_landmarks(path, landmarks)
    return landmarks


def known_by(
    capture: Capture, landmarks: Landmarks, describer: Describer | None = None, counting: Counting | None = None
) -> Known:
    """What new photos are placed in; a describer looks at every old photo first."""
    check_capture(capture)
    give = "those that refield.estimate.localize.kept_landmarks finds in it"
    expect("what is given as the capture's landmarks", landmarks, Landmarks, give)
    if describer is None:
        return Known(capture, landmarks, landmarks.globals_)
    tell, vectors = (counting or silent)("old photos described"), []
    for i, frame in enumerate(capture.frames):
        vectors.append(describer.describe(read_image(frame.path).numpy()))
        tell(i + 1, len(capture.frames))
    return Known(capture, landmarks, torch.stack(vectors), describer)


def _localized(photo: Taken, known: Known, config: LocalizeConfig) -> PlacedPhoto:
    why = photo.look.fault or photo.look.blur(known.landmarks.sharpness)
    if why:
        return PlacedPhoto(photo.name, "rejected", why)
    image = pixels_of(photo)
    features = photo_features(image, config.features)
    units = unit(features.descriptors)
    alike = _alike(image, units, known)
    first = _placed(photo, features, units, alike[: config.similar], known, config)
    if first.status == "used" or len(alike) <= config.similar:
        return first
    return _placed(photo, features, units, alike[: _FURTHER * config.similar], known, config)


def _alike(image: NDArray[np.uint8], units: Tensor, known: Known) -> Tensor:
    """The old photos, the most similar first."""
    vector = describe(known.landmarks, units) if known.describer is None else known.describer.describe(image)
    return (known.globals_ @ vector).argsort(descending=True)


def _placed(
    photo: Taken, features: Features, units: Tensor, frames: Tensor, known: Known, config: LocalizeConfig
) -> PlacedPhoto:
    landmarks = known.landmarks
    seen = landmarks.seen_by(frames)
    if len(units) == 0 or len(seen) == 0:
        return PlacedPhoto(photo.name, "rejected", f"has {len(units)} features, none of which is known")
    rows, points, _ = match_landmarks(units, unit(landmarks.descriptors[seen]), landmarks.point_of[seen], config.ratio)
    xy = features.xy[rows.numpy()].astype(np.float64)
    most = max(config.most_error * max(photo.width, photo.height), 2.0)
    xyz = landmarks.points[points].double().numpy()
    found = solve(xy, xyz, guesses(photo, known.capture, landmarks), most)
    why = _doubt(found, len(rows), known.capture, config)
    if found is None or why:
        shown = None if found is None else Placement(found.count, len(rows), found.error, found.how)
        return PlacedPhoto(photo.name, "rejected", why, placement=shown)
    frame = Frame(photo.path, found.camera, photo.name, found.world_from_cam)
    return PlacedPhoto(photo.name, "used", "", frame, Placement(found.count, len(rows), found.error, found.how))


def _doubt(found: Solved | None, matches: int, capture: Capture, config: LocalizeConfig) -> str:
    """Why a pose is not believed; empty if it is."""
    scene = "does it show this scene?"
    if found is None:
        return f"cannot be placed: no pose agrees with its {matches} matches to the old photos; {scene}"
    count = f"only {found.count} of {matches} matches to the old photos agree with one pose"
    if found.count < config.least or found.count < config.least_share * matches:
        return f"cannot be placed: {count}; {scene}"
    if found.spread < config.least_spread:
        return f"cannot be placed: what it shares with the old photos is one small spot ({found.count} points)"
    at = centres(capture.frames)
    middle = at.median(0).values
    reach = float((at - middle).norm(dim=-1).max())
    away = float((found.world_from_cam[:3, 3] - middle).norm())
    if away > 10 * reach:
        return f"cannot be placed: its pose would be {away / max(reach, 1e-9):.0f} times as far out as the old photos"
    return ""
