"""Compositing what is fixed once is exact (Eq. 1 is associative)."""

from __future__ import annotations

import torch

from refield.field.render import render_many
from refield.field.volrend import Samples, accumulate_rgb
from refield.scene.capture import Rays
from refield.update.composite import UpdatedField
from refield.update.frozen import Segments, composite_once, weave
from refield.update.learnt import Learnt
from refield.update.region import move_out
from tests.update.worlds import STEP, Ball, BallWorld, at, change_of, moved, views

OLD, NEW_POSE = Ball(at(-0.5, 0.2, 0.25), 0.25), at(0.0, 0.2, 0.25, yaw=1.0)
CHANGE = change_of(moved(OLD, NEW_POSE))
WIDE = move_out(CHANGE, 2.0)
FROZEN = UpdatedField(BallWorld((OLD, Ball(at(0.3, 0.6, 0.3), 0.3))), CHANGE, Learnt(region=WIDE))


def nothing(n: int) -> Samples:
    return Samples(torch.zeros(0), torch.zeros(0), torch.zeros(n + 1, dtype=torch.long))


def shown(fixed: Segments, samples: Samples, sigmas: torch.Tensor, rgbs: torch.Tensor) -> torch.Tensor:
    woven = weave(fixed, samples, sigmas, rgbs)
    return accumulate_rgb(woven.weights, woven.rgb, woven.samples)[0]


def test_segments_alone_are_the_rendering() -> None:
    rays = views()
    fixed = composite_once(FROZEN, WIDE.sampler(STEP), rays)
    seen = shown(fixed, nothing(len(rays)), torch.zeros(0), torch.zeros(0, 3))
    torch.testing.assert_close(seen, render_many(FROZEN, rays).rgb, rtol=0, atol=1e-4)
    assert len(fixed.t_mid) < 3 * len(rays)


def test_weaving_a_helper_in_is_rendering_the_updated_field() -> None:
    rays = views()
    helper = BallWorld((Ball(NEW_POSE, 0.25),))
    region = WIDE.sampler(STEP)
    fixed = composite_once(FROZEN, region, rays)
    samples = region(rays)
    x, d = samples.positions(rays)
    sigmas, rgbs = helper(x, d)
    moved_there = FROZEN.moves[0].arrived(x)  # the moved object is among the fixed segments
    seen = shown(fixed, samples, torch.where(moved_there, 0.0, sigmas), rgbs)
    whole = render_many(UpdatedField(FROZEN.pretrained, CHANGE, Learnt(helper)), rays).rgb
    # two lattices of the same step: surfaces are met half a step apart
    assert float((seen - whole).abs().mean()) < 0.01
    assert float((seen - render_many(FROZEN, rays).rgb).abs().mean()) > 0.01


def test_a_segment_lies_between_the_samples_it_lies_between() -> None:
    """By hand: a half-opaque red segment, a blue sample behind it, an opaque green segment behind both."""
    half = torch.log(torch.tensor(2.0))
    fixed = Segments(
        torch.tensor([1.0, 3.0]),
        torch.stack([half, torch.tensor(20.0)]),
        torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]),
        torch.tensor([0, 2]),
    )
    sample = Samples(torch.tensor([1.5]), torch.tensor([2.5]), torch.tensor([0, 1]))
    seen = shown(fixed, sample, half[None], torch.tensor([[0, 0, 1.0]]))
    torch.testing.assert_close(seen, torch.tensor([[0.5, 0.25, 0.25]]))
    late = Samples(sample.t_starts + 2, sample.t_ends + 2, sample.ray_offsets)
    torch.testing.assert_close(
        shown(fixed, late, half[None], torch.tensor([[0, 0, 1.0]])), torch.tensor([[0.5, 0.5, 0.0]]), rtol=0, atol=1e-6
    )


def test_choosing_rays_chooses_their_segments() -> None:
    rays = views()
    fixed = composite_once(FROZEN, WIDE.sampler(STEP), rays)
    chosen = torch.tensor([900, 5, 5, 2000, 1300])
    part, again = (
        fixed[chosen],
        composite_once(FROZEN, WIDE.sampler(STEP), Rays(rays.origins[chosen], rays.directions[chosen])),
    )
    assert torch.equal(part.offsets, again.offsets)
    torch.testing.assert_close(part.optical_depth, again.optical_depth)
    torch.testing.assert_close(part.rgb, again.rgb)


def test_the_optical_depth_passes_gradients_to_the_helper_only_where_it_shows() -> None:
    """A sample behind an opaque segment cannot learn."""
    fixed = Segments(torch.tensor([1.0]), torch.tensor([50.0]), torch.ones(1, 3), torch.tensor([0, 1]))
    for start, learns in ((0.2, True), (2.0, False)):
        sigma = torch.tensor([0.5], requires_grad=True)
        sample = Samples(torch.tensor([start]), torch.tensor([start + 0.1]), torch.tensor([0, 1]))
        shown(fixed, sample, sigma, torch.zeros(1, 3)).sum().backward()
        assert sigma.grad is not None
        assert bool(sigma.grad.abs().sum() > 1e-8) is learns


def test_nothing_is_left_beyond_a_distance() -> None:
    fixed = Segments(
        torch.tensor([1.0, 3.0, 2.0, 5.0]), torch.ones(4), torch.arange(12.0).reshape(4, 3), torch.tensor([0, 2, 2, 4])
    )
    near = fixed.before(torch.tensor([2.0, 9.0, torch.inf]))
    assert near.offsets.tolist() == [0, 1, 1, 3] and near.t_mid.tolist() == [1.0, 2.0, 5.0]
    both = Segments.joined([near, fixed])
    assert both.offsets.tolist() == [0, 1, 1, 3, 5, 5, 7] and torch.equal(both[torch.tensor([3])].rgb, fixed.rgb[:2])
