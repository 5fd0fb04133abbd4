"""What an earlier visit knew is not learnt again, and a move that is taken back gives the old pictures back."""

from dataclasses import replace

import pytest
import torch

from refield.field.render import render_rays
from refield.scene.capture import Rays
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.pose import invert, rotate, transform
from refield.update.composite import UpdatedField, source_of
from refield.update.learnt import Learnt, Origin
from refield.update.light import Relighting
from refield.update.recall import earlier_of, without
from refield.update.region import Region, carved, move_out
from refield.update.store import load_updated, save_updated
from tests.fields import small_field
from tests.update.worlds import Ball, BallWorld, at, grid_of, moved, views

HERE, THERE, BEYOND = at(-0.5, 0, 0.25), at(0.4, 0.3, 0.25, 1.0), at(0.3, -0.6, 0.25, 2.0)


def ball(where=HERE) -> Ball:
    return Ball(where, 0.25)


def first_visit() -> tuple[BallWorld, UpdatedField]:
    """A ball went from HERE to THERE; the helper knows the floor."""
    before, after = BallWorld((ball(),)), BallWorld((ball(THERE),))
    change = SceneChange((moved(ball(), THERE),))
    return before, UpdatedField(before, change, Learnt(after))


def next_move(to: torch.Tensor) -> ObjectChange:
    """The same ball, as a later estimate finds it: from THERE."""
    return ObjectChange("moved", grid_of(ball(THERE)), to @ invert(THERE))


def test_a_second_move_uncovers_what_was_there():
    _, now = first_visit()
    change = SceneChange((next_move(BEYOND),))
    base, earlier = earlier_of(now, change, 1.5)
    assert base is now and earlier.left == (Origin(0, 0, 0),) and not earlier.undone
    again = UpdatedField(base, change, earlier=earlier)
    assert again.to_learn.objects == ()
    truth = BallWorld((ball(BEYOND),))
    rays = views()
    error = (render_rays(again, rays).rgb - render_rays(truth, rays).rgb).abs()
    assert float(error.mean()) < 0.01
    assert float((error.amax(-1) > 0.2).float().mean()) < 0.02  # edges


def test_however_often_it_moved_it_is_looked_up_where_it_first_was():
    before, _ = first_visit()
    nodes = torch.randn(3, 3, 3, 3, generator=torch.Generator().manual_seed(0)) / 5
    boxes = [carved(SceneChange((moved(ball(p), BEYOND),))).box for p in (HERE, THERE)]
    shades = [Relighting(boxes[0], nodes), Relighting(boxes[1], 2 * nodes)]
    # after the first visit the light changes where it stands now, by a visit that moves something else
    light = Relighting(move_out(SceneChange((moved(ball(THERE), BEYOND),)), 1.5).box, -nodes)
    far = moved(Ball(at(0.0, 0.9, 0.25), 0.1), at(0.0, 1.2, 0.25))
    once = UpdatedField(before, SceneChange((moved(ball(), THERE),)), Learnt(shading=(shades[0],)))
    lit = UpdatedField(once, SceneChange((far,)), Learnt(light=light))
    twice = UpdatedField(lit, SceneChange((next_move(BEYOND),)), Learnt(shading=(shades[1],)))
    (source,) = twice.sources
    assert source is not None and source.field is before and len(source.lights) == 2
    assert torch.allclose(source.now_from_then, THERE @ invert(HERE))
    now = source_of(twice, grid_of(ball(BEYOND)))
    assert now is not None and now.field is before and len(now.lights) == 3
    x = BEYOND[:3, 3].float() + torch.randn(500, 3, generator=torch.Generator().manual_seed(1)) * 0.05
    d = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    back = invert(now.now_from_then)
    density, colour = twice(x, d)
    expected, shown = now(transform(back, x), rotate(back, d))
    assert torch.allclose(density, expected) and torch.allclose(colour, shown, atol=1e-4)
    # one after the other: the light at each place where it stood, and then what turned it
    at_there = transform(THERE @ invert(BEYOND), x)
    _, was = lit(at_there, rotate(THERE @ invert(BEYOND), d))
    assert torch.allclose(colour, shades[1].applied(at_there, was), atol=1e-3)
    assert not torch.allclose(colour, was, atol=0.02)


