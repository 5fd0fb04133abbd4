"""Eq. 3 and Eq. 16."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from refield.field.outlook import Outlook
from refield.field.warp import Move, move_in, outline, two_way
from refield.scene import pose
from refield.scene.change import OccupancyGrid


def ball(centre: tuple[float, float, float], radius: float, nodes: int = 33) -> OccupancyGrid:
    """A grid holding a ball, with half its radius of room around it."""
    c = torch.tensor(centre)
    grid = OccupancyGrid(torch.stack([c - 1.5 * radius, c + 1.5 * radius]), torch.zeros(nodes, nodes, nodes))
    inside = ((grid.nodes() - c).norm(dim=-1) < radius).float()
    return OccupancyGrid(grid.aabb, inside)


def points(n: int = 4000, seed: int = 0, half: float = 2.0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    x = (torch.rand(n, 3, generator=g) * 2 - 1) * half
    d = torch.randn(n, 3, generator=g)
    return x, d / d.norm(dim=-1, keepdim=True)


SHIFT = pose.exp(torch.tensor([1.2, 0.1, -0.2, 0.3, -0.5, 0.8], dtype=torch.float64))


def test_identity_changes_nothing() -> None:
    x, d = points()
    move = Move(ball((0.1, 0.2, 0.0), 0.5), torch.eye(4, dtype=torch.float64))
    at, along, owner = move_in(x, d, (move,))
    assert (owner == 0).any() and (owner < 0).any()
    torch.testing.assert_close(at, x, rtol=0, atol=1e-6)
    torch.testing.assert_close(along, d, rtol=0, atol=1e-6)


def test_a_point_of_the_moved_object_is_asked_at_its_old_place() -> None:
    x, d = points()
    move = Move(ball((-0.6, 0.0, 0.0), 0.4), SHIFT)
    at, along, owner = move_in(x, d, (move,))
    inside = move.grid.contains(pose.transform(pose.invert(SHIFT), x))
    assert torch.equal(owner == 0, inside) and inside.sum() > 10
    torch.testing.assert_close(pose.transform(SHIFT, at[inside]), x[inside], rtol=0, atol=1e-5)
    torch.testing.assert_close(pose.rotate(SHIFT, along[inside]), d[inside], rtol=0, atol=1e-5)
    assert torch.equal(at[~inside], x[~inside]) and torch.equal(along[~inside], d[~inside])


def test_the_first_of_two_objects_has_a_contested_point() -> None:
    a, b = ball((-1.0, 0, 0), 0.4), ball((1.0, 0, 0), 0.4)
    right, left = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    right[0, 3], left[0, 3] = 1.0, -1.0
    origin, d = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    for moves, old in (((Move(a, right), Move(b, left)), -1.0), ((Move(b, left), Move(a, right)), 1.0)):
        at, _, owner = move_in(origin, d, moves)
        assert owner.tolist() == [0]
        assert math.isclose(float(at[0, 0]), old, abs_tol=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3), st.floats(-3, 3))
def test_two_way_is_its_own_inverse_off_the_overlap(shift: list[float], yaw: float) -> None:
    new_from_old = pose.exp(torch.tensor([*shift, 0, 0, yaw], dtype=torch.float64))
    move = Move(ball((0.3, -0.2, 0.1), 0.4), new_from_old)
    x, d = points(half=3.0)
    once = two_way(x, d, (move,))
    twice = two_way(*once, (move,))
    # on the overlap a point of the new place asks inside the old place that is new place too
    overlap = move.grid.contains(x) & move.arrived(x)
    chained = move.arrived(once[0]) & move.grid.contains(once[0])
    # trilinear 0.5 levels are crossed by rounding: points within it of a border may fall on either side
    clean = ~overlap & ~chained & ((move.grid.sample(x) - 0.5).abs() > 1e-3)
    clean &= (move.grid.sample(pose.transform(move.old_from_new, x)) - 0.5).abs() > 1e-3
    assert clean.float().mean() > 0.9
    torch.testing.assert_close(twice[0][clean], x[clean], rtol=0, atol=1e-5)
    torch.testing.assert_close(twice[1][clean], d[clean], rtol=0, atol=1e-5)


def test_move_in_wins_over_two_way_exchange() -> None:
    small = pose.exp(torch.tensor([0.2, 0, 0, 0, 0, 0.4], dtype=torch.float64))
    move = Move(ball((0.0, 0.0, 0.0), 0.5), small)
    x, d = points(half=0.6)
    both = move.arrived(x) & move.grid.contains(x)
    assert both.any()
    one_way, _, _ = move_in(x, d, (move,))
    torch.testing.assert_close(two_way(x, d, (move,))[0][both], one_way[both])


def test_the_pose_can_be_refined_through_the_warp() -> None:
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    grid = ball((-0.6, 0.0, 0.0), 0.4)
    x, d = points(500)

    def total(t: torch.Tensor) -> torch.Tensor:
        at, along, owner = move_in(x.double(), d.double(), (Move(grid, pose.exp(t) @ SHIFT),))
        return (torch.sin(3 * at).sum(-1) + along[:, 0] * at[:, 1])[owner == 0].sum()

    (slope,) = torch.autograd.grad(total(twist), twist)
    for k in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[k] = 1e-6
        # the set of points inside must not change over the difference
        numeric = (total(twist.detach() + step) - total(twist.detach() - step)) / 2e-6
        assert math.isclose(float(slope[k]), float(numeric), rel_tol=1e-4, abs_tol=1e-5)


def test_the_outline_holds_everything_the_grid_contains() -> None:
    grid = ball((0, 0, 0), 1.0, nodes=9)
    soft = OccupancyGrid(grid.aabb, (1.45 - grid.nodes().norm(dim=-1)).clamp(0, 1))
    x, _ = points(50_000)
    for g in (grid, soft):
        box = outline(g)
        found = x[g.contains(x)]
        assert len(found) and (found >= box[0]).all() and (found <= box[1]).all()


def test_each_side_is_asked_from_where_it_was_seen() -> None:
    """Cameras around a ball's waist: its top is asked along one of their directions, a side along one that faces it."""
    turns = torch.arange(12) * 2 * math.pi / 12
    eyes = torch.stack([3 * turns.cos(), 3 * turns.sin(), torch.zeros(12)], -1)
    outlook = Outlook.from_eyes(eyes, ball((0.0, 0.0, 0.0), 0.5))
    assert math.isclose(outlook.reach, math.pi / 12, rel_tol=1e-3)
    east = torch.tensor([[0.48, 0.0, 0.0]])
    seen, unseen = torch.tensor([[-1.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    assert torch.equal(outlook.held(east, seen), seen)
    held = outlook.held(east, unseen)  # from within: no camera saw the east side along this
    assert float(held[0, 0]) < 0 and torch.allclose(held.norm(dim=-1), torch.ones(1))
    from_below = torch.tensor([[0.0, 0.0, 1.0]])
    assert abs(float(outlook.held(east, from_below)[0, 2])) <= math.sin(outlook.reach) + 1e-5


def test_the_compiled_search_of_directions_says_what_plain_torch_does() -> None:
    torch.manual_seed(0)
    eyes = 3 * torch.nn.functional.normalize(torch.randn(40, 3), dim=-1)
    outlook = Outlook.from_eyes(eyes, ball((0.0, 0.0, 0.0), 0.5))
    x, d = torch.randn(5000, 3) / 3, torch.nn.functional.normalize(torch.randn(5000, 3), dim=-1)
    for found, expected in zip(outlook.nearest(x, d), outlook.nearest_plainly(x, d)):
        assert torch.allclose(found, expected, atol=1e-6)
