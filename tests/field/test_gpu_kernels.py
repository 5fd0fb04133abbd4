"""Each GPU kernel equals its plain-torch twin: on a GPU if there is one, else through Triton's interpreter."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from refield.field.attempts import Patience, StuckError
from refield.field.encoding import geometric_levels
from refield.field.fit import FitConfig
from refield.field.kernels import reference
from refield.field.kernels.reference import Aim, Batch, Stepped
from refield.field.photo_model import PhotoModel, PhotoModelConfig
from refield.field.photos import HeldOut, Photos
from refield.field.pixels import PixelBank
from refield.field.placing import new_field
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.sampling import IN_PICTURES
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from tests.captures import CAMERA, DISTORTED, ring
from tests.field.scenes import room
from tests.fields import small_field

ON_GPU = torch.cuda.is_available()
if not ON_GPU and "triton" in sys.modules and not os.environ.get("TRITON_INTERPRET"):
    pytest.skip("triton was loaded before its interpreter could be chosen", allow_module_level=True)
with pytest.MonkeyPatch.context() as patch:
    if not ON_GPU:
        patch.setenv("TRITON_INTERPRET", "1")  # read where kernels are defined, and again where they run
    pytest.importorskip("triton")
    from refield.field import gpu_fit
    from refield.field.gpu_fit import move
    from refield.field.graphed import Descent, DevicePixels, GraphedStep
    from refield.field.kernels import gpu

# triton 3.9 announces another default for a compiler flag
pytestmark = pytest.mark.filterwarnings("ignore:TRITON_DEFAULT_FP_FUSION is unset")
DEVICE = torch.device("cuda" if ON_GPU else "cpu")
LAYOUTS = [(4,), (16, 37, 512), geometric_levels(16, 1024, 10)]
SHAPES = [(LAYOUTS[0], 8, 3), (LAYOUTS[1], 20, 15), (LAYOUTS[2], 32, 15)]  # levels, width, geometry features
WIDE = (geometric_levels(16, 2048, 13), 64, 15)  # as large fields have it


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    if not ON_GPU:
        monkeypatch.setenv("TRITON_INTERPRET", "1")


def packed(rays: int = 12) -> Tensor:
    """Offsets of rays with 0 to 29 samples each; one with none, one with more than a kernel takes at a time."""
    counts = torch.randint(0, 30, (rays,))
    counts[3], counts[5] = 0, 150
    return torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])


def segments(offsets: Tensor) -> tuple[Tensor, Tensor]:
    t0 = torch.rand(int(offsets[-1])).sort().values * 3
    return t0, t0 + 0.02


def unit_vectors(n: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(n, 3), dim=-1)


def both(function, inputs: list[Tensor], *rest: object) -> list[tuple[Tensor, Tensor]]:
    """(truth, fast) of a function's outputs and of its gradients with respect to ``inputs``, on the CPU."""
    results, upstream = [], []
    for twin, device in ((reference, torch.device("cpu")), (gpu, DEVICE)):
        leaves = [x.detach().clone().to(device).requires_grad_() for x in inputs]
        others = [x.to(device) if isinstance(x, Tensor) else x for x in rest]
        out = function(twin, *leaves, *others)
        out = out if isinstance(out, tuple) else (out,)
        upstream = upstream or [torch.randn(o.shape) for o in out]
        loss = sum((o * u.to(device)).sum() for o, u in zip(out, upstream))
        grads = torch.autograd.grad(loss, leaves)
        results.append([x.detach().cpu() for x in (*out, *grads)])
    return list(zip(*results))


def assert_equal(pairs: list[tuple[Tensor, Tensor]], rtol: float = 1e-4, share: float = 2e-3) -> None:
    """Equal up to rtol and a share of the mean magnitude; on a GPU, of what is not zero.

    There a product and a sum are rounded once: where in a fine cell a place lies is 1e-5 more exact.
    """
    for truth, fast in pairs:
        counted = truth[truth != 0] if ON_GPU else truth
        atol = share * float(counted.abs().mean().nan_to_num()) + 1e-6
        torch.testing.assert_close(fast, truth, rtol=rtol, atol=atol)


@pytest.mark.parametrize("resolutions", LAYOUTS)
@pytest.mark.parametrize("log2_table", [10, 14])
def test_hash_encoding(resolutions: tuple[int, ...], log2_table: int) -> None:
    torch.manual_seed(1)
    unit = torch.rand(203, 3)
    unit[:4] = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5], [0.999999, 1, 0]])
    tables = torch.randn(len(resolutions), 1 << log2_table, 2)
    assert_equal(both(lambda twin, u, t: twin.hash_encode(u, t, resolutions), [unit, tables]))


