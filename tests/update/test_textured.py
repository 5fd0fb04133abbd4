"""A plane with a texture: where it is, what it shows, and what a field of it does."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from refield.field.render import render_many
from refield.scene.capture import Rays
from refield.scene.change import ObjectChange
from refield.update.composite import UpdatedField
from refield.update.learnt import Learnt, Origin
from refield.update.recall import without
from refield.update.region import Region, carved, forgotten, move_out, without_planes
from refield.update.textured import TexturedPlane
from tests.update.worlds import Ball, BallWorld, at, change_of, grid_of, moved, views

OLD = Ball(at(-0.5, 0.2, 0.25), 0.25)


def floor(centre: tuple[float, float] = (-0.5, 0.2), side: float = 1.0, texel: float = 0.01) -> TexturedPlane:
    """The floor of a `BallWorld` around a point."""
    n = round(side / texel) + 1
    origin = torch.tensor([centre[0] - side / 2, centre[1] - side / 2, 0.0])
    axes, up = torch.eye(3)[:2], torch.tensor([0.0, 0.0, 1.0])
    blank = TexturedPlane(up, origin, axes, texel, 0.05, 0.02, torch.zeros(n, n, 3), torch.ones(n, n, dtype=torch.bool))
    return replace(blank, rgb=(0.5 + 0.4 * torch.sin(6 * blank.nodes)).reshape(n, n, 3))


def test_it_holds_a_layer_under_known_texels_and_what_is_right_above() -> None:
    plane = floor()
    x = torch.tensor([[-0.5, 0.2, z] for z in (0.03, 0.01, -0.01, -0.06)] + [[0.3, 0.2, -0.01]])
    assert plane.contains(x).tolist() == [False, True, True, False, False]
    assert plane.opaque(x[1:3]).tolist() == [False, True]
    known = plane.known.clone()
    known[50, 50] = False  # the texel at (-0.5, 0.2)
    assert not replace(plane, known=known).contains(x).any()
    assert ((plane.box[0] <= x[1:3]) & (x[1:3] <= plane.box[1])).all()


def test_a_ray_sees_the_texel_at_which_it_came_in() -> None:
    plane = floor()
    d = functional.normalize(torch.tensor([[1.0, 0.3, -0.4]]), dim=-1)
    entered = torch.tensor([[-0.6, 0.1, 0.0]])
    beneath = entered + 0.03 * d
    truth = 0.5 + 0.4 * torch.sin(6 * entered)
    assert torch.allclose(plane.colours(beneath, d), truth, atol=2e-3)
    assert (
        plane.colours(beneath, torch.tensor([[0.0, 0.0, -1.0]])) - truth
    ).abs().max() > 0.05  # right above it: another
    rays = Rays(torch.cat([entered - d, entered - d, entered + d]), torch.cat([d, -d, d]))
    assert torch.allclose(plane.met(rays)[0], torch.tensor(1.0), atol=1e-4)
    assert plane.met(rays)[1:].isinf().all()  # upwards, and from behind
    assert plane.hit(rays).tolist() == [True, False, False]


def test_a_texture_and_its_mask_must_fit() -> None:
    with pytest.raises(ValueError, match="differ"):
        replace(floor(), rgb=torch.zeros(3, 3, 3))


def hollow() -> BallWorld:
    """The floor, black under the ball: no photo saw it."""

    class Hollow(BallWorld):
        def __call__(self, x: torch.Tensor, d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            sigma, rgb = super().__call__(x, d)
            under = ((x[..., :2] - torch.tensor([-0.5, 0.2])).norm(dim=-1) < 0.2) & (x[..., 2] <= 0)
            return sigma, torch.where(under[..., None], 0.0, rgb)

    return Hollow((OLD,))


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * (a - b).square().mean().log10())


def test_an_updated_field_shows_it_in_place_of_what_was_there() -> None:
    change, after = change_of(ObjectChange("removed", grid_of(OLD))), render_many(BallWorld(()), views()).rgb
    gone = carved(change, 0.03)
    plain = UpdatedField(hollow(), change, Learnt(region=gone))
    shown = UpdatedField(hollow(), change, Learnt(region=Region(gone.grids, (floor(),))))
    assert psnr(render_many(plain, views()).rgb, after) < 26
    assert psnr(render_many(shown, views()).rgb, after) > 33
    sigma, _ = shown(torch.tensor([[-0.5, 0.2, -0.01], [-0.5, 0.2, 0.01]]), torch.tensor([[0.0, 0.0, -1.0]] * 2))
    assert float(sigma[0]) == pytest.approx(10 / (BallWorld(()).sampler.step / 2)) and sigma[1] == 0
    assert torch.equal(shown.density(torch.tensor([[-0.5, 0.2, -0.01]])), sigma[:1])


def test_what_moved_in_goes_before_it() -> None:
    change = change_of(moved(OLD, at(-0.2, 0.2, 0.25)))
    field = UpdatedField(hollow(), change, Learnt(region=Region(carved(change).grids, (floor(side=1.4),))))
    x = torch.tensor([[-0.2, 0.2, 0.005]])  # in the ball, and right above the floor
    assert field.density(x) > 100


def test_a_helper_leaves_it_alone() -> None:
    change = change_of(ObjectChange("removed", grid_of(OLD)))
    sampler = move_out(change, 1.5).sampler(0.02)
    x = torch.tensor([[-0.5, 0.2, z] for z in (0.2, -0.01, -0.1)])
    assert sampler.occupied(x).all()
    assert without_planes(sampler, (floor(),)).occupied(x).tolist() == [True, False, True]
    assert torch.equal(without_planes(sampler, ()).grid, sampler.grid)


def test_places_are_forgotten() -> None:
    (plane,) = forgotten((floor(),), Region((grid_of(Ball(at(-0.5, 0.2, 0.0), 0.3)),)), Region(()))
    assert not plane.over(plane.known, torch.tensor([[-0.5, 0.2, 0.0]])).any()
    assert plane.over(plane.known, torch.tensor([[-0.1, 0.2, 0.0]])).all()
    everywhere = Region((grid_of(Ball(at(-0.5, 0.2, 0.0), 2.0)),))
    assert forgotten((floor(),), everywhere, Region(())) == ()
    assert torch.equal(forgotten((floor(),), everywhere, everywhere)[0].known, floor().known)


def test_an_object_that_leaves_again_takes_its_shadow_along() -> None:
    """Around its last place the old field shows the floor; where it first stood only the plane does."""
    there = at(0.5, -0.3, 0.25)
    change = change_of(moved(OLD, there))
    region = Region(move_out(change, 1.5).grids, (floor((0.0, 0.0), 2.4, 0.02),))
    field = UpdatedField(hollow(), change, Learnt(BallWorld((), floor=False), region=region))
    left = without(field, Origin(0, 0, 0), departed=True)
    assert isinstance(left, UpdatedField)
    first, last = torch.tensor([[-0.5, 0.2, 0.0]]), torch.tensor([[0.5, -0.3, 0.0]])
    (plane,) = left.region.planes
    assert plane.over(plane.known, first).all() and not plane.over(plane.known, last).any()
    after = render_many(BallWorld(()), views()).rgb
    assert psnr(render_many(left, views()).rgb, after) > 30
