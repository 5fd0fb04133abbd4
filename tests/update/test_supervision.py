"""Which pixels may teach (Fig. 12)."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from refield.scene.camera import Camera
from refield.scene.capture import Frame, camera_rays
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.images import frame_image, write_image
from refield.update import supervision
from refield.update.supervision import (
    Places,
    SuperviseConfig,
    changed_pixels,
    exposure,
    new_lessons,
    old_ring,
    places_of,
    silhouette,
)
from tests.captures import write_capture
from tests.update.worlds import Ball, BallWorld, at, grid_of, looking_from

SIZE = 100
CAMERA = Camera(SIZE, SIZE, 130.0, 130.0, 50.0, 50.0)
FRAME = Frame(Path("none.png"), CAMERA, "none.png", looking_from(0.7, 3.0, 1.6))
BALL = Ball(at(-0.2, 0.2, 0.0), 0.25)
NEW = at(0.5, -0.3, 0.0)


def disc(u: float, v: float, radius: float) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    return (x - u) ** 2 + (y - v) ** 2 < radius**2


def moved_ball(masks: tuple[torch.Tensor | None, ...], masks_in: tuple[torch.Tensor | None, ...]) -> SceneChange:
    return SceneChange((ObjectChange("moved", grid_of(BALL), NEW, masks, masks_in),))


def of(masks: tuple[torch.Tensor | None, ...], masks_in: tuple[torch.Tensor | None, ...]) -> Places:
    return places_of(moved_ball(masks, masks_in))


def seen(ball: Ball) -> torch.Tensor:
    place = places_of(SceneChange((ObjectChange("removed", grid_of(ball)),))).was[0]
    return torch.from_numpy(place.silhouette(FRAME))


def test_the_ring_lies_between_shadow_and_far_field_and_not_where_something_moved_in() -> None:
    out, into = disc(40, 50, 10), disc(60, 50, 6)
    ring = old_ring(of((out,), (into,)), 0, FRAME, shadow=0.02, far=0.15)
    assert ring is not None
    y, x = torch.nonzero(ring, as_tuple=True)
    # 3 x 3 dilations grow squares: distances are Chebyshev to the disc, bounded by its Euclidean radius
    distance = ((x + 0.5 - 40) ** 2 + (y + 0.5 - 50) ** 2).sqrt()
    assert float(distance.min()) > 10 + 1.5
    assert float(distance.max()) < 10 + 15 * math.sqrt(2) + 1
    assert not (ring & into).any() and not (ring & out).any()
    assert ring.sum() > 300


def test_a_photo_with_an_unsure_mask_is_left_out() -> None:
    assert old_ring(of((None,), (disc(60, 50, 6),)), 0, FRAME, 0.01, 0.15) is None
    assert old_ring(of((disc(40, 50, 9),), (None,)), 0, FRAME, 0.01, 0.15) is None


def test_missing_masks_are_projected_from_the_grid() -> None:
    given = old_ring(of((seen(BALL),), (seen(Ball(NEW @ BALL.world_from_ball, 0.25)),)), 0, FRAME, 0.01, 0.1)
    projected = old_ring(of((), ()), 0, FRAME, 0.01, 0.1)
    assert given is not None and projected is not None
    assert float((given ^ projected).float().mean()) < 0.03


def test_an_added_object_has_a_ring_around_its_new_place() -> None:
    into = disc(60, 50, 8)
    change = SceneChange((ObjectChange("added", grid_of(BALL), masks_in=(into,)),))
    ring = old_ring(places_of(change), 0, FRAME, 0.01, 0.1)
    assert ring is not None and ring.any() and not (ring & into).any()


def test_the_silhouette_is_where_rays_meet_the_object() -> None:
    rays = camera_rays(CAMERA, FRAME.world_from_cam)
    centre = BALL.world_from_ball[:3, 3].float()
    along = ((centre - rays.origins) * rays.directions).sum(-1, keepdim=True)
    hit = ((rays.origins + along * rays.directions - centre).norm(dim=-1) < 0.25).reshape(SIZE, SIZE)
    found = seen(BALL)
    assert float((hit & found).sum() / (hit | found).sum()) > 0.93


def test_of_a_large_photo_some_pixels_teach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each knows its place in its photo, by which the photos' own masks are asked; a silhouette keeps its size."""
    frames = write_capture(tmp_path, 2).frames
    camera = frames[0].camera
    whole = silhouette((grid_of(BALL),), replace(FRAME, camera=CAMERA))
    monkeypatch.setattr(supervision, "_PIXELS", 500)
    small = silhouette((grid_of(BALL),), replace(FRAME, camera=CAMERA))
    assert small.shape == whole.shape and (small & whole).sum() / (small | whole).sum() > 0.75
    masks = [np.zeros((camera.height, camera.width), bool) for _ in frames]
    masks[1][:, 10:20] = True
    draw = torch.Generator().manual_seed(0)
    lessons = new_lessons(frames, BallWorld((BALL,)), masks, SuperviseConfig(), draw)
    assert [int((lessons.photo == i).sum()) for i in range(2)] == [500, 500]
    small = write_capture(tmp_path / "small", 1, camera.scaled(16, 12)).frames
    mixed = new_lessons(
        (*frames, *small), BallWorld((BALL,)), [*masks, np.zeros((12, 16), bool)], SuperviseConfig(), draw
    )
    assert [int((mixed.photo == i).sum()) for i in range(3)] == [500, 500, 16 * 12], "each on its own"
    u = lessons.place % camera.width
    assert torch.equal(lessons.within(masks), (lessons.photo == 1) & (u >= 10) & (u < 20))
    for i, frame in enumerate(frames):
        mine = lessons.photo == i
        rays, image = camera_rays(camera, frame.world_from_cam), frame_image(frame).reshape(-1, 3).float() / 255
        torch.testing.assert_close(lessons.rays.directions[mine], rays.directions[lessons.place[mine]])
        for shown, pixel in zip(
            lessons.rgb[mine].T, image[lessons.place[mine]].T
        ):  # of its own pixel, in some exposure
            clear = ((shown > 0.01) & (shown < 0.99)).numpy()
            line = np.polyfit(pixel.numpy()[clear], shown.numpy()[clear], 1)
            assert clear.any() and np.abs(np.polyval(line, pixel.numpy()) - shown.numpy())[clear].max() < 1e-4


