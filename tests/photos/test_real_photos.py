"""A few real photographs, where they are there: registered, and one left out placed again."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from refield.estimate.localize import LocalizeConfig, known_by, localize_photos
from refield.photos.capture import FromPhotosConfig, capture_from_photos
from refield.photos.motion import MotionConfig
from refield.photos.taken import PhotoConfig
from refield.scene.capture import Capture
from refield.scene.similarity import between, pose_errors
from refield.scene.transforms_json import load_transforms
from refield.scene.world import world_of

FOX = Path(os.environ.get("REFIELD_TEST_DATA", Path(__file__).parents[2] / "data")) / "fox"
SMALL = PhotoConfig(longest=320)


def test_photographs_are_placed(tmp_path):
    if not (FOX / "transforms.json").is_file():
        pytest.skip(f"the real photographs are not here ({FOX}; REFIELD_TEST_DATA names another place)")
    names = [f"{i:04d}.jpg" for i in (1, 2, 3, 4, 5, 6, 7, 8)]
    for name in names:
        target = tmp_path / ("new" if name == "0005.jpg" else "photos") / name
        target.parent.mkdir(exist_ok=True)
        shutil.copyfile(FOX / "images" / name, target)
    config = FromPhotosConfig(SMALL, MotionConfig(features=800))
    found = capture_from_photos(tmp_path / "photos", tmp_path / "cache", config)
    assert len(found.capture.frames) == 7
    given = {Path(f.name).name: f for f in load_transforms(FOX).frames}
    to_given = between(found.capture.frames, [given[f.name] for f in found.capture.frames])
    known = known_by(found.capture, found.landmarks)
    (placed,) = localize_photos(tmp_path / "new", known, tmp_path / "cache", LocalizeConfig(features=800), SMALL)
    size = world_of(Capture(tuple(given.values()))).size
    away, _ = pose_errors([placed.frame], [given["0005.jpg"]], to_given)
    assert float(away) < 0.01 * size
