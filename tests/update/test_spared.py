"""Parts of an update that show unchanged pixels worse are left out, the rest is kept."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from refield.field.render import render_many
from refield.scene.change import ObjectChange
from refield.update.composite import UpdatedField
from refield.update.learnt import Learnt
from refield.update.light import Relighting
from refield.update.region import move_out
from refield.update.spared import Spared, spared
from refield.update.supervision import Lessons
from tests.update.worlds import Ball, BallWorld, at, change_of, grid_of, views

OLD = Ball(at(-0.5, 0.2, 0.25), 0.25)
BESIDE = Ball(at(0.3, 0.6, 0.3), 0.3)
BEFORE, AFTER = BallWorld((OLD, BESIDE)), BallWorld((BESIDE,))
CHANGE = change_of(ObjectChange("removed", grid_of(OLD)))
DARK = Relighting(torch.tensor([[-1.2, -1.2, -0.2], [1.2, 1.2, 0.8]]), torch.full((9, 9, 9, 3), -0.4))
LIGHT, SURROUNDINGS = "the light on what stood still", "what is beside the objects' places"


class Tinted(BallWorld):
    """The world after, its floor in other colours."""

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        sigma, rgb = super().__call__(x, d)
        return sigma, 1 - rgb


def lessons(factor: float = 1.0) -> tuple[Lessons, Tensor]:
    """Three photos of the world after, so much brighter, and which of their pixels show what left."""
    rays = views(64)
    was, now = render_many(BEFORE, rays).rgb, render_many(AFTER, rays).rgb
    count = len(rays) // 3
    photo, place = torch.arange(3).repeat_interleave(count), torch.arange(count).repeat(3)
    seen = factor * render_many(UpdatedField(BEFORE, CHANGE, Learnt(AFTER)), rays).rgb
    return Lessons(rays, seen, photo, place, torch.ones_like(place, dtype=torch.bool)), (was - now).abs().amax(
        -1
    ) > 0.02


def test_light_that_is_wrong_is_left_out_and_the_rest_kept() -> None:
    updated = UpdatedField(BEFORE, CHANGE, Learnt(AFTER, light=DARK))
    kept = spared(updated, *lessons())
    assert kept.left_out[0].part == LIGHT and kept.left_out[0].gain > 3
    assert kept.field.light is None and kept.field.helper is AFTER


def test_light_that_is_right_stays() -> None:
    updated = UpdatedField(BEFORE, CHANGE, Learnt(AFTER, light=DARK))
    kept = spared(updated, *lessons(factor=float(torch.tensor(-0.4).exp())))
    assert kept.field is updated and kept.left_out == () and kept.lost == 0


def test_a_helper_that_is_wrong_about_the_surroundings_keeps_to_what_left() -> None:
    updated = UpdatedField(BEFORE, CHANGE, Learnt(Tinted((BESIDE,)), region=move_out(CHANGE, 2.0)))
    new, changed = lessons()
    kept = spared(updated, new, changed)
    assert [o.part for o in kept.left_out] == [SURROUNDINGS]
    assert kept.field.helper is updated.helper
    beside = torch.tensor([[-0.5, -0.2, 0.25], [-0.5, 0.2, 0.25]])  # inside the wide region only, inside both
    assert updated.region.contains(beside).all() and kept.field.region.contains(beside).tolist() == [False, True]


def test_what_no_pixel_contradicts_stays() -> None:
    updated = UpdatedField(BEFORE, CHANGE, Learnt(AFTER))
    new, changed = lessons()
    new = replace(new, rgb=render_many(updated, new.rays).rgb)
    assert spared(updated, new, changed) == Spared(updated)
    assert spared(updated, new, torch.ones_like(changed)) == Spared(updated)


def test_a_part_that_changed_pixels_need_stays_and_its_cost_is_told() -> None:
    """Two in three pixels are as the helper has it, and did change; the others say that it is wrong."""
    wrong = UpdatedField(BEFORE, CHANGE, Learnt(Tinted((BESIDE,)), region=move_out(CHANGE, 2.0)))
    new, _ = lessons()
    changed = torch.arange(len(new)) % 3 > 0
    rgb = torch.where(changed[:, None], render_many(wrong, new.rays).rgb, new.rgb)
    kept = spared(wrong, replace(new, rgb=rgb), changed)
    assert kept.field is wrong and kept.left_out == () and kept.lost > 1
