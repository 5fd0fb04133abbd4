"""Structure from motion on photos whose poses are known, and what it does when it is interrupted or misused."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from refield.photos import database as database_module
from refield.photos.capture import capture_from_photos
from refield.photos.database import all_pairs, likely_pairs
from refield.photos.lens import Lens
from refield.photos.look import Look
from refield.photos.motion import first_cameras
from refield.photos.taken import Taken
from refield.scene.errors import InputError
from refield.scene.similarity import between, pose_errors
from refield.scene.world import world_of
from tests.photos.reconstructed import QUICK
from tests.photos.room import write_photos


def test_poses_are_found_up_to_a_similarity(reconstructed):
    found = reconstructed.found.capture
    assert [f.name for f in found.frames] == [f.name for f in reconstructed.true.frames]
    known = between(found.frames, reconstructed.true.frames)
    away, turned = pose_errors(found.frames, reconstructed.true.frames, known)
    assert float(away.max()) < 0.01 * world_of(reconstructed.true).size
    assert float(turned.max()) < 0.5
    # the points lie on the floor and the two walls
    points = known.point(found.points.double())
    off = torch.stack([points[:, 2].abs(), (points[:, 0] + 2).abs(), (points[:, 1] + 2).abs()]).min(0).values
    assert len(points) > 200 and float(off.median()) < 0.01


def test_what_was_interrupted_goes_on(reconstructed, tmp_path, monkeypatch):
    """A second run finds features and matches where the first left them, and comes to the same poses."""
    shutil.copytree(reconstructed.folder, tmp_path / "again")
    monkeypatch.setattr(database_module, "photo_features", lambda *a: pytest.fail("features were found again"))
    monkeypatch.setattr(database_module, "match_mutual", lambda *a: pytest.fail("photos were matched again"))
    again = capture_from_photos(tmp_path / "again" / "photos", tmp_path / "again" / "cache", QUICK)
    for a, b in zip(again.capture.frames, reconstructed.found.capture.frames):
        assert torch.allclose(a.world_from_cam, b.world_from_cam, atol=1e-4)


def test_photos_may_be_added_and_strangers_are_left_out(reconstructed, tmp_path):
    shutil.copytree(reconstructed.folder, tmp_path / "more")
    write_photos(tmp_path / "stranger", 1, seed=5)
    shutil.copyfile(tmp_path / "stranger" / "0.png", tmp_path / "more" / "photos" / "stranger.png")
    said: list[str] = []
    found = capture_from_photos(tmp_path / "more" / "photos", tmp_path / "more" / "cache", QUICK, warn=said.append)
    assert len(found.capture.frames) == 8 and found.photos == 9
    assert found.left_out == (("stranger.png", "cannot be placed among the others"),)
    assert any("left out, cannot be placed among the others: stranger.png" in line for line in said)


def test_photos_that_have_nothing_in_common_are_refused(tmp_path):
    for i in range(3):
        write_photos(tmp_path / str(i), 1, seed=20 + i)
        (tmp_path / "photos").mkdir(exist_ok=True)
        shutil.copyfile(tmp_path / str(i) / "0.png", tmp_path / "photos" / f"{i}.png")
    with pytest.raises(InputError, match=r"3 photos \(0.png, 1.png, 2.png\): .*; photos must overlap"):
        capture_from_photos(tmp_path / "photos", tmp_path / "cache", QUICK)


def test_two_photos_are_too_few(tmp_path):
    write_photos(tmp_path / "photos", 2)
    with pytest.raises(InputError, match="2 photos are too few"):
        capture_from_photos(tmp_path / "photos", tmp_path / "cache", QUICK)


def test_a_damaged_database_is_made_again(reconstructed, tmp_path):
    shutil.copytree(reconstructed.folder, tmp_path / "bad")
    database = tmp_path / "bad" / "cache" / "500-features.db"
    database.write_bytes(b"no database" * 100)
    said: list[str] = []
    found = capture_from_photos(tmp_path / "bad" / "photos", tmp_path / "bad" / "cache", QUICK, warn=said.append)
    assert len(found.capture.frames) == 8 and any("made again" in line for line in said)


def taken(name: str, size: tuple[int, int], lens: Lens) -> Taken:
    return Taken(name, Path(name), name, *size, lens, Look(1.8, 0.5, 0.2))


def test_each_lens_and_size_is_a_camera():
    phone, other = Lens("Acme P1", 26.0), Lens("Other", None)
    many = [taken(str(i), (400, 300), phone) for i in range(8)]
    cameras = first_cameras([*many, taken("upright", (300, 400), phone), taken("other", (400, 300), other)])
    assert len({id(c) for c in cameras[:8]}) == 1 and len({id(c) for c in cameras}) == 3
    assert cameras[0].model.name == "OPENCV" and cameras[8].model.name == "SIMPLE_RADIAL"
    assert cameras[0].has_prior_focal_length and not cameras[9].has_prior_focal_length
    assert cameras[8].params[0] == pytest.approx(26 * 500 / 43.2666, rel=1e-4)
    assert cameras[9].params[0] == pytest.approx(480)


def test_pairs_are_those_that_look_alike_or_follow():
    vectors = torch.nn.functional.normalize(torch.tensor([[1.0, 0], [0, 1], [1, 0.1], [0.1, 1], [1, 0.2]]), dim=1)
    pairs = likely_pairs([10, 11, 12, 13, 14], vectors, similar=1, neighbours=1)
    assert set(pairs) == {(10, 12), (11, 13), (12, 14), (10, 11), (11, 12), (12, 13), (13, 14)}
    assert len(all_pairs(range(6))) == 15 and len(set(all_pairs(range(6)))) == 15


def test_the_floor_is_held(reconstructed, tmp_path):
    strict = replace(QUICK, motion=replace(QUICK.motion, least_share=0.9))
    shutil.copytree(reconstructed.folder, tmp_path / "floor")
    for i in range(3):
        write_photos(tmp_path / str(i), 1, seed=30 + i)
        shutil.copyfile(tmp_path / str(i) / "0.png", tmp_path / "floor" / "photos" / f"other{i}.png")
    with pytest.raises(InputError, match="only 8 of 11 photos can be placed in one model"):
        capture_from_photos(tmp_path / "floor" / "photos", tmp_path / "floor" / "cache", strict)
