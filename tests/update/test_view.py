"""Pictures of an updated field by compiled loops: those that its own answers at all samples make."""

from __future__ import annotations

from dataclasses import replace

import torch

from refield.field.radiance import HashField, HashFieldConfig
from refield.field.render import render_many, render_rays
from refield.field.volrend import Rendering
from refield.field.warp import crosses, crossing
from refield.scene.capture import Rays
from refield.scene.change import ObjectChange, OccupancyGrid
from refield.scene.inside import spans
from refield.scene.pose import transform
from refield.update.composite import UpdatedField
from refield.update.learnt import Learnt
from refield.update.light import Relighting
from tests.update.test_composite import BESIDE, NEW, NEW_POSE, OLD, around
from tests.update.worlds import SPACE, STEP, Ball, BallWorld, at, change_of, grid_of, moved, views


def slab() -> HashField:
    """A hash field that is dense, in all colours, wherever there is something in a world of two balls."""
    base = HashField(HashFieldConfig(levels=4, finest=64, log2_table=12), BallWorld((OLD, BESIDE)).sampler)
    g = torch.Generator().manual_seed(2)
    with torch.no_grad():
        base.encoding.tables.uniform_(-1, 1, generator=g)
        base.density_out[0].copy_(base.density_out[0].abs() + 0.3)
    return base.eval().requires_grad_(False)


def light_on(low: tuple[float, float, float], high: tuple[float, float, float]) -> Relighting:
    gain = torch.zeros(9, 9, 9, 3)
    gain[2:7, 2:7, 2:7] = torch.tensor([-0.9, -0.6, 0.4])
    return Relighting(torch.tensor([low, high]), gain)


def once(base: HashField) -> UpdatedField:
    light = light_on((-1.2, -1.0, -0.3), (0.4, 1.0, 0.6))
    shading = light_on((-0.8, -0.1, 0.0), (-0.2, 0.5, 0.5))
    eyes = torch.tensor([[2.0, 0.0, 1.0], [0.0, 2.0, 1.0], [-2.0, 0.5, 1.0]])
    change = change_of(moved(OLD, NEW_POSE))
    field = UpdatedField(base, change, Learnt(BallWorld(()), light=light, shading=(shading,)), eyes=eyes)
    cells = base.sampler.cells_in(torch.tensor([[0.1, 0.5, 0.0], [0.4, 0.9, 0.6]]))
    return field.unshown(cells)


def assert_alike(field: UpdatedField, seen: Rendering) -> None:
    with torch.no_grad():
        truth = render_rays(field, views(64))
    for name, most in (("rgb", 2e-3), ("depth", 2e-2), ("opacity", 2e-3)):
        off = (getattr(truth, name) - getattr(seen, name)).abs() > most
        assert off.float().mean() < 2e-3, name  # a sample may fall to either side of a border


def test_a_view_shows_what_the_field_says() -> None:
    """A move with a helper, light, shading and cells that are not shown; a second visit on top of it."""
    base = slab()
    field = once(base)
    seen = render_many(field, views(64))
    assert_alike(field, seen)
    plain = render_many(base, views(64)).rgb
    assert (seen.rgb - plain).abs().amax(-1).gt(0.05).float().mean() > 0.1  # the change shows
    second = UpdatedField(field, change_of(moved(NEW, at(0.0, 0.9, 0.3)), ObjectChange("removed", grid_of(BESIDE))))
    assert_alike(second, render_many(second, views(64)))