def test_pixels_kept_to_judge_by_teach_nothing_of_the_exposure(tmp_path: Path) -> None:
    """They are drawn first: another colour in them changes nothing of the others."""
    frames, world = write_capture(tmp_path, 1).frames, BallWorld((BALL,))

    def told() -> supervision.Lessons:
        masks = [np.zeros((f.camera.height, f.camera.width), bool) for f in frames]
        return new_lessons(frames, world, masks, SuperviseConfig(held_out=3), torch.Generator().manual_seed(0))

    first = told()
    assert 0.25 < float(first.held.float().mean()) < 0.42
    assert len(first.taught) + len(first.judging) == len(first) and not first.taught.held.any()
    image = frame_image(frames[0]).reshape(-1, 3).clone()
    image[first.place[first.held]] = 255 - image[first.place[first.held]]
    write_image(frames[0].path, image.reshape(frames[0].camera.height, frames[0].camera.width, 3).float() / 255)
    again = told()
    assert torch.equal(first.held, again.held) and torch.equal(first.taught.rgb, again.taught.rgb)
    assert not torch.equal(first.judging.rgb, again.judging.rgb)


def test_changed_pixels_hold_both_places() -> None:
    change = moved_ball((), ())
    changed = changed_pixels(change, places_of(change), 0, FRAME)
    for place in (BALL.world_from_ball, NEW @ BALL.world_from_ball):
        uv, _ = CAMERA.project(
            torch.linalg.inv(FRAME.world_from_cam)[:3] @ torch.cat([place[:3, 3], torch.ones(1).double()])
        )
        assert changed[int(uv[1]), int(uv[0])]
    assert changed.mean() < 0.6


def test_exposure_is_found_among_outliers_and_else_left_alone() -> None:
    g = torch.Generator().manual_seed(0)
    truth = torch.rand(3000, 3, generator=g) * 0.6 + 0.1
    noisy = truth + 0.01 * torch.randn(3000, 3, generator=g)
    photo = noisy * 0.8 + 0.05
    photo[:600] *= 0.5  # a shadow came
    affine = exposure(photo, truth)
    assert float((photo * affine[0] + affine[1] - truth)[600:].abs().mean()) < 0.015
    assert torch.equal(exposure(noisy, truth), torch.tensor([[1.0] * 3, [0.0] * 3]))
