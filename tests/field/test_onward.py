"""Rays on their way and light on surfaces: the compiled loops against plain torch."""

from __future__ import annotations

import pytest
import torch

from refield.field.encoding import geometric_levels
from refield.field.kernels import cpu, onward, reference
from refield.field.kernels.onward import Lights, Shown, Way
from tests.field.test_kernels import networks, some_masks

SPACE, LATTICE = (torch.tensor([0.1, 0.0, 0.2]), 1.5), (0.0, 60.0, 0.05)


def some_rays(count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    origins = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1) * 3
    directions = torch.nn.functional.normalize(torch.randn(count, 3) * 0.5 - origins, dim=-1)
    return origins, directions, torch.zeros(count)


def some_lights() -> Lights:
    boxes = torch.tensor([[[-1.0, -1.0, -0.5], [0.5, 1.0, 1.0]], [[-0.5, -2.0, -1.0], [2.0, 0.5, 0.5]]])
    shapes = torch.tensor([[3, 4, 5], [6, 2, 3]])
    return Lights(boxes, shapes, torch.tensor([0, 60]), torch.randn(96, 3) * 0.5)


@pytest.mark.parametrize("fill", [0.0, 0.02, 0.5])
@pytest.mark.parametrize("masked", [False, True])
def test_next_samples(fill: float, masked: bool) -> None:
    """A few at a time they are all samples; what comes before a span or behind it may be left out, and nothing else."""
    torch.manual_seed(3)
    rays, grid = some_rays(120), (torch.rand(32, 32, 32) < fill).to(torch.uint8)
    fine, whole = some_masks(32) if masked else None, (torch.zeros(120), torch.full((120,), torch.inf))
    place = (rays, SPACE, grid, LATTICE)
    truth = onward.next_samples(*place, (torch.zeros(120), *whole), 3, fine)
    fast = cpu.next_samples(*place, (torch.zeros(120), *whole), 3, fine)
    same = truth[2] == fast[2]
    assert same.float().mean() > 0.97  # a midpoint on a cell's face may fall either way
    for a, b in zip(truth[:2], fast[:2]):
        assert ((a == b) | ((a - b).abs() < 1e-3))[same].float().mean() > 0.98
    t, counts = torch.zeros(120), torch.zeros(120, dtype=torch.long)
    for _ in range(1000):
        _, t1, found = cpu.next_samples(*place, (t, *whole), 3, fine)
        counts, more = counts + found, found == 3
        t = torch.where(more, t1[:, -1], torch.inf)
        if not more.any():
            break
    assert torch.equal(counts, cpu.march(*place, fine)[2].diff())
    enter, leave = torch.full((120,), 2.5), torch.full((120,), 3.0)
    within = cpu.next_samples(*place, (torch.zeros(120), enter, leave), 200, fine)
    everything = cpu.next_samples(*place, (torch.zeros(120), *whole), 200, fine)
    (got, wanted) = (((s[0] >= 2.5) & (s[0] < 3.0)).sum(-1) for s in (within, everything))
    assert (got == wanted).float().mean() > 0.97
    assert bool((within[2] <= everything[2] + 1).all())
    nothing = cpu.next_samples(*place, (torch.zeros(120), torch.full((120,), torch.inf), torch.zeros(120)), 2, fine)
    assert int(nothing[2].sum()) == 0 and nothing[0].isinf().all()


def test_relight() -> None:
    torch.manual_seed(4)
    x, rgb, lights = torch.rand(2000, 3) * 5 - 2.5, torch.rand(2000, 3), some_lights()
    lit = cpu.relight(x, rgb, lights)
    torch.testing.assert_close(lit, onward.relight(x, rgb, lights), atol=1e-5, rtol=1e-4)
    assert 0.1 < float((lit != rgb).any(-1).float().mean()) < 0.9
    assert torch.equal(cpu.relight(x, rgb, onward.NO_LIGHTS), rgb)