def field(twin, unit: Tensor, d: Tensor, tables: Tensor, networks: tuple[Tensor, ...], *, of) -> tuple[Tensor, Tensor]:
    """Either twin's `hash_field`."""
    resolutions, precision = of
    if twin is gpu:
        return gpu.hash_field(unit, d, tables, resolutions, networks, precision)
    return reference.hash_field(unit, d, tables, resolutions, networks)


def field_parts(shape: tuple[tuple[int, ...], int, int], samples: int = 333) -> list[Tensor]:
    """Places, directions, tables, the five networks."""
    resolutions, h, k = shape
    levels = len(resolutions)
    sizes = ((h, 2 * levels), (1 + k, h), (h, k + 16), (h, h), (3, h))
    networks = [torch.randn(r, c) * (2 / c) ** 0.5 for r, c in sizes]
    return [torch.rand(samples, 3), unit_vectors(samples), torch.randn(levels, 1 << 12, 2), *networks]


@pytest.mark.parametrize("shape", [*SHAPES, WIDE])
@pytest.mark.parametrize("precision", ["tf32x3", "tf32", "bf16"])
def test_fused_field(shape: tuple[tuple[int, ...], int, int], precision: str) -> None:
    if precision == "bf16" and not ON_GPU:
        pytest.skip("the interpreter takes the bits of bf16 for integers")
    if shape is WIDE and precision == "tf32x3":
        pytest.skip("the gradients' three products do not fit on a chip")
    torch.manual_seed(2)
    unit, d, *parts = field_parts(shape)
    # factors of 11 bits put one hidden unit in a thousand on the other side of zero: 0.03 of a gradient's norm, seen
    loose = {"tf32x3": 2e-3, "tf32": 6e-2, "bf16": 0.3}[precision] if ON_GPU else 2e-3
    of = (shape[0], precision)
    pairs = both(lambda twin, t, *rest: field(twin, *rest[-2:], t, rest[:-2], of=of), parts, unit, d)
    if precision == "tf32x3" or not ON_GPU:
        assert_equal(pairs, share=loose)
    for truth, fast in pairs:  # a hidden unit at zero may fall either way with less precise factors
        assert (fast - truth).norm() <= loose * truth.norm()


def test_fused_field_where_positions_need_a_gradient() -> None:
    torch.manual_seed(3)
    unit, d, tables, *networks = field_parts(SHAPES[1], 65)
    of = (SHAPES[1][0], "tf32x3")
    pairs = both(lambda twin, u, v, t, *nets: field(twin, u, v, t, nets, of=of), [unit, d, tables, *networks])
    assert_equal(pairs, rtol=1e-3)


def test_fused_field_without_gradients() -> None:
    torch.manual_seed(4)
    unit, d, tables, *networks = field_parts(SHAPES[2], 70)
    truth = field(reference, unit, d, tables, tuple(networks), of=(SHAPES[2][0], "tf32x3"))
    with torch.no_grad():
        parts = [x.to(DEVICE) for x in (unit, d, tables, *networks)]
        raw, rgb = gpu.hash_field(*parts[:3], SHAPES[2][0], tuple(parts[3:]), "tf32x3")
        density = gpu.hash_density(parts[0], (parts[2], SHAPES[2][0], parts[3], parts[4][0]))
    assert_equal([(truth[0], raw.cpu()), (truth[1], rgb.cpu()), (truth[0], density.cpu())])


def test_weights_and_closed_form() -> None:
    torch.manual_seed(5)
    offsets = packed()
    t0, t1 = segments(offsets)
    sigma = torch.rand(len(t0)) * 5
    sigma[30], sigma[31] = 1e6, 1e-4  # a surface, and what is hardly there behind it
    pairs = both(lambda twin, s, *rest: twin.weights(s, *rest), [sigma], t0, t1, offsets)
    for truth, fast in pairs:
        torch.testing.assert_close(fast, truth, rtol=1e-4, atol=1e-5)
    opacity = reference.accumulate(pairs[0][1], torch.ones(len(t0), 1), offsets)[:, 0]
    tau = reference.accumulate(sigma * (t1 - t0), torch.ones(len(t0), 1), offsets)[:, 0]
    torch.testing.assert_close(opacity + torch.exp(-tau), torch.ones(len(opacity)))  # nothing is lost


