"""The NeRFacto shape: its samplers, the loss of its proposals, its files, and a fit of a scene in closed form."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional

from refield.field import fit_nerfacto as fitting
from refield.field.descent import NonFiniteError
from refield.field.encoding import Contraction
from refield.field.fit import FitProgress
from refield.field.fit_nerfacto import NerfactoFitConfig, fit_nerfacto, proposal_interval, rate_at
from refield.field.interlevel import bounds, interlevel_loss
from refield.field.nerfacto import NerfactoConfig, NerfactoField, ProposalConfig, looking_everywhere
from refield.field.proposal import (
    Density,
    Histogram,
    Plan,
    Span,
    annealing,
    even_edges,
    propose,
    resampled,
    spacing,
    unspacing,
)
from refield.field.radiance import Field
from refield.field.render import render_frame, render_rays, visible_samples
from refield.field.volrend import Samples
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, Rays, camera_rays
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.errors import InputError
from refield.scene.pose import rigid
from refield.update.composite import UpdatedField
from tests.captures import looking_at

SPAN = Span(near=0.05, far=1000.0, radius=2.0)
SMALL = NerfactoConfig(
    proposals=(
        ProposalConfig(32, 16, coarsest=8, levels=3, log2_table=12, width=8),
        ProposalConfig(20, 32, coarsest=8, levels=3, log2_table=12, width=8),
    ),
    samples=12,
    levels=6,
    finest=64,
    log2_table=12,
    width=16,
    first_density=0.1,
    occupancy=8,
)
TINY = NerfactoFitConfig(steps=200, rays=512, anneal_steps=50, check_every=100, field=SMALL)
CAMERA = Camera(32, 32, 34.0, 34.0, 16.0, 16.0)


@pytest.fixture(autouse=True)
def seeded() -> Iterator[None]:
    torch.manual_seed(0)
    yield


def small_nerfacto(seed: int = 0) -> NerfactoField:
    """Random, in a core of half a unit off the origin, and with something to see."""
    space = Contraction(torch.tensor([0.5, 0.0, 0.0]), 2.0)
    field = NerfactoField(SMALL, looking_everywhere(space, SMALL), seed)
    with torch.no_grad():
        for p in (field.trunk.encoding.tables, *(p.encoding.tables for p in field.proposals)):
            p.normal_(generator=torch.Generator().manual_seed(seed))
    return field.eval().requires_grad_(False)


def some_rays(count: int = 50) -> Rays:
    return Rays(torch.randn(count, 3), functional.normalize(torch.randn(count, 3), dim=-1))


# --- samplers ---------------------------------------------------------------------------------------------------------


def test_spacing_is_half_distance_and_half_disparity() -> None:
    u = torch.tensor([0.0, 0.5, 1.0, 2.0, 10.0, 1000.0])
    torch.testing.assert_close(spacing(u), torch.tensor([0.0, 0.25, 0.5, 0.75, 0.95, 0.9995]))
    torch.testing.assert_close(unspacing(spacing(u)), u, rtol=1e-4, atol=1e-6)


def test_even_edges_lie_evenly_in_distance_then_in_disparity() -> None:
    t = replace(SPAN, near=0.0, far=1e7).distance(even_edges(3, 64, jitter=False))[1] / SPAN.radius
    near, far = t[:33], t[32:-1]
    torch.testing.assert_close(near, torch.linspace(0, 1, 33))
    torch.testing.assert_close((1 / far).diff(), torch.full((31,), -1 / 32), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("jitter", [False, True])
def test_edges_are_in_order_between_near_and_far(jitter: bool) -> None:
    edges = even_edges(40, 32, jitter)
    edges = resampled(Histogram(edges, torch.rand(40, 32) ** 8), 24, jitter)
    for samples in (SPAN.samples(edges), SPAN.samples(even_edges(40, 32, jitter))):
        assert (samples.t_ends > samples.t_starts).all()
        assert samples.t_starts.min() >= 0.99 * SPAN.near * SPAN.radius
        ends = samples.t_ends.reshape(40, -1)[:, -1]
        torch.testing.assert_close(ends, torch.full_like(ends, SPAN.far * SPAN.radius), rtol=1e-3, atol=0)


def test_packed_samples_are_each_rays_own() -> None:
    edges = torch.tensor([[0.0, 0.5, 1.0], [0.2, 0.3, 0.4]])
    samples = SPAN.samples(edges)
    assert samples.ray_offsets.tolist() == [0, 2, 4] and samples.ray_ids.tolist() == [0, 0, 1, 1]
    assert samples.t_starts[1] == samples.t_ends[0]
    torch.testing.assert_close(samples.t_starts[2:], SPAN.distance(edges[1, :2]))


def test_a_peak_draws_the_edges() -> None:
    edges = even_edges(5, 50, jitter=False)
    w = torch.zeros(5, 50)
    w[:, 20] = 1
    drawn = resampled(Histogram(edges, w), 40, jitter=True, padding=1e-4)
    assert (drawn[:, -1] == 1).all()
    inside = (drawn >= 20 / 50) & (drawn <= 21 / 50)
    assert (inside.float().mean(-1) > 0.95).all()
    # the padding leaves every place its share, the annealing takes the peak away
    assert 0.2 < float((resampled(Histogram(edges, w), 400, False).diff() > 0.001).float().mean()) < 0.5
    even = resampled(Histogram(edges, w), 40, jitter=False, anneal=0.0)
    torch.testing.assert_close(even.diff()[:, :-1], torch.full((5, 39), 1 / 40), rtol=1e-3, atol=1e-5)


def test_edges_are_spread_as_the_histogram_says() -> None:
    """The share of edges in each interval is the share of its weight."""
    edges = even_edges(1, 8, jitter=False)
    w = torch.rand(1, 8) + 0.1
    drawn = resampled(Histogram(edges, w), 8000, jitter=True, padding=0.0)[:, :-1]
    share = torch.histc(drawn, 8, 0, 1) / 8000
    torch.testing.assert_close(share, (w / w.sum())[0], rtol=0, atol=1e-3)


def test_a_ray_without_weight_is_looked_at_evenly() -> None:
    drawn = resampled(Histogram(even_edges(1, 8, False), torch.zeros(1, 8)), 15, jitter=False)
    torch.testing.assert_close(drawn.diff()[:, :-1], torch.full((1, 14), 1 / 15))


def test_annealing_rises_from_nothing_to_everything() -> None:
    values = [annealing(s, 10.0, 1000) for s in (0, 10, 100, 500, 1000, 5000)]
    assert values[0] == 0 and values[-2:] == [1, 1] and values == sorted(values) and values[2] > 0.5


def test_proposals_close_in_on_a_wall() -> None:
    """Told of a wall at distance 3, the last intervals crowd around it."""
    rays = some_rays(20)
    rays = Rays(torch.zeros(20, 3), rays.directions)

    def wall(x: torch.Tensor) -> torch.Tensor:
        return 50.0 * (x.norm(dim=-1) > 3.0)

    plan = Plan(SPAN, (128, 64, 16))
    told, edges = propose(rays, (wall, wall), plan)
    assert [h.weights.shape for h in told] == [(20, 128), (20, 64)]
    t = SPAN.distance(edges)
    assert ((t > 2.5) & (t < 3.5)).float().mean() > 0.7
    with pytest.raises(ValueError, match="argument 2"):
        propose(rays, (wall,), plan)


# --- the loss of the proposals ----------------------------------------------------------------------------------------


def test_bounds_are_sums_over_what_overlaps() -> None:
    proposal = Histogram(torch.tensor([[0.0, 0.25, 0.5, 1.0]]), torch.tensor([[0.1, 0.2, 0.4]]))
    edges = torch.tensor([[0.0, 0.25, 0.3, 0.6, 1.0]])
    expected = torch.tensor([[0.1, 0.2, 0.6, 0.4]])
    torch.testing.assert_close(bounds(edges, proposal), expected)


def test_bounds_equal_the_double_loop() -> None:
    edges, own = torch.rand(4, 13).sort(-1).values, torch.rand(4, 9).sort(-1).values
    proposal = Histogram(own, torch.rand(4, 8))
    found = bounds(edges, proposal)
    for n in range(4):
        for i in range(12):
            meets = (own[n, :-1] < edges[n, i + 1]) & (own[n, 1:] > edges[n, i])
            torch.testing.assert_close(found[n, i], proposal.weights[n][meets].sum(), rtol=1e-4, atol=1e-5)


def test_loss_is_nothing_where_the_proposal_bounds_the_field() -> None:
    field = Histogram(torch.linspace(0, 1, 9)[None], torch.rand(1, 8) / 8)
    coarse = Histogram(torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[0.5, 0.5]]))
    same = Histogram(field.edges, field.weights)
    assert interlevel_loss(field, [coarse, same]) < 1e-12
    delta = torch.zeros(1, 8)
    delta[0, 3] = 1
    assert interlevel_loss(Histogram(field.edges, delta), [Histogram(field.edges, delta)]) == 0
    elsewhere = Histogram(field.edges, delta.roll(2, -1))
    torch.testing.assert_close(interlevel_loss(Histogram(field.edges, delta), [elsewhere]), torch.tensor(1 / 8))


def test_gradient_reaches_the_proposal_only_and_is_the_difference_quotient() -> None:
    edges, own = torch.rand(3, 11).sort(-1).values.double(), torch.rand(3, 7).sort(-1).values.double()
    w = (torch.rand(3, 10).double() + 0.5).requires_grad_()
    proposed = (torch.rand(3, 6).double() * 0.2).requires_grad_()
    loss = interlevel_loss(Histogram(edges, w), [Histogram(own, proposed)])
    assert loss > 0
    to_w, to_proposed = torch.autograd.grad(loss, [w, proposed], allow_unused=True)
    assert to_w is None
    direction, h = torch.randn(3, 6).double(), 1e-6
    with torch.no_grad():
        up, down = (
            interlevel_loss(Histogram(edges, w), [Histogram(own, proposed + s * h * direction)]) for s in (1, -1)
        )
    torch.testing.assert_close((up - down) / (2 * h), (to_proposed * direction).sum(), rtol=1e-4, atol=1e-8)


# --- the field --------------------------------------------------------------------------------------------------------


def test_it_is_a_field_of_any_leading_shape() -> None:
    field = small_nerfacto()
    assert isinstance(field, Field)
    x, d = torch.randn(4, 5, 3) * 3, functional.normalize(torch.randn(4, 5, 3), dim=-1)
    sigma, rgb = field(x, d)
    assert sigma.shape == (4, 5) and rgb.shape == (4, 5, 3)
    assert (sigma > 0).all() and rgb.min() >= 0 and rgb.max() <= 1
    torch.testing.assert_close(field.density(x), sigma, rtol=1e-4, atol=1e-6)
    assert field(x[:0], d[:0])[1].shape == (0, 5, 3)
    assert field.sampler.occupied(x).all()


def test_world_units_are_left_to_the_contraction() -> None:
    """A world three times as large is three times as thin, and looks the same."""
    field = small_nerfacto()
    space = Contraction(field.contraction.centre * 3, field.contraction.radius * 3)
    large = NerfactoField(SMALL, looking_everywhere(space, SMALL))
    large.load_state_dict(field.state_dict())
    rays = some_rays()
    here = render_rays(field, rays)
    there = render_rays(large.eval().requires_grad_(False), Rays(rays.origins * 3, rays.directions))
    torch.testing.assert_close(there.rgb, here.rgb, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(there.depth, here.depth * 3, rtol=1e-2, atol=1e-2)


def test_rendering_asks_where_the_proposals_say() -> None:
    field = small_nerfacto()
    rays = some_rays()
    samples = visible_samples(field, rays)
    assert torch.equal(samples.ray_offsets, torch.arange(51) * SMALL.samples)
    assert not torch.equal(visible_samples(field, rays, jitter=True).t_starts, samples.t_starts)
    view = render_rays(field, rays)
    assert view.rgb.shape == (50, 3) and view.opacity.min() >= 0 and view.opacity.max() <= 1 + 1e-5
    assert torch.isfinite(view.rgb).all() and view.opacity.mean() > 0.5
    assert render_rays(field, rays[:0]).rgb.shape == (0, 3)


def test_gradients_reach_every_network() -> None:
    field = small_nerfacto().train().requires_grad_(True)
    rays = some_rays()
    told, edges = field.propose(rays, jitter=True)
    samples = field.span.samples(edges)
    sigma, rgb = field(*samples.positions(rays))
    (sum(h.weights.square().sum() for h in told) + sigma.sum() + rgb.sum()).backward()
    for name, p in field.named_parameters():
        assert p.grad is not None and p.grad.abs().sum() > 0, name


def test_it_can_be_updated() -> None:
    """A ball of it moves by one: what was at the old place is at the new one, and the rest stays."""
    field = small_nerfacto()
    inside = torch.cartesian_prod(*[torch.linspace(-0.5, 0.5, 9)] * 3).norm(dim=-1).reshape(9, 9, 9) < 0.4
    grid = OccupancyGrid(torch.tensor([[-0.5] * 3, [0.5] * 3]), inside.float())
    shift = torch.tensor([1.0, 0.0, 0.0])
    updated = UpdatedField(field, SceneChange((ObjectChange("moved", grid, rigid(torch.eye(3), shift).double()),)))
    x = (torch.randn(50, 3) * 0.1).clamp(-0.15, 0.15)  # inside, whatever is drawn
    assert (updated.density(x) == 0).all()
    torch.testing.assert_close(updated.density(x + shift), field.density(x), rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(updated.density(x + 5), field.density(x + 5))
    assert torch.isfinite(render_rays(updated, some_rays(10)).rgb).all()


class Seen(NerfactoField):
    """Proposal networks that know a ball at the centre and a wall behind it."""

    @property
    def densities(self) -> tuple[Density, ...]:
        def density(x: Tensor) -> Tensor:
            return torch.where((x.norm(dim=-1) < 0.4) | (x[:, 0] - 1.5).abs().le(0.1), 40.0, 0.0)

        return (density, density)


def test_what_left_is_not_looked_at_but_what_is_behind_it() -> None:
    field = Seen(SMALL, looking_everywhere(Contraction(torch.zeros(3), 2.0), SMALL)).eval()
    rays = Rays(torch.tensor([[-2.0, 0.0, 0.0], [-2.0, 1.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]] * 2))

    def looked_at(samples: Samples, ray: int, start: float, end: float) -> int:
        x = samples.positions(rays)[0][samples.ray_ids == ray, 0]
        return int(((x > start) & (x < end)).sum())

    was, now = field.samples(rays), field.samples(rays, without=lambda x: x.norm(dim=-1) < 0.45)
    assert looked_at(was, 0, -0.45, 0.45) > 3 and looked_at(now, 0, -0.45, 0.45) == 0
    assert looked_at(now, 0, 1.2, 1.8) >= looked_at(was, 1, 1.2, 1.8) > looked_at(was, 0, 1.2, 1.8)
    beside = now.ray_ids == 1
    assert torch.equal(now.t_starts[beside], was.t_starts[was.ray_ids == 1]), "another ray is none of its business"


def test_an_updated_field_keeps_what_did_not_change() -> None:
    """Rays that pass by nothing that changed are looked at as before; what no photo saw is not shown."""
    field, there = small_nerfacto(), torch.eye(4).double()
    there[0, 3] = 0.5
    grid = OccupancyGrid(torch.tensor([[-0.8] * 3, [0.8] * 3]), torch.ones(3, 3, 3))
    updated = UpdatedField(field, SceneChange((ObjectChange("moved", grid, there),)))
    rays = Rays(torch.tensor([[-1.0, 0.0, 6.0]]).expand(20, 3), functional.normalize(torch.randn(20, 3), dim=-1))
    rays = rays[rays.directions[:, 2] > 0]
    torch.testing.assert_close(render_rays(updated, rays).rgb, render_rays(field, rays).rgb)
    hidden = updated.unshown(torch.arange(updated.sampler.grid.numel()))
    assert render_rays(hidden, rays).opacity.max() == 0 and render_rays(updated, rays).opacity.min() > 0.1
    x = 0.1 * torch.randn(20, 3) + torch.tensor([0.5, 0.0, 0.0])  # moved there
    d = functional.normalize(torch.randn(20, 3), dim=-1)
    through = Rays(x - 5 * d, d)  # from all sides: haze is met on some
    assert render_rays(hidden, through).opacity.max() > 0


def test_field_survives_its_files(tmp_path: Path) -> None:
    field = small_nerfacto()
    field.save(tmp_path)
    again = NerfactoField.load(tmp_path)
    assert again.config == field.config and not again.training
    rays = some_rays()
    assert torch.equal(render_rays(field, rays).rgb, render_rays(again, rays).rgb)
    assert torch.equal(field.sampler.grid, again.sampler.grid) and field.sampler.step == again.sampler.step
    for text in ("{}", '{"format": 1, "architecture": "HashField"}'):
        (tmp_path / "field.json").write_text(text)
        with pytest.raises(InputError, match="holds no readable field"):
            NerfactoField.load(tmp_path)


def test_default_shape_is_nerfactos() -> None:
    sizes = NerfactoConfig()
    assert [(p.samples, p.finest, p.log2_table) for p in sizes.proposals] == [(256, 128, 17), (96, 256, 17)]
    assert (sizes.levels, sizes.finest, sizes.log2_table, sizes.samples, sizes.width) == (16, 2048, 19, 48, 64)


# --- training ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A coloured ball in front of a smooth, far wall, in 40 views."""
    folder = tmp_path_factory.mktemp("ball")
    frames = []
    for i in range(40):
        a = torch.tensor(i * 0.8, dtype=torch.float64)
        eye = torch.stack([2 * a.cos(), 2 * a.sin(), 0.3 + 0.03 * torch.tensor(float(i)).double()])
        pose = looking_at(eye, torch.zeros(3, dtype=torch.float64))
        rays = camera_rays(CAMERA, pose)
        b = (rays.origins * rays.directions).sum(-1)
        inside = b * b - (rays.origins.square().sum(-1) - 0.5**2)
        hit = rays.origins + rays.directions * (-b - inside.clamp_min(0).sqrt())[:, None]
        ball = 0.5 + 0.4 * torch.sin(6 * hit)
        wall = (torch.sin(2 * rays.directions) * 0.25 + 0.5).abs()
        rgb = torch.where((inside > 0)[:, None], ball, wall).reshape(32, 32, 3).clamp(0, 1)
        path = folder / f"{i:02d}.png"
        Image.fromarray((rgb * 255).round().numpy().astype(np.uint8)).save(path)
        frames.append(Frame(path, CAMERA, path.name, pose))
    return Capture(tuple(frames))