@pytest.mark.parametrize("fill, rays", [(0.3, 300), (0.0, 10), (1.0, 0)])
def test_what_is_seen_until_something_changes_and_behind_it(fill: float, rays: int) -> None:
    torch.manual_seed(8)
    nets, tables = networks(4, 16, 7), torch.randn(4, 1 << 12, 2)
    grid, gone = ((torch.rand(32, 32, 32) < part).to(torch.uint8) for part in (fill, 0.2))
    field = (tables, geometric_levels(8, 64, 4), nets)
    lines, until = some_rays(rays), 2 + torch.rand(rays) * 2
    until[::3] = torch.inf
    results, begun = [], torch.zeros(rays)
    for twin in (cpu, onward):
        way = Way(torch.zeros(rays), until, torch.zeros(rays), gone)
        sums = twin.render_until(lines, SPACE, grid, LATTICE, field, 7.0, None, way, some_lights_of(5))
        assert bool(((way.t >= until.clamp(max=60)) | (way.depth >= 7)).all())
        torch.testing.assert_close(sums[:, 6], torch.exp(-way.depth), atol=1e-4, rtol=1e-3)
        begun = way.t.clone() if twin is cpu else begun  # the truth's is no place on the lattice
        on = Way(begun.clone(), torch.full_like(until, torch.inf), way.depth.clone(), gone)
        shown = twin.shown_on(lines, SPACE, grid, LATTICE, field, 7.0, None, on, some_lights_of(5))
        assert bool((shown[0] >= begun[reference._ray_ids(shown[4])] - 1e-3).all())
        results.append((sums, way.depth, twin.blend(sums, shown, few_samples(rays))))
    for fast, truth in zip(*results):
        off = (fast - truth).abs() > 1e-3 * (1 + truth.abs())
        assert off.float().mean() < 0.02 if rays else off.numel() == 0  # a sample may fall to either side of a border


def test_what_is_passed_over_is_as_if_it_were_empty() -> None:
    torch.manual_seed(9)
    nets, tables, lines = networks(4, 16, 7), torch.randn(4, 1 << 12, 2), some_rays(200)
    grid, gone = ((torch.rand(32, 32, 32) < part).to(torch.uint8) for part in (0.3, 0.3))
    field = (tables, geometric_levels(8, 64, 4), nets)
    way = Way(torch.zeros(200), torch.full((200,), torch.inf), torch.zeros(200), gone)
    sums = cpu.render_until(lines, SPACE, grid, LATTICE, field, 7.0, None, way, onward.NO_LIGHTS)
    left = cpu.render(lines, SPACE, grid * (1 - gone), LATTICE, field, 7.0)
    for a, b in zip(onward.summed(sums), left):
        assert ((a - b).abs() < 1e-3).float().mean() > 0.98


def test_blend() -> None:
    torch.manual_seed(6)
    a, b = few_samples(50), few_samples(50)
    sums = torch.cat([torch.rand(50, 6), torch.rand(50, 1)], -1)
    torch.testing.assert_close(cpu.blend(sums, a, b), onward.blend(sums, a, b), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(cpu.blend(sums, b, a), onward.blend(sums, a, b), atol=1e-5, rtol=1e-4)


def some_lights_of(seed: int) -> Lights:
    torch.manual_seed(seed)
    return some_lights()


def few_samples(rays: int) -> Shown:
    """Up to 5 on each of so many rays, far away."""
    g = torch.Generator().manual_seed(rays)
    counts = torch.randint(0, 6, (rays,), generator=g)
    ids = torch.repeat_interleave(torch.arange(rays), counts)
    t = torch.rand(len(ids), generator=g) + 2
    t = t[torch.argsort(ids * 10 + t)]
    sigma, rgb = torch.rand(len(ids), generator=g) * 9, torch.rand(len(ids), 3, generator=g)
    return t, t + 0.1, sigma, rgb, torch.cat([counts.new_zeros(1), counts.cumsum(0)])
