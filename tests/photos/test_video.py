"""Frames of a video: sharp ones, spread over it, none twice."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from refield.photos.gather import gather
from refield.photos.look import look_at
from refield.photos.taken import PhotoConfig
from refield.photos.video import sharp_frames
from tests.photos.room import texture


def write_video(path: Path, moving: bool = True, count: int = 40) -> None:
    """A camera that passes along a wall; three of four frames are blurred."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (256, 192))
    wall = (texture(0) * 255).astype(np.uint8)
    for i in range(count):
        frame = wall[100:292, (6 * i if moving else 0) : (6 * i if moving else 0) + 256]
        video.write(np.ascontiguousarray(frame if i % 4 == 2 else cv2.GaussianBlur(frame, (0, 0), 4)))
    video.release()


def test_sharp_frames_are_chosen_and_spread(tmp_path):
    write_video(tmp_path / "walk.mp4")
    chosen = list(sharp_frames(tmp_path / "walk.mp4", 5))
    seconds = np.array([s for s, _ in chosen])
    assert len(chosen) == 5 and np.diff(seconds).min() >= 0.2 and seconds[-1] > 1.5
    assert all(round(s * 20) % 4 == 2 for s in seconds)
    assert min(look_at(frame).sharpness for _, frame in chosen) > 1.15


def test_a_camera_that_stands_still_gives_one_frame(tmp_path):
    write_video(tmp_path / "still.mp4", moving=False)
    assert len(list(sharp_frames(tmp_path / "still.mp4", 5))) == 1


def test_a_folder_may_hold_a_video(tmp_path):
    write_video(tmp_path / "walk.mp4")
    (tmp_path / "broken.mp4").write_bytes(b"no video at all")
    found = gather(tmp_path, tmp_path / "cache", PhotoConfig(video_frames=4))
    assert [p.name.split(" at ")[0] for p in found.photos] == ["walk.mp4"] * 4
    assert dict(found.left_out) == {"broken.mp4": "cannot be opened as a video"}
    assert gather(tmp_path, tmp_path / "cache", PhotoConfig(video_frames=4)) == found


def test_seconds_are_told(tmp_path):
    write_video(tmp_path / "walk.mp4")
    names = [p.name for p in gather(tmp_path, tmp_path / "cache", PhotoConfig(video_frames=2)).photos]
    assert names[0].startswith("walk.mp4 at ") and names[0].endswith(" s") and len(set(names)) == 2


@pytest.mark.parametrize("sigma", [0, 1, 2, 4, 8])
def test_sharpness_falls_with_blur(sigma):
    wall = (texture(1) * 255).astype(np.uint8)
    image = cv2.GaussianBlur(wall, (0, 0), sigma) if sigma else wall
    more = cv2.GaussianBlur(image, (0, 0), 2)
    assert 0.95 < look_at(more).sharpness < look_at(image).sharpness