@pytest.mark.parametrize("background", ["random", "last_sample"])
def test_held_out_views_are_explained(capture: Capture, background: str) -> None:
    looks: list[FitProgress] = []
    field = fit_nerfacto(capture, replace(TINY, background=background), looks.append).field
    assert looks[-1].psnr > 25 and [p.step for p in looks] == [100, 200]
    assert looks[-1].rays_per_second > 0 and looks[-1].samples_per_ray == SMALL.samples
    view = render_frame(field, capture.held_out[0])
    assert view.rgb.shape == (32, 32, 3) and float(view.opacity[16, 16]) > 0.9
    assert abs(float(view.depth[16, 16]) - (float(capture.held_out[0].centre.norm()) - 0.5)) < 0.3
    assert view.opacity.min() > 0.99  # nothing is seen through the world
    assert not field.training and not any(p.requires_grad for p in field.parameters())


def test_same_seed_same_field(capture: Capture) -> None:
    short = replace(TINY, steps=8)
    a, b, c = (fit_nerfacto(capture, replace(short, seed=s)).field for s in (0, 0, 1))
    assert all(torch.equal(x, y) for x, y in zip(a.parameters(), b.parameters()))
    assert not all(torch.equal(x, y) for x, y in zip(a.parameters(), c.parameters()))


