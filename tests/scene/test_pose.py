"""SE(3) is a group, and exp and log are each other's inverse where the log is unique."""

import math

import hypothesis.strategies as st
import torch
from hypothesis import example, given, settings

from refield.scene import pose

numbers = st.floats(-5, 5, allow_nan=False, width=32)
twists = st.lists(numbers, min_size=6, max_size=6).map(lambda v: torch.tensor(v, dtype=torch.float64))
units = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 0.1)
EYE = torch.eye(4, dtype=torch.float64)
relaxed = settings(deadline=None, max_examples=60)


@relaxed
@given(twists, twists, twists)
def test_group_axioms(a, b, c):
    a, b, c = pose.exp(a), pose.exp(b), pose.exp(c)
    assert torch.allclose((a @ b) @ c, a @ (b @ c), atol=1e-9)
    assert torch.allclose(a @ pose.invert(a), EYE, atol=1e-9)
    assert torch.allclose(pose.invert(a @ b), pose.invert(b) @ pose.invert(a), atol=1e-9)
    assert torch.allclose(a[:3, :3].T @ a[:3, :3], EYE[:3, :3], atol=1e-9)
    assert torch.allclose(torch.linalg.det(a), torch.ones((), dtype=torch.float64))


@relaxed
@given(twists, twists)
def test_transform_is_an_action(a, p):
    a, point = pose.exp(a), p[:3]
    homogeneous = a @ torch.cat([point, torch.ones(1, dtype=torch.float64)])
    assert torch.allclose(pose.transform(a, point), homogeneous[:3], atol=1e-9)
    assert torch.allclose(pose.transform(pose.invert(a), pose.transform(a, point)), point, atol=1e-9)
    assert torch.allclose(pose.rotate(a, point), a[:3, :3] @ point, atol=1e-9)


@relaxed
@given(units, st.floats(0, math.pi - 1e-3), twists)
@example((1.0, 0.0, 0.0), 0.0, torch.ones(6, dtype=torch.float64))
@example((0.3, 0.2, -0.9), 1e-9, torch.ones(6, dtype=torch.float64))
@example((0.3, 0.2, -0.9), 1e-4, torch.ones(6, dtype=torch.float64))
@example((0.3, 0.2, -0.9), 1.0001e-4, torch.ones(6, dtype=torch.float64))
def test_log_undoes_exp(axis, angle, translation):
    phi = torch.tensor(axis, dtype=torch.float64)
    twist = torch.cat([translation[:3], phi / phi.norm() * angle])
    assert torch.allclose(pose.log(pose.exp(twist)), twist, atol=1e-7)


@relaxed
@given(units, st.floats(-1e-7, 1e-7))
def test_exp_undoes_log_near_a_half_turn(axis, off):
    """At pi the rotation vector jumps, the rotation must not."""
    phi = torch.tensor(axis, dtype=torch.float64)
    motion = pose.exp(torch.cat([torch.ones(3, dtype=torch.float64), phi / phi.norm() * (math.pi + off)]))
    assert torch.allclose(pose.exp(pose.log(motion)), motion, atol=1e-7)


def test_exp_of_small_twists_is_linear():
    twist = torch.tensor([1e-6, -2e-6, 3e-6, 2e-6, 1e-6, -1e-6], dtype=torch.float64)
    expected = EYE.clone()
    expected[:3, :3] += pose.skew(twist[3:])
    expected[:3, 3] += twist[:3]
    assert torch.allclose(pose.exp(twist), expected, atol=1e-11)


@relaxed
@given(twists, twists)
def test_exp_of_a_known_turn(a, b):
    quarter = torch.tensor([0, 0, 0, 0, 0, math.pi / 2], dtype=torch.float64)
    turned = pose.rotate(pose.exp(quarter), torch.tensor([1.0, 0, 0], dtype=torch.float64))
    assert torch.allclose(turned, torch.tensor([0.0, 1, 0], dtype=torch.float64), atol=1e-12)
    assert float(pose.angle_between(pose.exp(a), pose.exp(a))) < 1e-5
    assert torch.isclose(pose.angle_between(pose.exp(a), pose.exp(b)), pose.angle_between(pose.exp(b), pose.exp(a)))


@relaxed
@given(twists, st.floats(0, 1e-3))
def test_nearest_rotation_is_a_rotation_and_near(twist, noise):
    rotation = pose.exp(twist)[:3, :3]
    found = pose.nearest_rotation(rotation + noise * torch.randn(3, 3, dtype=torch.float64))
    assert torch.allclose(found.T @ found, EYE[:3, :3], atol=1e-12)
    assert torch.linalg.det(found) > 0
    assert (found - rotation).norm() <= 8 * noise + 1e-12


def test_nearest_rotation_of_a_reflection_is_none():
    mirrored = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    assert torch.isclose(torch.linalg.det(pose.nearest_rotation(mirrored)), torch.tensor(1.0, dtype=torch.float64))


@relaxed
@given(twists, twists)
def test_adjoint_carries_a_twist_to_another_frame(a, t):
    a, t = pose.exp(0.3 * a), 0.3 * t
    same = a @ pose.exp(t) @ pose.invert(a)
    assert torch.allclose(pose.exp(pose.adjoint(a) @ t), same, atol=1e-8)


def test_many_poses_go_with_as_many_points():
    g = torch.Generator().manual_seed(0)
    poses = pose.exp(torch.randn(5, 6, generator=g, dtype=torch.float64))
    points = torch.randn(5, 3, generator=g, dtype=torch.float64)
    for move in (pose.transform, pose.rotate):
        one_by_one = torch.stack([move(p, x) for p, x in zip(poses, points)])
        assert torch.allclose(move(poses, points), one_by_one)
        assert move(poses[:, None], points[None]).shape == (5, 5, 3)
