"""Eqs. 4 and 5: who answers for a point, and the laws of an updated field."""

from __future__ import annotations

import torch

from refield.field.radiance import HashField, HashFieldConfig
from refield.field.render import render_many
from refield.field.volrend import Samples, composite, interleaved
from refield.field.warp import crosses
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.update.composite import UpdatedField
from refield.update.learnt import Learnt
from refield.update.light import Relighting
from refield.update.region import carved, move_out
from tests.fields import small_field
from tests.update.worlds import Ball, BallWorld, at, change_of, grid_of, moved, views


def agreement(a: torch.Tensor, b: torch.Tensor) -> float:
    """PSNR over rays, dB."""
    return float(-10 * (a - b).square().mean().clamp_min(1e-12).log10())


def rgb(field: object) -> torch.Tensor:
    return render_many(field, views()).rgb  # type: ignore[arg-type]


OLD = Ball(at(-0.5, 0.2, 0.25), 0.25)
NEW_POSE = at(0.4, -0.3, 0.25, yaw=1.0)
NEW = Ball(NEW_POSE, 0.25)
BESIDE = Ball(at(0.3, 0.6, 0.3), 0.3)


def test_nothing_changed_changes_nothing() -> None:
    world = BallWorld((OLD, BESIDE))
    updated = UpdatedField(world, SceneChange())
    assert torch.equal(rgb(updated), rgb(world))


def test_commuting_square_for_a_moved_object() -> None:
    """render(world after) = render(update(world before)): the floor hides no part of what the helper must know."""
    before, after = BallWorld((OLD, BESIDE)), BallWorld((NEW, BESIDE))
    updated = UpdatedField(before, change_of(moved(OLD, NEW_POSE)), Learnt(after))
    assert agreement(rgb(before), rgb(after)) < 24  # the move shows
    assert agreement(rgb(updated), rgb(after)) > 34
    # the sampler's cells were recomputed: nothing is missing at the new place, nothing is left at the old
    assert updated.sampler.occupied(torch.tensor([[0.4, -0.3, 0.25]])).all()
    assert not updated.sampler.occupied(torch.tensor([[-0.5, 0.2, 0.25]])).any()


def test_commuting_square_for_two_moved_objects_that_swap() -> None:
    a, b = OLD, Ball(at(0.4, -0.3, 0.25), 0.25)
    to_b, to_a = at(0.4, -0.3, 0.25, 0.5), at(-0.5, 0.2, 0.25, -0.4)
    before, after = BallWorld((a, b)), BallWorld((Ball(to_b, 0.25), Ball(to_a, 0.25)))
    updated = UpdatedField(before, change_of(moved(a, to_b), moved(b, to_a)), Learnt(after))
    assert agreement(rgb(updated), rgb(after)) > 34


def test_commuting_square_for_removed_and_added() -> None:
    before, after = BallWorld((OLD,)), BallWorld((BESIDE,))
    change = change_of(ObjectChange("removed", grid_of(OLD)), ObjectChange("added", grid_of(BESIDE)))
    updated = UpdatedField(before, change, Learnt(after))
    assert agreement(rgb(updated), rgb(after)) > 40


def test_without_a_helper_the_old_object_is_cut_out() -> None:
    before = BallWorld((OLD, BESIDE), floor=False)
    updated = UpdatedField(before, change_of(ObjectChange("removed", grid_of(OLD))))
    x = OLD.world_from_ball[:3, 3].float() + 0.3 * torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    inside = updated.region.contains(x)
    assert inside.any()
    assert (updated.density(x)[inside] == 0).all()
    torch.testing.assert_close(updated.density(x)[~inside], before.density(x)[~inside])
    assert agreement(rgb(updated), rgb(BallWorld((BESIDE,), floor=False))) > 30


def test_an_added_object_is_not_cut() -> None:
    change = change_of(ObjectChange("added", grid_of(BESIDE)))
    assert carved(change).grids == ()
    world = BallWorld((OLD,))
    assert torch.equal(rgb(UpdatedField(world, change)), rgb(world))