def test_small_opacities_keep_their_digits() -> None:
    sigma = torch.logspace(-6, 1, 100)
    offsets = torch.arange(101)
    t0, t1 = torch.zeros(100), torch.ones(100)
    fast = gpu.weights(*(x.to(DEVICE) for x in (sigma, t0, t1, offsets))).cpu()
    torch.testing.assert_close(fast, -torch.expm1(-sigma), rtol=1e-5, atol=0)


def test_accumulate() -> None:
    torch.manual_seed(6)
    offsets = packed()
    n = int(offsets[-1])
    pairs = both(lambda twin, w, v, o: twin.accumulate(w, v, o), [torch.rand(n), torch.randn(n, 5)], offsets)
    for truth, fast in pairs:
        torch.testing.assert_close(fast, truth, rtol=1e-4, atol=1e-5)


def test_distortion() -> None:
    torch.manual_seed(7)
    offsets = packed()
    t0, t1 = segments(offsets)
    w = torch.rand(len(t0)) * 0.1
    assert_equal(both(lambda twin, w, *rest: twin.distortion(w, *rest), [w], t0, t1, offsets), rtol=1e-3)
    assert_equal(both(lambda twin, w, *r: twin.distortion(w, *r).mean(), [w], t0, t1, offsets), rtol=1e-3)


def test_samples_behind_the_last_ray_count_for_nothing() -> None:
    torch.manual_seed(8)
    offsets, room = packed(), 40
    n = int(offsets[-1])
    t0, t1 = segments(offsets)
    t0, t1 = torch.cat([t0, torch.zeros(room)]), torch.cat([t1, torch.zeros(room)])
    leaves = [torch.rand(n + room), torch.rand(n + room, 3)]

    def rendered(twin, sigma: Tensor, values: Tensor, t0: Tensor, t1: Tensor, offsets: Tensor) -> tuple[Tensor, ...]:
        if twin is reference:
            sigma, values, t0, t1 = sigma[:n], values[:n], t0[:n], t1[:n]
        w = twin.weights(sigma, t0, t1, offsets)
        return twin.accumulate(w, values, offsets), twin.distortion(w, t0, t1, offsets)

    pairs = both(rendered, leaves, t0, t1, offsets)
    assert_equal(pairs, rtol=1e-3)
    assert not any(fast[n:].any() for _, fast in pairs[2:])
    owners = gpu.ray_ids(offsets.to(DEVICE), n + room).cpu()
    assert torch.equal(owners[:n], torch.repeat_interleave(torch.arange(len(offsets) - 1), offsets.diff()))
    assert (owners[n:] == len(offsets) - 2).all()


def question(fill: float, rays: int = 60) -> tuple:
    """Rays through a random grid: rays, space, grid, lattice."""
    torch.manual_seed(9)
    grid = (torch.rand(16, 16, 16) < fill).to(torch.uint8)
    origins, directions = torch.randn(rays, 3) * 2, unit_vectors(rays)
    directions[0], directions[1] = torch.tensor([1.0, 0, 0]), torch.tensor([0, 0, -1.0])
    space, lattice = (torch.tensor([0.1, -0.2, 0.3]), 1.5), (0.01, 20.0, 0.2)
    return (origins, directions, torch.rand(rays)), space, grid, lattice


NET = (8, 16, 64)


def density_net() -> tuple:
    torch.manual_seed(10)
    return torch.randn(3, 1 << 12, 2), NET, torch.randn(20, 6), torch.randn(20) * 0.2


def moved(x: object) -> object:
    """The same on the device under test."""
    if isinstance(x, tuple):
        return tuple(moved(y) for y in x)
    return x.to(DEVICE) if isinstance(x, Tensor) else x


def some_masks(side: int) -> Tensor:
    """Of some cells nothing finer is known, of others a part of their parts is full."""
    bits = torch.rand(side, side, side, 64) < torch.rand(side, side, side, 1) * 0.5
    return torch.where(torch.rand(side, side, side) < 0.3, 0, (bits.long() << torch.arange(64)).sum(-1))