def test_what_is_smaller_than_a_cell_is_shown_where_it_went() -> None:
    """At a cell's corner, so that no cell's centre is in it."""
    cell = 4 * SPACE.radius / 64
    tiny, there = Ball(at(4 * cell, 4 * cell, 4 * cell), 0.03), at(-4 * cell, -3 * cell, 4 * cell)
    base = slab()
    grid = torch.zeros_like(base.sampler.grid)
    grid.view(-1)[base.sampler.cells_in(tiny.world_from_ball[:3, 3].float().expand(2, 3))] = 1
    base.looking_where(grid)
    now = torch.zeros_like(grid)
    now.view(-1)[base.sampler.cells_in(there[:3, 3].float().expand(2, 3))] = 1
    field = UpdatedField(base, change_of(moved(tiny, there)), sampler=replace(base.sampler, grid=now))
    centre, low = there[:3, 3].float(), torch.tensor([-0.04, 0.0, 0.04])
    cells = field.sampler.cells(centre + torch.cartesian_prod(low, low, low)).unique()
    shell = field.moves[0].grid.contains(transform(field.moves[0].old_from_new, field.sampler.points_in(cells, False)))
    assert not shell.any()
    rays = Rays(
        torch.tensor([[0.0, -2.0, 1.0]]), torch.nn.functional.normalize(centre - torch.tensor([[0.0, -2.0, 1.0]]))
    )
    assert field.sampler.occupied(centre) and float(render_many(field, rays).opacity) > 0.1
    samples = field.samples(rays)
    x, _ = samples.positions(rays)
    near = (x - centre).norm(dim=-1) < 0.04
    assert near.any() and torch.allclose((samples.t_ends - samples.t_starts)[near], torch.tensor(STEP / 2), atol=1e-4)
    assert_alike(field, render_many(field, views(64)))


def test_chunks_do_not_matter() -> None:
    field = once(slab())
    whole, parts = render_many(field, views(64)), render_many(field, views(64), chunk=2500)
    for name in ("rgb", "depth", "opacity"):
        torch.testing.assert_close(getattr(parts, name), getattr(whole, name), atol=1e-5, rtol=1e-5)
    assert render_many(field, views(64)[:0]).rgb.shape == (0, 3)


def test_rays_that_meet_nothing_that_changed_show_the_hash_field_bit_for_bit() -> None:
    base = slab()
    light = light_on((-1.2, -1.0, -0.3), (-0.4, 0.0, 0.4))
    field = UpdatedField(base, change_of(moved(OLD, NEW_POSE)), Learnt(light=light))
    rays = views(64)
    was, now = render_many(base, rays), render_many(field, rays)
    (there,), (here,) = [o.grid for o in field.change.objects], [o.grid_now for o in field.change.objects]
    assert here is not None
    lit = OccupancyGrid(light.aabb, torch.ones(2, 2, 2))
    far = ~crosses(rays, [around(grid, 2.0) for grid in (there, here, lit)])
    assert 0.1 < float(far.float().mean()) < 0.9
    for name in ("rgb", "depth", "opacity"):
        assert torch.equal(getattr(was, name)[far], getattr(now, name)[far])


def test_what_is_hidden_is_not_asked_for() -> None:
    """Behind a wall nothing of what changed is evaluated."""
    field = once(slab())
    rays, asked = views(64), []
    answer = field.pretrained.forward

    def counted(x: torch.Tensor, d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        asked.append(len(x))
        return answer(x, d)

    field.pretrained.forward = counted  # type: ignore[method-assign]
    render_many(field, rays)
    few = sum(asked)
    asked.clear()
    with torch.no_grad():
        render_rays(field, rays)
    assert 0 < few < 0.5 * sum(asked)


def test_light_without_its_margins_is_the_same() -> None:
    light = light_on((-1.0, -1.0, -1.0), (1.0, 0.5, 1.5))
    small = light.cropped()
    assert small is not None and small.log_gain.shape == (7, 7, 7, 3)
    x, rgb = torch.rand(3000, 3) * 3 - 1.5, torch.rand(3000, 3)
    torch.testing.assert_close(small.applied(x, rgb), light.applied(x, rgb), atol=1e-5, rtol=1e-4)
    assert Relighting(light.aabb, torch.zeros(4, 4, 4, 3)).cropped() is None


def test_spans() -> None:
    rays = views(16)
    boxes = torch.tensor([[[-0.5, -0.5, 0.0], [0.0, 0.0, 0.5]], [[0.2, 0.2, 0.0], [0.8, 0.6, 0.3]]])
    enter, leave = spans(rays, boxes)
    each = [crossing(rays, box) for box in boxes]
    met = torch.stack([b > a for a, b in each])
    first = torch.stack([a for a, _ in each]).where(met, torch.inf).amin(0)
    last = torch.stack([b for _, b in each]).where(met, 0.0).amax(0)
    torch.testing.assert_close(enter, first, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(leave, last, atol=1e-4, rtol=1e-4)
    assert met.any(0).any() and not met.any(0).all()