def test_there_and_back_again() -> None:
    """Update by T, then by T⁻¹: the first pictures."""
    first = BallWorld((OLD, BESIDE))
    there = change_of(moved(OLD, NEW_POSE))
    back = change_of(moved(NEW, OLD.world_from_ball))
    empty = BallWorld((BESIDE,))  # what both places look like without the object
    second = UpdatedField(first, there, Learnt(empty))
    third = UpdatedField(second, back, Learnt(empty))
    assert agreement(rgb(second), rgb(first)) < 24
    assert agreement(rgb(third), rgb(first)) > 32


def test_move_in_wins_where_it_overlaps_the_region() -> None:
    near = at(-0.3, 0.2, 0.25, 0.3)
    before, after = BallWorld((OLD,)), BallWorld((Ball(near, 0.25),))
    empty = BallWorld(())
    updated = UpdatedField(before, change_of(moved(OLD, near)), Learnt(empty))
    assert move_out(updated.change, 2.0).contains(torch.tensor([[-0.3, 0.2, 0.25]])).all()
    assert agreement(rgb(updated), rgb(after)) > 32


def test_a_moved_object_takes_along_what_is_right_beneath_it_and_no_ground_beside() -> None:
    updated = UpdatedField(BallWorld((OLD,)), change_of(moved(OLD, NEW_POSE)), Learnt(BallWorld(())))
    beneath = torch.tensor([[0.4, -0.3, -0.005], [0.45, -0.33, -0.01]])
    assert (updated.arrived(beneath) == 0).all()
    beside = torch.tensor([[0.55, -0.3, -0.005], [0.4, -0.6, -0.01], [0.4, -0.3, -0.06]])
    assert (updated.arrived(beside) == -1).all()
    aloft = at(0.4, -0.3, 0.5)
    hanging = UpdatedField(BallWorld((OLD,)), change_of(moved(OLD, aloft)), Learnt(BallWorld(())))
    assert (hanging.arrived(beneath) == -1).all()


def test_gradients_reach_the_positions() -> None:
    """A second estimate refines a pose through an updated field."""
    updated = UpdatedField(BallWorld((OLD,)), change_of(moved(OLD, NEW_POSE)), Learnt(BallWorld(())))
    x = (NEW.world_from_ball[:3, 3].float() + 0.05 * torch.randn(50, 3)).requires_grad_()
    _, colour = updated(x, torch.nn.functional.normalize(torch.randn(50, 3), dim=-1))
    (slope,) = torch.autograd.grad(colour.sum(), x)
    assert slope.abs().sum() > 0


def test_interleaved_samples_are_in_order_on_every_ray() -> None:
    g = torch.Generator().manual_seed(0)
    counts = torch.randint(0, 5, (2, 7), generator=g)
    parts = []
    for row in counts:
        offsets = torch.cat([row.new_zeros(1), row.cumsum(0)])
        t = torch.rand(int(offsets[-1]), generator=g) * 9
        ids = torch.repeat_interleave(torch.arange(7), row)
        t = t[torch.argsort(ids * 10 + t)]
        parts.append(Samples(t, t + 0.1, offsets))
    both = interleaved(*parts)
    assert torch.equal(both.ray_offsets.diff(), counts.sum(0))
    for i in range(7):
        mine = slice(int(both.ray_offsets[i]), int(both.ray_offsets[i + 1]))
        wanted = torch.cat([p.t_starts[int(p.ray_offsets[i]) : int(p.ray_offsets[i + 1])] for p in parts])
        torch.testing.assert_close(both.t_starts[mine], wanted.sort().values)
        torch.testing.assert_close(both.t_ends[mine], wanted.sort().values + 0.1)


def test_samples_of_what_changed_are_half_as_long() -> None:
    base = HashField(HashFieldConfig(levels=4, finest=64, log2_table=12), BallWorld((OLD,)).sampler).eval()
    field = UpdatedField(base.requires_grad_(False), change_of(moved(OLD, NEW_POSE)))
    rays = views()
    samples = field.samples(rays)
    x, _ = samples.positions(rays)
    core = field.sampler.contraction.reach(x) < 0.9  # beyond 1 samples are longer
    changed = field.arrived(x) >= 0
    assert (changed & core).sum() > 100 and (~changed & core).sum() > 100
    length = (samples.t_ends - samples.t_starts) / field.sampler.step
    assert torch.allclose(length[changed & core], torch.tensor(0.5), atol=1e-3)
    torch.testing.assert_close(length[core].max(), torch.tensor(1.0), atol=1e-3, rtol=0)


