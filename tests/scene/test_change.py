"""Occupancy grids against shapes whose insides are known by formula."""

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings

from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto
from refield.scene.pose import exp, invert, transform


def ball(radius: float = 0.4, size: int = 41, centre: tuple[float, float, float] = (0.2, -0.1, 0.3)):
    """A soft ball: value 0.5 lies on its surface."""
    c = torch.tensor(centre)
    grid = OccupancyGrid(torch.stack([c - 0.6, c + 0.6]), torch.zeros(size, size + 4, size - 6))
    distance = (grid.nodes() - c).norm(dim=-1)
    return OccupancyGrid(grid.aabb, (0.5 + (radius - distance) / 0.1).clamp(0, 1)), c


def points(count: int = 4000):
    return (torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * 3


def test_contains_a_ball():
    grid, centre = ball()
    x = points() * 0.5 + centre
    distance = (x - centre).norm(dim=-1)
    clear = (distance - 0.4).abs() > 0.01
    assert torch.equal(grid.contains(x)[clear], (distance < 0.4)[clear])


def test_sample_is_trilinear_and_zero_outside():
    lo, hi = torch.tensor([-1.0, 0.0, 2.0]), torch.tensor([1.0, 1.0, 5.0])
    ramp = OccupancyGrid(torch.stack([lo, hi]), torch.zeros(5, 6, 7))
    weights = torch.tensor([0.1, 0.2, 0.05])
    ramp = OccupancyGrid(ramp.aabb, (ramp.nodes() - lo) @ weights)
    x = lo + torch.rand(200, 3) * (hi - lo)
    assert torch.allclose(ramp.sample(x), (x - lo) @ weights, atol=1e-5)
    assert (ramp.sample(x + torch.tensor([2.5, 0, 0])) == 0).all()
    assert ramp.sample(x.reshape(10, 20, 3)).shape == (10, 20)


@settings(deadline=None, max_examples=5)
@given(st.floats(1.2, 3.0))
def test_dilation_grows_a_ball_by_the_same_everywhere(factor):
    grid, centre = ball()
    box = grid.tight_aabb()
    reach = float((box[1] - box[0]).mean()) * (factor - 1) / 2
    x = points() * 1.2 + centre
    distance = (x - centre).norm(dim=-1)
    clear = (distance - 0.4 - reach).abs() > 0.08
    grown = grid.dilated(factor)
    assert torch.equal(grown.contains(x)[clear], (distance < 0.4 + reach)[clear])
    sides = (grown.tight_aabb()[1] - grown.tight_aabb()[0]) / (box[1] - box[0])
    assert (sides - factor).abs().max() < 0.25


@settings(deadline=None, max_examples=10)
@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6))
def test_moved_grid_contains_the_moved_points(twist):
    grid, centre = ball(centre=(0.4, 0.0, -0.2))
    new_from_old = exp(torch.tensor(twist, dtype=torch.float64))
    now = grid.moved(new_from_old)
    x = points() * 0.6 + centre
    clear = ((x - centre).norm(dim=-1) - 0.4).abs() > 0.05
    assert torch.equal(now.contains(transform(new_from_old, x))[clear], grid.contains(x)[clear])
    back = now.moved(invert(new_from_old))
    assert torch.equal(back.contains(x)[clear], grid.contains(x)[clear])


def test_tight_box_and_occupied_points():
    grid, centre = ball()
    box = grid.tight_aabb()
    assert torch.allclose(box.mean(0), centre, atol=0.02)
    assert torch.allclose(box[1] - box[0], torch.full((3,), 0.8), atol=0.06)
    inside = grid.occupied()
    assert ((inside >= box[0]) & (inside <= box[1])).all()
    empty = OccupancyGrid(grid.aabb, torch.zeros_like(grid.values))
    assert torch.equal(empty.tight_aabb(), grid.aabb) and len(empty.occupied()) == 0


def test_kinds_and_pose_changes_belong_together():
    grid, _ = ball(size=9)
    eye = torch.eye(4, dtype=torch.float64)
    with pytest.raises(ValueError, match="moved"):
        ObjectChange("moved", grid)
    with pytest.raises(ValueError, match="moved"):
        ObjectChange("removed", grid, eye)
    with pytest.raises(ValueError, match="no pose change"):
        _ = ObjectChange("added", grid).old_from_new
    assert ObjectChange("removed", grid).grid_now is None
    assert ObjectChange("added", grid).grid_now is grid
    with pytest.raises(ValueError, match="frame"):
        PlacedPhoto("a", "used")