def test_what_it_takes_along_that_it_never_had_before_is_not_looked_up_there():
    low, high = ball(THERE), Ball(at(0.4, 0.3, 0.58), 0.08)  # another thing, on top of it
    before = BallWorld((ball(), high))
    once = UpdatedField(before, SceneChange((moved(ball(), THERE),)), Learnt(before))
    both = OccupancyGrid(torch.tensor([[0.1, 0.0, -0.05], [0.7, 0.6, 0.7]]), torch.zeros(31, 31, 38))
    held = [grid_of(b).contains(both.nodes()) for b in (low, high)]
    change = SceneChange(
        (ObjectChange("moved", replace(both, values=(held[0] | held[1]).float()), BEYOND @ invert(THERE)),)
    )
    twice = UpdatedField(once, change)
    assert twice.sources[0] is not None
    centres = torch.stack([low.world_from_ball[:3, 3], high.world_from_ball[:3, 3]])
    now = transform(BEYOND @ invert(THERE), centres).float()
    assert (twice.density(now) > 100).all()


def test_what_a_helper_has_learnt_of_an_object_is_looked_up_there():
    before, _ = first_visit()
    came = UpdatedField(before, SceneChange((ObjectChange("added", grid_of(ball(BEYOND))),)), Learnt(before))
    assert source_of(came, grid_of(ball(BEYOND))) is None
    assert source_of(before, grid_of(ball())) is None
    bare = Region((grid_of(Ball(THERE, 0.1)),))
    part = UpdatedField(before, SceneChange((moved(ball(), THERE),)), Learnt(before, bare=bare))
    assert source_of(part, grid_of(ball(THERE))) is None


def test_what_was_not_shown_is_not_shown_when_the_object_leaves_again():
    _, now = first_visit()
    beside = THERE[:3, 3].float() + torch.tensor([0.15, 0.0, -0.29])  # in the floor
    cell = now.sampler.cells(beside)[None]
    assert now.sampler.occupied(beside)
    dark = now.unshown(cell)
    assert not dark.sampler.occupied(beside)
    change = SceneChange((next_move(BEYOND),))
    for state, shown in ((now, True), (dark, False)):
        base, earlier = earlier_of(state, change, 1.5)
        assert earlier.places.contains(beside[None]).all()
        assert bool(UpdatedField(base, change, earlier=earlier).sampler.occupied(beside)) == shown


def test_a_move_that_is_taken_back_gives_the_old_pictures_back():
    before, now = first_visit()
    home = HERE.clone()
    home[:3, 3] += 0.004  # an estimate is not exact
    change = SceneChange((next_move(home),))
    base, earlier = earlier_of(now, change, 1.5)
    assert base is before and earlier.undone == (Origin(0, 0, 0),)
    back = UpdatedField(base, change, earlier=earlier)
    rays = views()
    assert torch.equal(render_rays(back, rays).rgb, render_rays(before, rays).rgb)


def test_a_move_in_two_steps_is_taken_back_in_one():
    before, now = first_visit()
    on = SceneChange((next_move(BEYOND),))
    base, earlier = earlier_of(now, on, 1.5)
    twice = UpdatedField(base, on, earlier=earlier)
    change = SceneChange((ObjectChange("moved", grid_of(ball(BEYOND)), HERE @ invert(BEYOND)),))
    base, earlier = earlier_of(twice, change, 1.5)
    assert base is before and earlier.undone == (Origin(0, 0, 0), Origin(0, 0, 0))


def test_a_newcomer_that_was_moved_leaves_again():
    before = BallWorld(())
    came = SceneChange((ObjectChange("added", grid_of(ball())),))
    now = UpdatedField(before, came, Learnt(BallWorld((ball(),))))
    on = SceneChange((moved(ball(), THERE),))
    base, earlier = earlier_of(now, on, 1.5)
    assert earlier.left == (Origin(0, 0, 0),)
    there = UpdatedField(base, on, earlier=earlier)
    gone = SceneChange((ObjectChange("removed", grid_of(ball(THERE))),))
    base, earlier = earlier_of(there, gone, 1.5)
    assert base is before and len(earlier.undone) == 2