def test_training_stops_in_time(capture: Capture) -> None:
    looks: list[FitProgress] = []
    fit_nerfacto(capture, replace(TINY, steps=10**6, max_seconds=0.5), looks.append)
    assert looks[-1].seconds < 5 and looks[-1].step < 10**4 and looks[-1].seconds_left < 1


def test_a_loss_that_stays_infinite_ends_training(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "colour_loss", lambda errors, trust: errors.mean() * torch.nan)
    with pytest.raises(NonFiniteError, match="20 steps in a row") as caught:
        fit_nerfacto(capture, TINY)
    assert caught.value.steps == 0


def test_the_last_good_state_is_kept(capture: Capture) -> None:
    """From its third step on, one network's gradient is infinite."""
    steps: list[int] = []

    class Broken(fitting._NerfactoFit):
        def _descend(self, loss: Tensor, step: int, plain: bool) -> bool:
            steps.append(step)
            if len(steps) == 3:
                self.model.colour_mid.register_hook(lambda grad: grad * torch.inf)
            return super()._descend(loss, step, plain)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(NonFiniteError) as caught:
        patch.setattr(fitting, "_NerfactoFit", Broken)
        fit_nerfacto(capture, TINY)
    assert caught.value.steps == 2 and len(steps) == 22
    field = caught.value.field
    assert isinstance(field, NerfactoField) and all(torch.isfinite(p).all() for p in field.parameters())
    assert torch.isfinite(render_rays(field, some_rays()).rgb).all()


def test_a_single_bad_loss_is_stepped_over(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    honest, calls = fitting.colour_loss, []

    def often_bad(errors: torch.Tensor, trust: torch.Tensor | None) -> torch.Tensor:
        calls.append(1)
        return honest(errors, trust) * (torch.nan if len(calls) % 15 else 1.0)

    monkeypatch.setattr(fitting, "colour_loss", often_bad)
    field = fit_nerfacto(capture, replace(TINY, steps=45)).field
    assert len(calls) == 45 and all(torch.isfinite(p).all() for p in field.parameters())


def test_a_capture_without_photos_is_refused(capture: Capture) -> None:
    with pytest.raises(ValueError, match="no frame to train on"):
        fit_nerfacto(Capture(()))


def test_schedules() -> None:
    config = NerfactoFitConfig()
    assert rate_at(0, config) == 1e-2 and rate_at(300_000, config) == pytest.approx(1e-4)
    assert rate_at(100_000, config) == pytest.approx(1e-3)
    assert [proposal_interval(s, config) for s in (0, 500, 2500, 5000, 9000)] == [1, 1, 2.5, 5, 5]
