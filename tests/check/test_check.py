"""A capture looked over: coverage, the picture, what is skipped, and the exit code."""

from __future__ import annotations

import re
import shutil

import pytest
import torch

from refield.check.coverage import coverage_of
from refield.check.picture import camera_picture
from refield.cli import main
from refield.scene.capture import Capture
from refield.scene.images import is_ours, read_image
from refield.scene.world import world_of
from tests.captures import write_capture
from tests.photos.room import write_photos


def test_coverage_of_a_ring_and_of_half_a_ring(tmp_path):
    whole = write_capture(tmp_path, 12)
    coverage = coverage_of(whole, world_of(whole))
    assert coverage.gap == pytest.approx(30, abs=0.1) and coverage.around == pytest.approx(330, abs=0.1)
    assert torch.allclose(coverage.focus, torch.zeros(3, dtype=torch.float64), atol=1e-4)
    assert coverage.lowest == pytest.approx(21.8, abs=0.1) and coverage.seen_by is None
    half = Capture(whole.frames[:7], points=torch.zeros(4, 3))
    coverage = coverage_of(half, world_of(half))
    assert coverage.gap == pytest.approx(180, abs=1) and coverage.seen_by == 7


def test_the_picture_shows_every_camera(tmp_path):
    capture = write_capture(tmp_path, 6)
    capture = Capture(capture.frames, points=torch.randn(50, 3), held_out_every=0)
    picture = camera_picture(capture, world_of(capture))
    assert picture.shape == (668, 1288, 3) and picture.dtype == torch.uint8
    orange = (picture[..., 0] > 200) & (picture[..., 2] < 60)
    assert int(orange[28:, :640].sum()) > 100 and int(orange[28:, 648:].sum()) > 100


def test_posed_photos(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "data", 8)
    assert main(["check", "data"]) == 0
    out = capsys.readouterr().out
    assert "data: usable" in out and "8 usable, 0 skipped" in out and "8 photos are few" in out
    assert re.search(r"315° around", out) and "memory for the fit" in out and "about" in out
    assert is_ours(tmp_path / "refield-check.png") and read_image(tmp_path / "refield-check.png").shape[1] == 1288


def test_photos_without_poses_tell_what_is_skipped(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_photos(tmp_path / "data", 4)
    (tmp_path / "data" / "text.png").write_text("no picture")
    assert main(["check", "data"]) == 0
    out = capsys.readouterr().out
    assert "skipped: text.png: is not an image" in out and "find the poses" in out and "4 usable, 1 skipped" in out
    assert "not known yet; refield check data --work WORK" in out and not (tmp_path / "refield-check.png").exists()


def test_a_capture_that_cannot_be_used_ends_with_2(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_photos(tmp_path / "data", 2)
    assert main(["check", "data"]) == 2
    assert "not usable; 2 photos can be used, which are too few; give 50" in capsys.readouterr().err


def test_poses_are_found_where_asked_for(reconstructed, tmp_path, monkeypatch, capsys):
    """With the cache of an earlier run it is quick; the picture is drawn."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(reconstructed.folder / "photos", tmp_path / "data")
    shutil.copytree(reconstructed.folder / "cache", tmp_path / "work" / ".photos")
    options = ["--poses.motion.features", "500", "--picture", "cameras.png"]
    assert main(["check", "data", "--work", "work", *options]) == 0
    assert "cameras: cameras.png" in capsys.readouterr().out and is_ours(tmp_path / "cameras.png")


def test_no_picture_of_yours_is_replaced(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "data", 8)
    (tmp_path / "refield-check.png").write_text("mine")
    assert main(["check", "data"]) == 2
    assert "was not made by refield; choose another --picture" in capsys.readouterr().err
