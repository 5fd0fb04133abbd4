"""What the new photos show of the ground is found as it is; what they do not agree on is left alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_many
from refield.scene.camera import Camera
from refield.scene.capture import camera_rays
from refield.scene.change import ObjectChange
from refield.scene.planes import Plane
from refield.update.composite import UpdatedField
from refield.update.fit_textured import _apart, textured_planes
from refield.update.ground import footholds
from refield.update.learnt import NOWHERE
from refield.update.region import Region, move_out
from refield.update.supervision import Lessons
from refield.update.textured import TexturedPlane
from tests.update.worlds import Ball, BallWorld, at, change_of, grid_of, looking_from

CAMERA = Camera(96, 96, 150.0, 150.0, 48.0, 48.0)
PIXEL = 3.4 / 150
OLD = Ball(at(0.0, 0.0, 0.25), 0.25)
CHANGE = change_of(ObjectChange("removed", grid_of(OLD)))
LEVEL = Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)


@dataclass(frozen=True)
class Lit:
    """A world whose floor is darker on one side."""

    world: BallWorld

    @property
    def sampler(self):
        return self.world.sampler

    def density(self, x: Tensor) -> Tensor:
        return self.world.density(x)

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        sigma, rgb = self.world(x, d)
        return sigma, rgb * (1 - 0.4 * torch.sigmoid(8 * x[..., :1]))


def photos(world: Field, turns: Sequence[float]) -> Lessons:
    parts = []
    for i, turn in enumerate(turns):
        rays = camera_rays(CAMERA, looking_from(turn, 3.0, 1.6))
        n = len(rays)
        t = -rays.origins[:, 2] / rays.directions[:, 2].clamp(max=-1e-3)
        x = rays.origins + t[:, None] * rays.directions - torch.tensor([0, 0, 1e-5])
        exact = world(x, rays.directions)[1]  # of the floor; a rendering shows it from half a sample beneath
        near = render_many(world, rays)
        first = (near.depth < t - 0.05) & (near.opacity > 0.5)
        rgb = torch.where(first[:, None], near.rgb, exact)
        parts.append(Lessons(rays, rgb, torch.full((n,), i), torch.arange(n), torch.zeros(n, dtype=torch.bool)))
    first, *rest = parts
    for part in rest:
        first = first.followed_by(part)
    return first


def found(
    lessons: Lessons, plane: Plane = LEVEL, unsure: Region = NOWHERE, patterned: bool = True
) -> tuple[TexturedPlane, ...]:
    cut = UpdatedField(BallWorld((OLD,)), CHANGE)
    dark = replace(cut.sampler, grid=torch.zeros_like(cut.sampler.grid))
    ground = footholds([CHANGE.objects[0].grid], [plane])
    return textured_planes(ground, move_out(CHANGE, 2.0), cut, dark, unsure, lessons, PIXEL, patterned=patterned)


def seen(plane: TexturedPlane, truth: Field, radius: float = 1.0) -> tuple[float, float]:
    """PSNR of its known texels around the origin, and how many of them are known."""
    x = plane.nodes
    near = x[:, :2].norm(dim=-1) < radius
    known = near & plane.known.reshape(-1)
    _, rgb = truth(
        x[known] * torch.tensor([1.0, 1.0, 0.0]) - torch.tensor([0, 0, 1e-4]), torch.zeros(int(known.sum()), 3)
    )
    error = (plane.rgb.reshape(-1, 3)[known] - rgb).square().mean()
    return float(-10 * error.log10()), float(known.sum() / near.sum())


AFTER = BallWorld(())


def test_one_photo_is_enough() -> None:
    (plane,) = found(photos(AFTER, [0.4]))
    quality, part = seen(plane, AFTER, 0.12)  # under the ball
    assert quality > 36 and part == 1
    assert seen(plane, AFTER)[0] > 34
    assert float(plane.height(torch.zeros(1, 3)).abs()) < 5e-4  # hardly anything said that it is off


def test_two_photos_put_the_plane_right() -> None:
    tilted = np.array([0.01, -0.006, 1.0], np.float32)
    off = Plane(tilted / np.linalg.norm(tilted), 0.008, 0.004)
    (plane,) = found(photos(AFTER, [0.4, 2.2]), off)
    there = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.0]])
    before = torch.from_numpy(off.height(there.numpy())).abs()
    assert (plane.height(there).abs() < 0.35 * before.max()).all()
    assert seen(plane, AFTER)[0] > 32


def test_where_no_photo_looks_the_old_texture_goes_on_in_the_new_light() -> None:
    now = Lit(AFTER)
    lessons = photos(now, [0.4, 2.2])
    t = -lessons.rays.origins[:, 2] / lessons.rays.directions[:, 2]
    x = lessons.rays.origins + t[:, None] * lessons.rays.directions
    shown = (t > 0) & ~((x[:, 0] > 0.25) & (x[:, 0] < 0.4))
    (plane,) = found(lessons[shown])
    strip = (plane.nodes[:, 0] > 0.27) & (plane.nodes[:, 0] < 0.38) & plane.known.reshape(-1)
    assert strip.any()
    only = replace(plane, known=strip.reshape(plane.known.shape))
    assert seen(only, now)[0] > 26 > 16 > seen(only, AFTER)[0]


def test_what_stands_there_is_not_painted_on_the_ground() -> None:
    """Photos from three sides do not agree on a ball of which nobody knows."""
    stands = Ball(at(0.0, 0.0, 0.1), 0.1)
    now = BallWorld((stands,))
    (plane,) = found(photos(now, [0.0, math.tau / 3, 2 * math.tau / 3]))
    assert seen(plane, now, 0.1)[1] < 0.3
    lessons, unsure = photos(now, [0.4]), Region((grid_of(stands),))
    (told,) = found(lessons, unsure=unsure, patterned=False)
    behind = torch.tensor([[-0.25 * math.cos(0.4), -0.25 * math.sin(0.4), 0.0]])  # hidden from that photo
    assert not told.over(told.known, torch.tensor([[0.0, 0.0, 0.0]])).any()
    assert seen(told, now)[0] > 28 and told.over(told.known, behind).all()
    (told,) = found(lessons, unsure=unsure)
    quality, part = seen(told, now, 0.1)  # the floor goes on beneath the ball, and nothing of the ball is painted on it
    assert quality > 34 and part == 1


def test_photos_that_do_not_show_it_say_nothing() -> None:
    lessons = photos(AFTER, [0.4])
    x = lessons.rays.origins + lessons.rays.directions * (-lessons.rays.origins[:, 2:] / lessons.rays.directions[:, 2:])
    away = lessons[(x[:, :2].norm(dim=-1) > 0.8).nonzero()[:, 0]]
    assert len(away) > 1000 and found(away) == ()
    assert found(lessons[:50]) == ()


def test_half_of_the_ground_may_be_out_of_sight() -> None:
    """Texels far from all that a photo shows are those of the old field in the light beside them, not some mean."""
    now = Lit(AFTER)
    lessons = photos(now, [0.4, 2.2])
    x = lessons.rays.origins + lessons.rays.directions * (-lessons.rays.origins[:, 2:] / lessons.rays.directions[:, 2:])
    (plane,) = found(lessons[(x[:, 1] > 0).nonzero()[:, 0]])
    hidden = (plane.nodes[:, 1] < -0.3).reshape(plane.known.shape) & plane.known
    assert hidden.sum() > 300
    assert seen(replace(plane, known=hidden), now)[0] > 24


def test_places_far_apart_have_textures_of_their_own() -> None:
    far = grid_of(Ball(at(0.9, 0.9, 0.1), 0.1))
    cut = UpdatedField(BallWorld((OLD,)), CHANGE)
    dark = replace(cut.sampler, grid=torch.zeros_like(cut.sampler.grid))
    around = Region((CHANGE.objects[0].grid.dilated(1.5), far.dilated(1.5)))
    ground = footholds([CHANGE.objects[0].grid], [LEVEL])
    planes = textured_planes(ground, around, cut, dark, NOWHERE, photos(AFTER, [0.4]), PIXEL)
    assert len(planes) == 2 and all(seen(p, AFTER, 3.0)[0] > 33 for p in planes)


def test_places_that_touch_are_one_however_many_there_are() -> None:
    at_x = [grid_of(Ball(at(x, 0.0, 0.25), 0.25)) for x in (0.0, 3.0, 0.4, 6.0, 3.4)]
    parts = [{round(float(g.aabb[:, 0].mean()), 1) for g in part.grids} for part in _apart(Region(tuple(at_x)))]
    assert sorted(parts, key=min) == [{0.0, 0.4}, {3.0, 3.4}, {6.0}]
