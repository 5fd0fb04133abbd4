"""One small reconstruction, shared by the tests that place photos in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from refield.photos.capture import FromPhotos, FromPhotosConfig, capture_from_photos
from refield.photos.motion import MotionConfig
from refield.scene.capture import Capture
from tests.photos.room import write_photos

QUICK = FromPhotosConfig(motion=MotionConfig(features=500))


@dataclass(frozen=True)
class Reconstructed:
    """Photos, where they were taken, and what was found from them alone."""

    folder: Path
    """photos/ and cache/; to be copied before anything is written"""
    true: Capture
    found: FromPhotos


@pytest.fixture(scope="session")
def reconstructed(tmp_path_factory: pytest.TempPathFactory) -> Reconstructed:
    folder = tmp_path_factory.mktemp("reconstructed")
    true = write_photos(folder / "photos", 8)
    return Reconstructed(folder, true, capture_from_photos(folder / "photos", folder / "cache", QUICK))