@pytest.mark.parametrize("fill", [0.0, 0.05, 1.0])
@pytest.mark.parametrize("visible", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_march(fill: float, visible: bool, masked: bool) -> None:
    asked = question(fill)
    fine = some_masks(len(asked[2])) if masked else None
    if visible:
        truth = reference.march_visible(*asked, density_net(), 7.0, fine)
        fast = gpu.march_visible(*moved(asked), moved(density_net()), 7.0, moved(fine))
        assert len(truth[0]) < len(reference.march(*asked, fine)[0]) or fill < 1
    else:
        truth, fast = reference.march(*asked, fine), gpu.march(*moved(asked), moved(fine))
    fast = tuple(x.cpu() for x in fast)
    # a midpoint on a cell's face may fall either way after a long sum of float32 steps
    difference = (fast[2].diff() - truth[2].diff()).abs()
    assert difference.max() <= 2
    assert int(difference.sum()) <= max(2, 0.002 * len(truth[0]))
    same = difference == 0
    ids_t, ids_f = (torch.repeat_interleave(same, o.diff()) for o in (truth[2], fast[2]))
    close = (truth[0][ids_t] - fast[0][ids_f]).abs() < 1e-2 * (1 + truth[0][ids_t].abs())
    assert close.float().mean() > 0.995 if len(close) else fill == 0.0


@pytest.mark.parametrize("visible", [False, True])
def test_march_within_a_capacity(visible: bool) -> None:
    asked = moved(question(0.3, 32))
    net = (moved(density_net()), 7.0) if visible else ()
    walk = gpu.march_visible if visible else gpu.march
    t0, t1, offsets = walk(*asked, *net)
    needed = len(t0)
    assert needed > 30
    for capacity in (needed + 50, needed // 2):
        a, b, o = walk(*asked, *net, capacity=capacity)
        assert a.shape == b.shape == (capacity,)
        assert torch.equal(o, offsets.clamp(max=capacity))
        held = min(capacity, needed)
        assert torch.equal(a[:held], t0[:held]) and torch.equal(b[:held], t1[:held])
        assert not a[held:].any() and not b[held:].any()


def test_adam_and_scatter_max() -> None:
    torch.manual_seed(11)
    grad = torch.randn(3, 500, 2) * (torch.rand(3, 500, 2) < 0.5)
    states = []
    on = torch.tensor
    for adam, of, device in (
        (reference.adam, lambda x: x, "cpu"),
        (gpu.adam, lambda x: x, DEVICE),
        (gpu.adam, lambda x: on(x, device=DEVICE), DEVICE),
    ):
        p, m, v = (x.to(device) for x in (torch.ones(3, 500, 2), torch.zeros(3, 500, 2), torch.zeros(3, 500, 2)))
        for step in (1, 2, 3):
            g = grad.clone().to(device)
            adam(p, g, m, v, of(1e-2), of(step))
            assert not g.any()  # ready for the next step
        states.append([x.cpu() for x in (p, m, v)])
    for fast in states[1:]:
        torch.testing.assert_close(fast, states[0])
    values, cells = torch.linspace(-1, 1, 333), torch.arange(333) * 7 % 50
    truth, fast = torch.full((60, 3), -0.5), torch.full((60, 3), -0.5, device=DEVICE)
    reference.scatter_max(values, cells, truth[:, 1])
    gpu.scatter_max(values.to(DEVICE), cells.to(DEVICE), fast[:, 1])
    torch.testing.assert_close(fast.cpu(), truth)


def test_observe_and_keep() -> None:
    torch.manual_seed(14)
    state = torch.rand(64, 4)
    state[:, 3] = torch.randint(-1, 3, (64,)).float()
    cells, w, sigmas = torch.randint(60, (400,)), torch.rand(400), torch.rand(400) * 3
    fast, spare = state.to(DEVICE, copy=True), -torch.ones(7)
    reference.observe(state, 3, 0.8, cells, w, sigmas)
    noted = (torch.cat([cells, torch.full((7,), 63)]), torch.cat([w, spare]), torch.cat([sigmas, spare]))
    gpu.observe(fast, torch.tensor(3.0, device=DEVICE), 0.8, *(x.to(DEVICE) for x in noted))
    torch.testing.assert_close(fast.cpu(), state)
    reference.observe(state, 4, 0.8, cells[:50], w[:50], sigmas[:50])
    gpu.observe(fast, 4, 0.8, *(x[:50].to(DEVICE) for x in (cells, w, sigmas)))
    torch.testing.assert_close(fast.cpu(), state)
    allowed = torch.rand(64) < 0.5
    truth, fast = reference.keep(state, allowed, 0.5, 0.5, True), gpu.keep(fast, allowed.to(DEVICE), 0.5, 0.5, True)
    assert torch.equal(fast.cpu(), truth)


def test_contraction_and_harmonics() -> None:
    torch.manual_seed(12)
    x = torch.randn(301, 3) * torch.logspace(-2, 3, 301)[:, None]
    centre, radius = torch.tensor([0.3, -0.1, 0.2]), 1.7
    fast = gpu.contract(x.to(DEVICE), centre.to(DEVICE), radius).cpu()
    torch.testing.assert_close(fast, reference.contract(x, centre, radius))
    d = unit_vectors(301).reshape(7, 43, 3)
    fast = gpu.spherical_harmonics(d.to(DEVICE)).cpu()
    torch.testing.assert_close(fast, reference.spherical_harmonics(d), rtol=1e-4, atol=1e-5)
    assert_equal(both(lambda twin, x, c: twin.contract(x, c, radius), [x[:50]], centre))


def step_parts(model: HashField, rays: int = 20) -> tuple:
    """What `train_step` asks for, but the gradients."""
    asked = question(0.3, rays)
    colours = torch.rand(rays, 3).masked_fill(torch.rand(rays, 3) < 0.2, 1.0)
    batch = Batch(asked[0], colours, torch.rand(rays, 3), 0.5 + torch.rand(rays, 3), torch.rand(rays), rays // 2)
    field = (model.encoding.tables.detach(), model.encoding.resolutions, tuple(w.detach() for w in model.networks))
    return batch, *asked[1:], field, Aim(1e-2, 1.5, 7.0, 0.6)


def zeros_for(field: tuple) -> list[Tensor]:
    return [torch.zeros_like(w) for w in (field[0], *field[2])]


def test_train_step() -> None:
    parts = step_parts(small_field(1))
    expected, into = zeros_for(parts[4]), zeros_for(moved(parts[4]))
    truth = reference.train_step(*parts, expected)
    batch = Batch(*moved(tuple(parts[0])))
    fast = gpu.train_step(batch, *moved(parts[1:5]), parts[5], into)
    assert fast.loss == pytest.approx(truth.loss, rel=2e-3)
    assert_equal([(a, b.cpu()) for a, b in zip(expected, into)], rtol=2e-2 if ON_GPU else 1e-3, share=1e-2)
    seen = zip((truth.shown, truth.errors, *truth.to_rays), (fast.shown, fast.errors, *fast.to_rays))
    assert_equal([(a, b.cpu()) for a, b in seen], rtol=2e-2 if ON_GPU else 1e-3, share=1e-2)
    assert torch.equal(fast.heaviest.cpu(), truth.heaviest) and (truth.heaviest >= 0).any()
    n, spare = len(fast.cells), 30
    again = zeros_for(moved(parts[4]))
    roomy = gpu.train_step(batch, *moved(parts[1:5]), parts[5], again, capacity=n + spare)
    assert float(roomy.loss) == pytest.approx(fast.loss, rel=1e-4)
    assert_equal([(a.cpu(), b.cpu()) for a, b in zip(into, again)])
    assert (roomy.weights[n:] == -1).all() and (roomy.sigmas[n:] == -1).all()
    torch.testing.assert_close((roomy.weights[:n], roomy.cells[:n]), (fast.weights, fast.cells))
    assert torch.equal(roomy.heaviest, fast.heaviest)
    tight = gpu.train_step(batch, *moved(parts[1:5]), parts[5], again, capacity=n // 2)
    assert torch.isfinite(tight.loss) and (tight.weights >= 0).all()
    left_out = tight.heaviest != fast.heaviest
    assert left_out.any() and (tight.heaviest[left_out] == -1).all()


def bank() -> PixelBank:
    """Two cameras, four photos of noise."""
    cameras: list[Camera] = [CAMERA, DISTORTED, CAMERA, CAMERA]
    frames = [Frame(Path(f"{i}.png"), c, f"{i}.png", pose) for i, (c, pose) in enumerate(zip(cameras, ring(4)))]
    g = torch.Generator().manual_seed(3)
    return PixelBank(frames, [torch.randint(256, (c.height, c.width, 3), generator=g).to(torch.uint8) for c in cameras])


def test_device_pixels_are_the_banks() -> None:
    pixels = bank()
    chosen = torch.randint(len(pixels), (300,))
    truth, fast = pixels.rays(chosen), DevicePixels(pixels, DEVICE)
    assert len(fast) == len(pixels)
    rays = fast.rays(chosen.to(DEVICE))
    torch.testing.assert_close((rays.origins.cpu(), rays.directions.cpu()), (truth.origins, truth.directions))
    torch.testing.assert_close(fast.colours(chosen.to(DEVICE)).cpu(), pixels.colours(chosen))
    assert torch.equal(fast.place_of(chosen.to(DEVICE)).cpu(), pixels.place_of(chosen))
    owner = pixels.frame_of(chosen)
    basis = fast.vignetting_basis(chosen.to(DEVICE), owner.to(DEVICE))
    torch.testing.assert_close(basis.cpu(), pixels.vignetting_basis(chosen, owner))


def occupancy_state(model: HashField) -> Tensor:
    """As `OccupancyTrainer` begins."""
    state = torch.zeros(model.sampler.resolution**3, 4)
    state[:, 0], state[:, 1], state[:, 2], state[:, 3] = 0.1, 0.08, 0.3, -1.0
    return state


def graphed_step(
    model: HashField, rays: int = 24, capacity: int = 400, asked: PhotoModelConfig | None = None, slower: float = 1.0
) -> GraphedStep:
    sampler = model.sampler
    space = (sampler.contraction.centre, sampler.contraction.radius)
    where = (space, sampler.grid, (0.0, 8.0, 0.3), model.encoding.resolutions)
    occupancy, aim = (occupancy_state(model).to(DEVICE), 0.8), Aim(1e-2, 1.0, 7.0, torch.tensor(0.6, device=DEVICE))
    pixels = DevicePixels(bank(), DEVICE)
    with torch.device(DEVICE):
        photos = PhotoModel(pixels, sampler, asked or PhotoModelConfig())
    return GraphedStep(Descent(model, slower), photos, where, aim, occupancy, (rays, capacity))


def drawn(step: GraphedStep) -> Batch:
    """What the step is about to draw."""
    chosen = torch.randint(len(step.photos.bank), (step.rays,), device=DEVICE).cpu()
    jitter, background = torch.rand(step.rays, device=DEVICE).cpu(), torch.rand(step.rays, 3, device=DEVICE).cpu()
    rays = bank().rays(chosen)
    return Batch((rays.origins, rays.directions, jitter), bank().colours(chosen), background)


def test_graphed_step_is_the_fits() -> None:
    """Two steps against the reference's."""
    model = small_field(2).train().requires_grad_()
    twin = deepcopy(model).requires_grad_(False)
    move(model, DEVICE)
    step, state = graphed_step(model, slower=0.5), occupancy_state(twin)
    learnt = [twin.encoding.tables, *twin.networks]
    into, first, second = ([torch.zeros_like(w) for w in learnt] for _ in range(3))
    space = (twin.sampler.contraction.centre, twin.sampler.contraction.radius)
    step.descent.rate.fill_(1e-2)
    for count in (1, 2):
        torch.manual_seed(count)
        batch = drawn(step)
        torch.manual_seed(count)
        step.now.fill_(count)
        step.run_eager()
        field = (learnt[0], twin.encoding.resolutions, tuple(learnt[1:]))
        found = reference.train_step(
            batch, space, twin.sampler.grid, (0.0, 8.0, 0.3), field, step.aim._replace(nearness=0.6), into
        )
        assert int(step.samples) == len(found.cells) < step.capacity
        assert float(step.loss) == pytest.approx(found.loss, rel=2e-3)
        for k, parts in enumerate(zip(learnt, into, first, second)):
            reference.adam(*parts, 0.5e-2 if k else 1e-2, count)
        reference.observe(state, count, 0.8, found.cells, found.weights, found.sigmas)
    for fast, truth, begin in zip([model.encoding.tables, *model.networks], learnt, start_of(2)):
        # the sign of a gradient that is zero but for rounding decides about a whole step
        assert (fast.detach().cpu() - truth).abs().sum() < 0.02 * (truth - begin).abs().sum()
    torch.testing.assert_close(step.occupancy[0].cpu(), state, rtol=1e-2, atol=1e-4)


def test_photos_learn_from_graphed_steps_as_from_the_fits() -> None:
    """Exposures, poses and trust, against what the reference's step tells the same model on the CPU."""
    asked = PhotoModelConfig(exposures=True, poses=True, trust=True)
    model = small_field(2).train().requires_grad_()
    plain = deepcopy(model).requires_grad_(False)
    truth = PhotoModel(bank(), plain.sampler, asked)
    move(model, DEVICE)
    step = graphed_step(model, asked=asked)
    space = (plain.sampler.contraction.centre, plain.sampler.contraction.radius)
    field = (plain.encoding.tables, plain.encoding.resolutions, plain.networks)
    step.progress = 0.9
    for photos in (truth, step.photos):
        photos.exposing = True
        photos.exposures.log_gains[0], photos.exposures.vignetting[0, 0] = 0.2, -0.1
        photos.exposures._steps = 30  # so that they are followed after two
        photos.trust.trust[::3] = 0.4
    for count in (1, 2):
        torch.manual_seed(count)
        batch = drawn(step)
        torch.manual_seed(count)
        chosen = torch.randint(len(truth.bank), (step.rays,), device=DEVICE).cpu()
        ask = truth.ask(chosen, 0.9)
        origins, directions, _ = ask.batch.rays
        lines = origins, directions, batch.rays[2]
        ask = ask._replace(batch=ask.batch._replace(rays=lines, background=batch.background))
        into = [torch.zeros_like(w) for w in (field[0], *field[2])]
        found = reference.train_step(
            ask.batch, space, plain.sampler.grid, (0.0, 8.0, 0.3), field, step.aim._replace(nearness=0.6), into
        )
        truth.learn(ask, found, 0.9, 0.5)
        torch.manual_seed(count)
        step.run_eager()  # the descent's rate is 0
        with torch.device(DEVICE):
            step.photos.learn(step.asked, step.found, 0.9, 0.5)
    fast = step.photos
    assert truth.poses.moved.abs().max() > 1e-4
    assert (truth.exposures.log_gains[1:].abs().amax(1) > 1e-5).all()
    pairs = [(truth.poses.moved, fast.poses.moved), (truth.poses.lens, fast.poses.lens)]
    pairs += [(truth.exposures.log_gains, fast.exposures.log_gains)]
    pairs += [(truth.exposures.vignetting, fast.exposures.vignetting)]
    pairs += [(getattr(truth.trust, known), getattr(fast.trust, known)) for known in ("_patches", "_places")]
    assert_equal([(a, b.cpu()) for a, b in pairs], rtol=2e-2, share=2e-2)


def roomy(*parts: object, capacity: int) -> Stepped:
    """The reference's step, as a step with a capacity tells it: the interpreter takes seconds for each."""
    found = reference.train_step(*parts)
    spare = capacity - len(found.cells)
    w, sigmas = (torch.cat([t, t.new_full((spare,), -1.0)]) for t in (found.weights, found.sigmas))
    cells = torch.cat([found.cells, found.cells.new_zeros(spare)])
    return found._replace(loss=torch.tensor(found.loss), cells=cells, weights=w, sigmas=sigmas)


def small_steps(monkeypatch: pytest.MonkeyPatch, capture: Callable[[GraphedStep], int]) -> None:
    """Let the loop take few rays a step, by the reference's step, and none of its graphs."""
    monkeypatch.setattr(gpu_fit, "_SIZES", [16])
    monkeypatch.setattr(gpu_fit, "EVERY", 3)
    monkeypatch.setattr(GraphedStep, "capture", capture)
    monkeypatch.setattr(GraphedStep, "replay", GraphedStep.run_eager)
    monkeypatch.setattr(gpu, "train_step", roomy)


def loop(capture: Capture, config: FitConfig, goes_on: bool = False) -> gpu_fit._GpuFit:
    """A fit of a small field, as `fit_on_gpu` begins one."""
    shape = HashFieldConfig(levels=2, coarsest=8, finest=16, log2_table=10, width=16)
    config = replace(config, samples=32, check_every=10**6, field=shape, finest_auto=False)
    torch.manual_seed(0)
    model = new_field(capture, config, 0).train()
    everywhere = torch.ones(model.sampler.resolution**3, dtype=torch.bool)
    places = ((everywhere, ~everywhere), True)
    return gpu_fit._GpuFit(model, Photos.of(capture), config, places, (None, None), goes_on=goes_on)


@pytest.mark.skipif(ON_GPU, reason="steps are the reference's, on the CPU")
def test_the_loop_gives_up_and_goes_on_as_on_a_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def eager(step: GraphedStep) -> int:
        step.run_eager()
        return 1

    small_steps(monkeypatch, eager)
    nearness, step = list[float](), gpu.train_step
    monkeypatch.setattr(gpu, "train_step", lambda *a, **k: (nearness.append(float(a[5].nearness)), step(*a, **k))[1])
    capture, config = room(tmp_path), FitConfig(steps=6, nearness=0.3)
    rates: list[float] = []
    whole = Descent.step
    monkeypatch.setattr(Descent, "step", lambda d, loss: (rates.append(float(d.rate)), whole(d, loss))[1])
    asked: list[int] = []
    monkeypatch.setattr("refield.field.fit.ASKED", (1, 4))
    monkeypatch.setattr(Patience, "ends", lambda patience, step, *_: bool(asked.append(step)))
    loop(capture, config).run(Patience(stuck=True))
    assert asked == [4] and max(rates) == pytest.approx(config.rate)
    assert nearness == pytest.approx([0.3 * max(1 - k / 6 / 0.4, 0) for k in range(6)])
    rates.clear()
    loop(capture, config, goes_on=True).run()
    assert asked == [4] and config.rate / 40 < min(rates) and max(rates) < 1.001 * config.rate
    assert sum(rates) < 4 * config.rate  # as in the second half of a fit that begins
    monkeypatch.setattr(Patience, "ends", lambda patience, step, *_: step == 4)
    with pytest.raises(StuckError):
        loop(capture, config).run(Patience(stuck=True))


def test_a_step_is_no_larger_than_the_photos_are_worth() -> None:
    config = FitConfig(steps=1000, samples=30_000)
    assert gpu_fit._room(config, 10**9) == 32 * config.samples
    assert gpu_fit._room(config, 400_000) == 100 * 400_000 / 1000
    assert gpu_fit._room(replace(config, samples=8000), 100) * 0.95 > 512 * config.samples_per_ray - 1
    assert gpu_fit._room(config, 100) == config.samples


@pytest.mark.skipif(ON_GPU, reason="steps are the reference's, on the CPU")
def test_the_loop_finds_out_about_photos_as_the_fit_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stages: list[tuple[bool, ...]] = []

    def eager(step: GraphedStep) -> int:
        stages.append(step.photos.stage(step.progress))
        assert step.plain == stages[-1][1]
        step.run_eager()
        return 1

    small_steps(monkeypatch, eager)
    monkeypatch.setattr(HeldOut, "tells_exposures", lambda self, model: True)
    capture = room(tmp_path)
    asked = PhotoModelConfig(exposures=True, poses=True, trust=True)
    fit = loop(capture, FitConfig(steps=60, photos=asked))
    fit.run()
    model = fit.model
    # exposed, plain, trust, poses
    expected = [(False, True, False, False), (False, True, True, False), (True, True, True, False)]
    assert list(dict.fromkeys(stages)) == [*expected, (True, False, True, True)]
    told = fit.photos.told(capture, fit.judge, model)
    gains = torch.tensor([f.exposure.gains for f in told.frames if f.exposure is not None])
    assert len(gains) == len(capture.frames) and (gains != 1).any(1).all()
    moved = [bool((a.world_from_cam != b.world_from_cam).any()) for a, b in zip(told.train, capture.train)]
    assert any(moved) and model.sampler.per_step == IN_PICTURES


def start_of(seed: int) -> list[Tensor]:
    model = small_field(seed)
    return [model.encoding.tables, *model.networks]


def test_a_step_without_a_finite_loss_changes_nothing() -> None:
    model = small_field(2).train().requires_grad_()
    move(model, DEVICE)
    step = graphed_step(model, rays=8)
    step.descent.rate.fill_(1e-2)
    step.run_eager()
    before = [w.detach().clone() for w in (model.encoding.tables, *model.networks, step.occupancy[0])]
    pixels = step.photos.bank
    pixels._rgb = pixels._rgb.float() * torch.nan
    step.now.fill_(2)
    step.run_eager()
    step.run_eager()
    assert (int(step.descent.bad), int(step.descent.count)) == (2, 1)
    assert not step.found.errors.any() and (step.found.heaviest == -1).all()  # photos learn nothing from it
    for old, new in zip(before, (model.encoding.tables, *model.networks, step.occupancy[0])):
        assert torch.equal(old, new)
    with pytest.raises(RuntimeError, match="capture"):
        step.replay()


@pytest.mark.skipif(not ON_GPU, reason="needs a GPU")
def test_replays_go_on_where_the_eager_steps_ended() -> None:
    model = small_field(2).train().requires_grad_()
    move(model, DEVICE)
    step = graphed_step(model, rays=256, capacity=8192)
    step.descent.rate.fill_(1e-2)
    done = step.capture()
    losses = []
    for _ in range(40):
        step.replay()
        losses.append(float(step.loss))
    assert int(step.descent.count) == done + 40
    assert len(set(losses)) == 40  # every replay draws its own pixels
    assert sum(losses[-5:]) < sum(losses[:5])


def test_without_triton_the_import_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "triton", None)
    spec = importlib.util.spec_from_file_location("gpu_without_triton", gpu.__file__)
    assert spec and spec.loader
    with pytest.raises(ImportError, match=r"pip install 'triton>=3\.6'"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