def test_what_was_removed_and_is_put_back():
    before = BallWorld((ball(), ball(BEYOND)))
    gone = SceneChange((ObjectChange("removed", grid_of(ball())), ObjectChange("removed", grid_of(ball(BEYOND)))))
    now = UpdatedField(before, gone, Learnt(BallWorld(())))
    change = SceneChange((ObjectChange("added", grid_of(ball())),))
    base, earlier = earlier_of(now, change, 1.5)
    assert earlier.undone == (Origin(0, 0, 0),)
    back = UpdatedField(base, change, earlier=earlier)
    rays = views()
    error = (render_rays(back, rays).rgb - render_rays(BallWorld((ball(),)), rays).rgb).abs()
    assert float(error.mean()) < 0.01


def test_a_newcomer_that_leaves_again():
    before = BallWorld(())
    came = SceneChange((ObjectChange("added", grid_of(ball())), ObjectChange("added", grid_of(ball(BEYOND)))))
    now = UpdatedField(before, came, Learnt(BallWorld((ball(), ball(BEYOND)))))
    change = SceneChange((ObjectChange("removed", grid_of(ball())),))
    base, earlier = earlier_of(now, change, 1.5)
    left = UpdatedField(base, change, earlier=earlier)
    rays = views()
    error = (render_rays(left, rays).rgb - render_rays(BallWorld((ball(BEYOND),)), rays).rgb).abs()
    assert float(error.mean()) < 0.01


def test_what_never_moved_has_no_earlier():
    before, now = first_visit()
    change = SceneChange((ObjectChange("removed", grid_of(ball(BEYOND))),))
    base, earlier = earlier_of(now, change, 1.5)
    assert base is now and not earlier
    assert not earlier_of(before, change, 1.5)[1]
    with pytest.raises(ValueError, match="not had so many changes"):
        without(now, Origin(0, 1, 0), departed=False)


def test_an_edit_goes_through_later_layers():
    _, now = first_visit()
    other = SceneChange((ObjectChange("removed", grid_of(ball(BEYOND))),))
    later = UpdatedField(now, other, Learnt(BallWorld(())))
    change = SceneChange((next_move(BEYOND),))
    _, earlier = earlier_of(later, change, 1.5)
    assert earlier.left == (Origin(0, 1, 0),)
    assert isinstance(earlier.ground, UpdatedField) and earlier.ground.change.objects == other.objects
    inner = earlier.ground.pretrained
    assert isinstance(inner, UpdatedField) and [o.kind for o in inner.change.objects] == ["removed"]


def test_it_is_stored(tmp_path):
    old = small_field(0)
    there = SceneChange((moved(ball(), THERE), ObjectChange("removed", grid_of(ball(BEYOND)))))
    now = UpdatedField(old, there, Learnt(small_field(1)))
    for change in (SceneChange((next_move(at(0.6, 0.6, 0.3)),)), SceneChange((next_move(HERE),))):
        base, earlier = earlier_of(now, change, 1.5)
        assert earlier
        field = UpdatedField(base, change, earlier=earlier)
        save_updated(tmp_path, field)
        back = load_updated(tmp_path, now, change)
        assert replace(back.earlier, ground=None, places=earlier.places) == replace(earlier, ground=None)
        x, d = torch.rand(3000, 3) * 2 - 1, torch.nn.functional.normalize(torch.randn(3000, 3), dim=-1)
        for ours, theirs in zip(field(x, d), back(x, d)):
            assert torch.equal(ours, theirs)
        rays = Rays(torch.tensor([[0.0, 0.0, 3.0]]).expand(200, 3), torch.nn.functional.normalize(x[:200] - 3, dim=-1))
        assert torch.equal(render_rays(field, rays).rgb, render_rays(back, rays).rgb)
