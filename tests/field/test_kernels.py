"""Each fast kernel equals its plain-torch twin: values and gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from refield.field.encoding import geometric_levels
from refield.field.kernels import cpu, reference

LAYOUTS = [(4,), (16, 37, 512), geometric_levels(16, 1024, 10)]


def packed(rays: int = 40) -> Tensor:
    """Offsets of rays with 0 to 29 samples each."""
    counts = torch.randint(0, 30, (rays,))
    counts[3] = 0
    return torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])


def segments(offsets: Tensor) -> tuple[Tensor, Tensor]:
    t0 = torch.rand(int(offsets[-1])).sort().values * 3
    return t0, t0 + 0.02  # equal lengths, so that the midpoints are in order too


@pytest.mark.parametrize("resolutions", LAYOUTS)
@pytest.mark.parametrize("log2_table", [10, 14])
def test_hash_encoding(resolutions: tuple[int, ...], log2_table: int) -> None:
    torch.manual_seed(1)
    unit = torch.rand(3000, 3)
    unit[:4] = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5], [0.999999, 1, 0]])
    tables = torch.randn(len(resolutions), 1 << log2_table, 2)
    upstream = torch.randn(3000, 2 * len(resolutions))
    results = []
    for twin in (reference, cpu):
        u, t = unit.clone().requires_grad_(), tables.clone().requires_grad_()
        out = twin.hash_encode(u, t, resolutions)
        results.append((out.detach(), *torch.autograd.grad((out * upstream).sum(), [u, t])))
    for truth, fast in zip(*results):
        torch.testing.assert_close(fast, truth, rtol=1e-4, atol=2e-3 * float(truth.abs().mean()))


def test_weights_and_closed_form() -> None:
    torch.manual_seed(2)
    offsets = packed()
    t0, t1 = segments(offsets)
    sigma = torch.rand(len(t0)) * 5
    upstream = torch.randn(len(t0))
    grads = []
    for twin in (reference, cpu):
        s = sigma.clone().requires_grad_()
        w = twin.weights(s, t0, t1, offsets)
        grads.append((w.detach(), torch.autograd.grad((w * upstream).sum(), s)[0]))
    for truth, fast in zip(*grads):
        torch.testing.assert_close(fast, truth, rtol=1e-4, atol=1e-5)
    opacity = cpu.accumulate(grads[1][0], torch.ones(len(t0), 1), offsets)[:, 0]
    tau = reference.accumulate(sigma * (t1 - t0), torch.ones(len(t0), 1), offsets)[:, 0]
    torch.testing.assert_close(opacity + torch.exp(-tau), torch.ones(len(opacity)))  # nothing is lost


def test_accumulate() -> None:
    torch.manual_seed(3)
    offsets = packed()
    n = int(offsets[-1])
    w, values, upstream = torch.rand(n), torch.randn(n, 5), torch.randn(len(offsets) - 1, 5)
    results = []
    for twin in (reference, cpu):
        a, b = w.clone().requires_grad_(), values.clone().requires_grad_()
        out = twin.accumulate(a, b, offsets)
        results.append((out.detach(), *torch.autograd.grad((out * upstream).sum(), [a, b])))
    for truth, fast in zip(*results):
        torch.testing.assert_close(fast, truth, rtol=1e-4, atol=1e-5)


def test_distortion_against_the_double_sum() -> None:
    torch.manual_seed(4)
    offsets = packed()
    t0, t1 = segments(offsets)
    w, upstream = torch.rand(len(t0)) * 0.1, torch.rand(len(offsets) - 1)
    results = []
    for twin in (reference, cpu):
        a = w.clone().requires_grad_()
        out = twin.distortion(a, t0, t1, offsets)
        results.append((out.detach(), torch.autograd.grad((out * upstream).sum(), a)[0]))
    for truth, fast in zip(*results):
        torch.testing.assert_close(fast, truth, rtol=1e-3, atol=1e-5)
    own = slice(int(offsets[5]), int(offsets[6]))
    mid = (t0[own] + t1[own]) / 2
    ww = w[own, None] * w[None, own]
    direct = (ww * (mid[:, None] - mid[None]).abs()).sum() + (w[own] ** 2 * (t1 - t0)[own]).sum() / 3
    torch.testing.assert_close(results[1][0][5], direct, rtol=1e-3, atol=1e-6)


def some_masks(side: int) -> torch.Tensor:
    """(side, side, side) int64: of some cells nothing finer is known, of others a part of their parts is full."""
    bits = torch.rand(side, side, side, 64) < torch.rand(side, side, side, 1) * 0.5
    masks = (bits.long() << torch.arange(64)).sum(-1)
    return torch.where(torch.rand(side, side, side) < 0.3, 0, masks)


@pytest.mark.parametrize("fill", [0.0, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("visible", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_march(fill: float, visible: bool, masked: bool) -> None:
    torch.manual_seed(5)
    grid = (torch.rand(32, 32, 32) < fill).to(torch.uint8)
    fine = some_masks(32) if masked else None
    origins = torch.randn(200, 3) * 2
    directions = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    directions[0], directions[1] = torch.tensor([1.0, 0, 0]), torch.tensor([0, 0, -1.0])
    space, lattice = (torch.tensor([0.1, -0.2, 0.3]), 1.5), (0.01, 60.0, 0.02)
    rays = (origins, directions, torch.rand(200))
    if visible:
        net = (torch.randn(3, 1 << 12, 2), (8, 16, 64), torch.randn(32, 6), torch.randn(32) * 0.1)
        truth, fast = (twin.march_visible(rays, space, grid, lattice, net, 7.0, fine) for twin in (reference, cpu))
        assert len(truth[0]) < len(reference.march(rays, space, grid, lattice, fine)[0]) or fill == 0
    else:
        truth, fast = (twin.march(rays, space, grid, lattice, fine) for twin in (reference, cpu))
    # a midpoint on a cell's face may fall either way after a long sum of float32 steps
    difference = (fast[2].diff() - truth[2].diff()).abs()
    assert difference.max() <= 2
    assert int(difference.sum()) <= max(2, 0.002 * len(truth[0]))
    same = difference == 0
    ids_t, ids_f = (torch.repeat_interleave(same, o.diff()) for o in (truth[2], fast[2]))
    close = (truth[0][ids_t] - fast[0][ids_f]).abs() < 1e-2 * (1 + truth[0][ids_t].abs())
    assert close.float().mean() > 0.995 if len(close) else fill == 0.0


@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("masks", [1, 2])
def test_march_within(inside: bool, masks: int) -> None:
    """Only samples in every mask, or in none, are there, and end a ray."""
    torch.manual_seed(7)
    grid = (torch.rand(32, 32, 32) < 0.7).to(torch.uint8)
    origins = torch.randn(300, 3) * 2
    rays = (origins, torch.nn.functional.normalize(torch.randn(300, 3) - origins, dim=-1), torch.zeros(300))
    space, lattice = (torch.tensor([0.1, -0.2, 0.3]), 1.5), (0.01, 60.0, 0.02)
    net = (torch.randn(3, 1 << 12, 2), (8, 16, 64), torch.randn(32, 6), torch.randn(32) * 0.1)
    shapes = torch.tensor([[12, 9, 10], [5, 7, 6]])[:masks]
    boxes = torch.tensor([[[-1.0, -0.8, -1.2], [0.9, 1.1, 1.0]], [[-0.5, -0.5, -0.6], [1.4, 0.9, 0.7]]])[:masks]
    within = reference.Within(boxes, shapes, torch.tensor([0, 1080])[:masks], torch.rand(1290), inside)
    asked = (rays, space, grid, lattice, net, 7.0, None)
    truth, fast = (twin.march_within(*asked, within) for twin in (reference, cpu))
    every = reference.march_visible(*asked)
    assert len(truth[0]) > 100 and len(truth[0]) != len(every[0])
    difference = (fast[3].diff() - truth[3].diff()).abs()  # a midpoint on a face may fall either way
    assert int(difference.sum()) <= max(2, 0.002 * len(truth[0]))
    same = difference == 0
    ids_t, ids_f = (torch.repeat_interleave(same, o.diff()) for o in (truth[3], fast[3]))
    for t, f in zip(truth[:3], fast[:3]):
        assert ((t[ids_t] - f[ids_f]).abs() < 1e-2 * (1 + t[ids_t].abs())).float().mean() > 0.99


def test_adam_and_scatter_max() -> None:
    torch.manual_seed(6)
    grad = torch.randn(2, 64, 2) * (torch.rand(2, 64, 2) < 0.5)
    states = []
    for twin in (reference, cpu):
        p, m, v = torch.ones(2, 64, 2), torch.zeros(2, 64, 2), torch.zeros(2, 64, 2)
        for step in (1, 2, 3):
            once = grad.clone()
            twin.adam(p, once, m, v, 1e-2, step)
            assert not once.any()  # cleared for the next step
        into = torch.zeros(50)
        twin.scatter_max(torch.linspace(0, 1, 200), torch.arange(200) * 7 % 50, into)
        states.append((p, m, v, into))
    for truth, fast in zip(*states):
        torch.testing.assert_close(fast, truth)


def test_contraction_and_harmonics() -> None:
    torch.manual_seed(7)
    x = torch.randn(500, 3) * torch.logspace(-2, 3, 500)[:, None]
    centre, radius = torch.tensor([0.3, -0.1, 0.2]), 1.7
    y = cpu.contract(x, centre, radius)
    torch.testing.assert_close(y, reference.contract(x, centre, radius))
    assert y.abs().max() < 2
    near = x.norm(dim=-1) < 100  # further out float32 has no digits left to go back
    torch.testing.assert_close(reference.uncontract(y, centre, radius)[near], x[near], rtol=1e-2, atol=1e-4)
    d = torch.nn.functional.normalize(x, dim=-1)
    sh = cpu.spherical_harmonics(d)
    torch.testing.assert_close(sh, reference.spherical_harmonics(d), rtol=1e-4, atol=1e-5)
    ring = torch.nn.functional.normalize(torch.randn(200_000, 3), dim=-1)
    gram = cpu.spherical_harmonics(ring).T @ cpu.spherical_harmonics(ring) * (4 * torch.pi / len(ring))
    torch.testing.assert_close(gram, torch.eye(16), rtol=0, atol=0.05)  # orthonormal on the sphere


def networks(levels: int, width: int, k: int) -> tuple[Tensor, ...]:
    shapes = [(width, 2 * levels), (1 + k, width), (width, k + 16), (width, width), (3, width)]
    return tuple((torch.rand(rows, columns) * 2 - 1) * (6 / columns) ** 0.5 for rows, columns in shapes)


def close(fast: Tensor, truth: Tensor) -> None:
    assert fast.shape == truth.shape
    if truth.numel() == 0:
        return
    torch.testing.assert_close(fast, truth, rtol=1e-3, atol=2e-4 * float(truth.abs().max()) + 1e-8)


@pytest.mark.parametrize("levels, width, k", [(10, 32, 15), (3, 8, 2), (9, 48, 16), (1, 64, 31)])
@pytest.mark.parametrize("samples", [0, 1, 7, 128, 1001])
def test_hash_field(levels: int, width: int, k: int, samples: int) -> None:
    torch.manual_seed(7)
    resolutions = geometric_levels(4, 200, levels)
    nets, tables = networks(levels, width, k), torch.randn(levels, 1 << 10, 2)
    unit, d = torch.rand(samples, 3), torch.nn.functional.normalize(torch.randn(samples, 3), dim=-1)
    up_raw, up_rgb = torch.randn(samples), torch.randn(samples, 3)
    results = []
    for twin in (reference, cpu):
        leaves = [p.clone().requires_grad_() for p in (tables, *nets)]
        raw, rgb = twin.hash_field(unit, d, leaves[0], resolutions, tuple(leaves[1:]))
        total = (raw * up_raw).sum() + (rgb * up_rgb).sum()
        results.append((raw.detach(), rgb.detach(), *torch.autograd.grad(total, leaves)))
    for truth, fast in zip(*results):
        close(fast, truth)


@pytest.mark.parametrize("fill, scale, rays", [(0.05, 1.0, 300), (1.0, 3.0, 257), (0.0, 1.0, 20), (0.3, 0.0, 64)])
def test_train_step(fill: float, scale: float, rays: int) -> None:
    """The fused step against the same step by autograd: haze and surfaces, long rays, empty ones, a miss of all."""
    torch.manual_seed(8)
    resolutions = geometric_levels(8, 64, 4)
    nets, tables = networks(4, 16, 7), torch.randn(4, 1 << 12, 2) * scale
    origins = torch.nn.functional.normalize(torch.randn(rays, 3), dim=-1) * 3
    directions = torch.nn.functional.normalize(torch.randn(rays, 3) * 0.5 - origins, dim=-1)
    colours = torch.rand(rays, 3).masked_fill(torch.rand(rays, 3) < 0.2, 1.0)  # some burnt out
    batch = reference.Batch((origins, directions, torch.rand(rays)), colours, torch.rand(rays, 3))
    batch = batch._replace(gains=0.5 + torch.rand(rays, 3), trust=torch.rand(rays), moving=rays // 2)
    grid = (torch.rand(32, 32, 32) < fill).to(torch.uint8)
    results = []
    for twin in (reference, cpu):
        into = [torch.zeros_like(p) for p in (tables, *nets)]
        space = (torch.tensor([0.1, 0.0, 0.2]), 1.5)
        field = (tables, resolutions, nets)
        aim = reference.Aim(distortion=0.3, gradient_unit=2.5, stop=7.0, nearness=0.6)
        results.append((twin.train_step(batch, space, grid, (0.0, 60.0, 0.05), field, aim, into), into))
    (truth, true_grads), (fast, grads) = results
    assert fast.rays == truth.rays and fast.loss == pytest.approx(truth.loss, rel=1e-4)
    # a sample on the border of two cells, or at the very end of a ray, may fall to either side
    assert abs(len(fast.weights) - len(truth.weights)) <= 0.002 * len(truth.weights)
    close(fast.weights.sort().values[-50:], truth.weights.sort().values[-50:])
    difference = fast.cells.bincount(minlength=32**3) - truth.cells.bincount(minlength=32**3)
    assert difference.abs().sum() <= 4 + 0.01 * len(truth.cells)
    for mine, true in zip((*grads, fast.shown, fast.errors), (*true_grads, truth.shown, truth.errors)):
        assert (mine - true).norm() <= 1e-2 * true.norm()
    assert (
        (fast.weights[fast.heaviest] - truth.weights[truth.heaviest]).abs().median() < 1e-5
        if len(fast.weights)
        else (fast.heaviest.eq(-1).all() and truth.heaviest.eq(-1).all())
    )
    for mine, true in zip(fast.to_rays, truth.to_rays):
        # where a sample fell to the other side of a cell's border its slope is another's
        off = (mine - true).norm(dim=-1) > 1e-2 * true.norm(dim=-1) + 1e-4 * true.norm()
        assert mine.shape == (rays // 2, 3) and off.float().mean() < 0.03


@pytest.mark.parametrize("fill, rays", [(0.05, 700), (1.0, 257), (0.0, 20), (0.3, 0)])
def test_render(fill: float, rays: int) -> None:
    torch.manual_seed(8)
    nets, tables = networks(4, 16, 7), torch.randn(4, 1 << 12, 2)
    origins = torch.nn.functional.normalize(torch.randn(rays, 3), dim=-1) * 3
    directions = torch.nn.functional.normalize(torch.randn(rays, 3) * 0.5 - origins, dim=-1)
    grid = (torch.rand(32, 32, 32) < fill).to(torch.uint8)
    place = ((origins, directions, torch.zeros(rays)), (torch.tensor([0.1, 0.0, 0.2]), 1.5), grid, (0.0, 60.0, 0.05))
    field = (tables, geometric_levels(8, 64, 4), nets)
    for fast, truth in zip(cpu.render(*place, field, 7.0), reference.render(*place, field, 7.0)):
        assert fast.shape == truth.shape
        off = (fast - truth).abs() > 1e-3 * (1 + truth.abs())
        assert off.float().mean() < 0.01 if rays else off.numel() == 0  # a sample may fall to either side of a border


def test_train_step_is_the_same_bit_for_bit_for_any_number_of_threads() -> None:
    import numba

    before, results = numba.get_num_threads(), []
    try:
        for threads in {1, numba.config.NUMBA_NUM_THREADS}:
            numba.set_num_threads(threads)
            torch.manual_seed(9)
            nets, tables = networks(4, 32, 15), torch.randn(4, 1 << 12, 2)
            batch = reference.Batch(
                (torch.rand(700, 3), torch.nn.functional.normalize(torch.randn(700, 3), dim=-1), torch.rand(700)),
                torch.rand(700, 3),
                torch.rand(700, 3),
            )
            into = [torch.zeros_like(p) for p in (tables, *nets)]
            grid, aim = torch.ones(16, 16, 16, dtype=torch.uint8), reference.Aim(0.1, 1.0, 7.0)
            field = (tables, geometric_levels(8, 64, 4), nets)
            done = cpu.train_step(batch, (torch.zeros(3), 1.0), grid, (0.0, 50.0, 0.05), field, aim, into)
            results.append([done.weights, done.sigmas, torch.tensor(done.loss), *into])
    finally:
        numba.set_num_threads(before)
    for a, b in zip(results[0], results[-1]):
        assert torch.equal(a, b)


@pytest.mark.parametrize("fill, segments, rays", [(0.3, 3, 300), (1.0, 0, 64), (0.0, 2, 20), (0.2, 5, 257)])
def test_woven_step(fill: float, segments: int, rays: int) -> None:
    """A helper's fused step against autograd: segments before, between and behind samples, places that are taken, a
    toll on some cells; rays draw their segments from a larger set, some twice."""
    torch.manual_seed(11)
    resolutions = geometric_levels(8, 64, 4)
    nets, tables = networks(4, 16, 7), torch.randn(4, 1 << 12, 2)
    origins = torch.nn.functional.normalize(torch.randn(rays, 3), dim=-1) * 3
    directions = torch.nn.functional.normalize(torch.randn(rays, 3) * 0.5 - origins, dim=-1)
    batch = reference.Batch((origins, directions, torch.rand(rays)), torch.rand(rays, 3), torch.rand(rays, 3))
    counts = torch.randint(segments + 1, (2 * rays,))
    offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    t_mid = torch.cat([(5 * torch.rand(int(n))).sort().values for n in counts])
    chosen = torch.randint(2 * rays, (rays,))
    fixed = reference.Fixed(t_mid, torch.rand(len(t_mid)) * 2, torch.rand(len(t_mid), 3), offsets, chosen)
    unwanted = reference.Unwanted(0.3 * torch.rand(32**3), lambda x: x[:, 0] > 0.4)
    grid = (torch.rand(32, 32, 32) < fill).to(torch.uint8)
    results = []
    for twin in (reference, cpu):
        into = [torch.zeros_like(p) for p in (tables, *nets)]
        space, field = (torch.tensor([0.1, 0.0, 0.2]), 1.5), (tables, resolutions, nets)
        aim = reference.Aim(distortion=0.3, gradient_unit=2.5, stop=7.0, nearness=0.6)
        step = twin.woven_step(batch, fixed, unwanted, space, grid, (0.0, 60.0, 0.05), field, aim, into)
        results.append((step, into))
    (truth, true_grads), (fast, grads) = results
    assert fast.rays == truth.rays and fast.loss == pytest.approx(truth.loss, rel=1e-4)
    assert abs(len(fast.weights) - len(truth.weights)) <= 0.002 * len(truth.weights)
    close(fast.weights.sort().values[-50:], truth.weights.sort().values[-50:])
    for mine, true in zip(grads, true_grads):
        assert (mine - true).norm() <= 1e-2 * true.norm()


def test_a_woven_step_without_anything_woven_in_is_a_training_step() -> None:
    torch.manual_seed(12)
    nets, tables = networks(4, 32, 15), torch.randn(4, 1 << 12, 2)
    rays = (torch.rand(200, 3), torch.nn.functional.normalize(torch.randn(200, 3), dim=-1), torch.rand(200))
    batch = reference.Batch(rays, torch.rand(200, 3), torch.rand(200, 3))
    place = ((torch.zeros(3), 1.0), torch.ones(16, 16, 16, dtype=torch.uint8), (0.0, 50.0, 0.05))
    field, aim = (tables, geometric_levels(8, 64, 4), nets), reference.Aim(0.1, 1.0, 7.0)
    nothing = torch.zeros(0), torch.zeros(0), torch.zeros(0, 3), torch.zeros(201, dtype=torch.long), torch.arange(200)
    plain, woven = ([torch.zeros_like(p) for p in (tables, *nets)] for _ in range(2))
    done = cpu.train_step(batch, *place, field, aim, plain)
    unwanted = reference.Unwanted(torch.zeros(16**3), None)
    again = cpu.woven_step(batch, reference.Fixed(*nothing), unwanted, *place, field, aim, woven)
    assert again.loss == pytest.approx(done.loss, rel=1e-6) and torch.equal(again.cells, done.cells)
    for a, b in zip(woven, plain):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


def test_hash_density_is_the_field_s() -> None:
    torch.manual_seed(10)
    for levels, width, samples in ((10, 32, 3001), (3, 8, 5), (2, 20, 0)):
        resolutions, nets = geometric_levels(4, 200, levels), networks(levels, width, 3)
        tables, unit = torch.randn(levels, 1 << 10, 2), torch.rand(samples, 3)
        net = (tables, resolutions, nets[0], nets[1][0])
        raw, _ = reference.hash_field(unit, torch.zeros(samples, 3), tables, resolutions, nets)
        for twin in (reference, cpu):
            close(twin.hash_density(unit, net), raw)


def test_what_is_not_a_number_or_has_no_direction_breaks_nothing() -> None:
    tables = torch.randn(2, 1 << 12, 2)
    unit = torch.rand(70, 3)
    unit[3, 1] = torch.nan
    features = cpu.hash_encode(unit, tables.requires_grad_(), (8, 64))
    assert features[3].isnan().all() and features[:3].isfinite().all()
    features[4:].sum().backward()
    assert tables.grad is not None  # its own rows show it, no others
    assert 0 < (~tables.grad.isfinite()).sum() <= 2 * 2 * 8
    rays = (torch.tensor([[2.5, 0, 0], [0, 0, 0]]), torch.zeros(2, 3), torch.zeros(2))
    grid = torch.zeros(16, 16, 16, dtype=torch.uint8)
    assert len(cpu.march(rays, (torch.zeros(3), 1.0), grid, (0.0, 50.0, 0.05))[0]) == 0
    with torch.inference_mode():
        seen = torch.ones(16, 16, 16, dtype=torch.uint8)
        assert len(cpu.march(rays, (torch.zeros(3), 1.0), seen, (0.0, 1.0, 0.5))[0]) > 0


def test_what_cells_are_known_to_hold() -> None:
    torch.manual_seed(11)
    states = []
    cells = torch.randint(0, 300, (2, 500))
    w, sigmas = torch.rand(2, 500), torch.rand(2, 500) * 20
    for twin in (reference, cpu):
        state = torch.stack([torch.full((400,), 0.5), torch.full((400,), 0.9), torch.rand(400) * 0 + 0.1], -1)
        state = torch.cat([state, torch.full((400, 1), -1.0)], -1)
        for i in range(2):
            twin.observe(state, i + 1, 0.8, cells[i], w[i], sigmas[i])
        allowed = torch.arange(400) % 3 > 0
        states.append((state, *(twin.keep(state, allowed, 0.45, 0.8, only) for only in (False, True))))
    for truth, fast in zip(*states):
        torch.testing.assert_close(fast, truth)
    state, every, seen = states[0]
    assert (state[300:, :2] == torch.tensor([0.5, 0.9])).all()  # what is not seen does not fade
    assert every[301:].any() and not seen[301:].any()


@pytest.mark.parametrize("side", [34, 70])  # 64 cells are looked at together
def test_reach_never_passes_over_what_is_there(side: int) -> None:
    from refield.field.kernels.cpu import cells

    torch.manual_seed(12)
    grid = (torch.rand(side, side, side) < 6 / side**3).to(torch.uint8)
    found = torch.from_numpy(cells.reach(grid)).long()
    every = torch.cartesian_prod(*[torch.arange(side)] * 3)
    true = torch.stack([(every - full).abs().amax(1) for full in grid.nonzero()]).amin(0).reshape(grid.shape)
    near = true <= 5
    assert 0 < int(near.sum()) < near.numel()
    assert torch.equal(found[near], true[near])
    assert (found[~near] >= 5).all() and (found <= true).all() and int(found.max()) > 8
    grid[0, 0, 0] = 1
    assert cells.reach(grid)[0, 0, 0] == 0  # written to since