def test_leaving_out_what_is_hidden_leaves_the_picture() -> None:
    """A hash field with an opaque slab: the marched samples show what all samples show, after one visit and two."""
    sampler = BallWorld((OLD,)).sampler
    base = HashField(HashFieldConfig(levels=4, finest=64, log2_table=12), sampler).eval().requires_grad_(False)
    base.encoding.tables.fill_(1.0)
    base.density_out[0].fill_(1.0)  # dense wherever the sampler looks
    once = UpdatedField(base, change_of(moved(OLD, NEW_POSE)))
    twice = UpdatedField(once, change_of(moved(NEW, at(0.0, 0.9, 0.3))))
    rays = views()
    for field in (once, twice):
        few, every = field.samples(rays), interleaved(*(part(rays) for part in field._marching.split))
        assert len(few) < 0.8 * len(every)
        seen = [composite(*field(*s.positions(rays)), s).rgb for s in (few, every)]
        assert float((seen[0] - seen[1]).abs().max()) < 5e-3


def around(grid: OccupancyGrid, factor: float) -> torch.Tensor:
    """A world box (2, 3), so many times as large as a grid's."""
    middle, half = grid.aabb.mean(0), (grid.aabb[1] - grid.aabb[0]) / 2
    return torch.stack([middle - factor * half, middle + factor * half])


def test_rays_that_meet_nothing_that_changed_show_the_old_field_bit_for_bit() -> None:
    """Whatever was learnt: a helper that is wrong everywhere, light that is wrong where there is any."""
    before, wrong = BallWorld((OLD, BESIDE)), small_field()
    change = change_of(moved(OLD, NEW_POSE))
    gain = torch.zeros(9, 9, 9, 3)
    gain[3:6, 3:6, 3:6] = -2.0
    light = Relighting(torch.tensor([[-1.2, -1.2, -0.2], [-0.4, -0.4, 0.6]]), gain)
    updated = UpdatedField(before, change, Learnt(wrong, light=light))
    rays = views(64)
    was, now = render_many(before, rays), render_many(updated, rays)
    (was_there,), (is_there,) = [o.grid for o in change.objects], [o.grid_now for o in change.objects]
    assert is_there is not None
    lit = torch.tensor([[-1.0, -1.0, 0.0], [-0.6, -0.6, 0.4]])
    cell = 2 * float(before.sampler.width(torch.tensor(1.0)))
    lit = torch.stack([lit[0] - cell, lit[1] + cell])
    far = ~crosses(rays, [around(was_there, 2.5), around(is_there, 2.5), lit])
    assert 0.1 < float(far.float().mean()) < 0.9
    for name in ("rgb", "depth", "opacity"):
        assert torch.equal(getattr(was, name)[far], getattr(now, name)[far])
    assert (was.rgb - now.rgb)[~far].abs().max() > 0.3  # and what is wrong shows where it is asked
    _, same = updated.unchanged(rays)
    assert torch.equal(was.rgb[same], now.rgb[same]) and same[far].all()
    dark = (was.rgb - now.rgb).abs().amax(-1) > 1e-3
    assert not (dark & same).any()


def test_a_second_visit_leaves_the_first_ones_pixels_as_they_are() -> None:
    first = UpdatedField(BallWorld((OLD, BESIDE)), change_of(moved(OLD, NEW_POSE)))
    second = UpdatedField(first, change_of(ObjectChange("removed", grid_of(BESIDE))))
    rays = views(64)
    _, same = second.unchanged(rays)
    was, now = render_many(first, rays).rgb, render_many(second, rays).rgb
    assert torch.equal(was[same], now[same]) and not torch.equal(was, now)
    assert (was != render_many(first.pretrained, rays).rgb)[same].any()  # some of them show what the first visit did
