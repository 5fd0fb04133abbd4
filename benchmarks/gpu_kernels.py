"""How long each GPU kernel takes, beside what it must move and compute.

The counts are of useful work, and the same whatever a kernel does inside. For a sample, with L levels of T entries and
networks of M multiply-adds:

- gathers: 8 corners x 2 features x 4 B x L; a scatter of gradients reads and writes as many, so twice that;
- `hash_encode`: gathers, the position (12 B), the features written (8 L B). Backward: the features' gradients (8 L),
  the position, the scatter; and the tables' gradients cleared (8 T L B a call);
- `hash_field`: gathers, position and direction (24 B), density and colour written (16 B). Backward: the features
  written and read back (16 L), both inputs, both gradients, the scatter, the tables' gradients cleared. Activations
  are computed anew and not counted;
- `march_visible`: gathers and both ends written (8 B), 28 B a ray; the grid is not counted;
- `weights`: 16 B forward, 24 B backward;
- `train_step`: marching, the field forward and backward, compositing (124 B: weights 40, colours 60, distortion 24),
  and the tables' gradients added to the sum (3 x 8 T L a call);
- `adam`, a parameter: four arrays read and written (32 B), and its gradient put back before each call (8 B).

FLOP are 2 M a sample, three times that for a step back as well; the encoding's interpolation 48 L where there is no
network; Adam 12. The floor is the larger of bytes over 4.8 TB/s and FLOP over the rate of the unit. Tables below 60 MB
live in the L2 cache, whose bandwidth is higher: a share above 100 % says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.record import Report, Row, timed
from refield.field.encoding import Contraction
from refield.field.kernels import gpu
from refield.field.kernels.reference import Aim, Batch
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.sampling import STOP, OccupancySampler

BANDWIDTH = 4.8e12  # B/s, the H200's datasheet
PEAK = {"fp32": 67e12, "tf32": 495e12, "tf32x3": 165e12, "bf16": 990e12}  # FLOP/s, dense
TABLE = "Kernels"


@dataclass(frozen=True)
class Work:
    """What one call moves and computes."""

    samples: int
    moved: float
    """bytes"""
    flop: float
    precision: str


class Counts:
    """The formulas above for one shape of the field."""

    def __init__(self, model: HashField) -> None:
        c = model.config
        h, k, self.levels = c.width, c.geometry_features, c.levels
        self.macs = h * 2 * c.levels + (1 + k) * h + h * (k + 16) + h * h + 3 * h
        self.density_macs = h * 2 * c.levels + h
        self.gathers = 64 * c.levels
        self.tables = 8 * c.levels << c.log2_table

    def field(self, n: int, precision: str, back: bool) -> Work:
        moved = n * (self.gathers + 40)
        if back:
            moved += n * (16 * self.levels + 40 + 2 * self.gathers) + self.tables
        return Work(n, moved, (6 if back else 2) * self.macs * n, precision)

    def encode(self, n: int, back: bool) -> Work:
        moved = n * (self.gathers + 12 + 8 * self.levels)
        if back:
            moved += n * (8 * self.levels + 12 + 2 * self.gathers) + self.tables
        return Work(n, moved, (2 if back else 1) * 48 * self.levels * n, "fp32")

    def march(self, n: int, rays: int) -> Work:
        return Work(n, n * (self.gathers + 8) + 28 * rays, 2 * self.density_macs * n, "tf32x3")

    def step(self, n: int, rays: int) -> Work:
        march, field = self.march(n, rays), self.field(n, "tf32", True)
        moved = march.moved + field.moved + 124 * n + 3 * self.tables
        return Work(n, moved, march.flop + field.flop, "tf32")


def row_for(name: str, shape: str, work: Work, took: tuple[float, str]) -> Row:
    """A line of the table."""
    ms, how = took
    by_bytes, by_flop = work.moved / BANDWIDTH, work.flop / PEAK[work.precision]
    floor = 1e3 * max(by_bytes, by_flop)
    return {
        "kernel": name,
        "field": shape,
        "factors": work.precision,
        "samples": work.samples,
        "ms": ms,
        "M samples/s": work.samples / ms / 1e3,
        "MB moved": work.moved / 1e6,
        "GFLOP": work.flop / 1e9,
        "TB/s": work.moved / ms / 1e9,
        "TFLOP/s": work.flop / ms / 1e9,
        "floor ms": floor,
        "bound by": "bytes" if by_bytes >= by_flop else "FLOP",
        "of the floor": f"{100 * floor / ms:.0f} %",
        "timed by": how,
    }


def measure(report: Report, shapes: dict[str, HashFieldConfig], device: torch.device, samples: int) -> None:
    """All kernels for all shapes, ``samples`` at a time; a training step has a quarter of them."""
    with report.trial("ceilings"):
        _ceilings(report, device)
    for shape, config in shapes.items():
        torch.manual_seed(0)
        model = a_field(config, device)
        for group in (_fused, _encoding, _along_rays, _learning):
            with report.trial(f"{group.__name__.strip('_')}, {shape}"):
                group(report, shape, model, samples)


def a_field(config: HashFieldConfig, device: torch.device) -> HashField:
    """As a fit begins, but with a shell of cells occupied: what a scene looks like after a while."""
    axis = torch.linspace(-2, 2, 129)[:-1] + 2 / 128
    distance = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0)
    grid = ((distance > 0.5) & (distance < 0.6)).to(torch.uint8)
    step = max(8 / config.finest, 1 / 192)
    model = HashField(config, OccupancySampler(Contraction(torch.zeros(3), 1.0), grid, step, far=10.0))
    model.to(device)
    space = Contraction(torch.zeros(3, device=device), 1.0)
    model.sampler = OccupancySampler(space, grid.to(device), step, far=10.0)
    with torch.no_grad():
        model.encoding.tables.normal_(std=0.01)
    return model


def _ceilings(report: Report, device: torch.device) -> None:
    """What this card gives to a large copy and a large product: the floors' rates are a datasheet's."""
    big = device.type == "cuda"
    a = torch.randn((1 << 28) if big else 1 << 10, device=device)
    b = torch.empty_like(a)
    ms, how = timed(lambda: b.copy_(a), device, calls=3)
    report.add("Ceilings", {"what": "copy, read and written", "rate": f"{8 * len(a) / ms / 1e9:.2f} TB/s", "by": how})
    n = 8192 if big else 32
    for name, kind in (("tf32", torch.float32), ("bf16", torch.bfloat16)):
        x, y = (torch.randn(n, n, device=device).to(kind) for _ in range(2))
        torch.backends.cuda.matmul.allow_tf32 = True
        ms, how = timed(lambda x=x, y=y: x @ y, device, calls=3)  # type: ignore[misc]
        torch.backends.cuda.matmul.allow_tf32 = False
        report.add("Ceilings", {"what": f"{name} product", "rate": f"{2 * n**3 / ms / 1e9:.0f} TFLOP/s", "by": how})


def _places(n: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Positions in [0, 1] and directions of n samples, 32 in a row on each of n / 32 random rays."""
    rays = -(-n // 32)
    origins = torch.rand(rays, 1, 3, device=device)
    d = torch.nn.functional.normalize(torch.randn(rays, 1, 3, device=device), dim=-1).expand(-1, 32, -1)
    t = torch.arange(32, device=device)[None, :, None] / 768
    return (origins + d * t).clamp(0, 1).reshape(-1, 3)[:n].contiguous(), d.reshape(-1, 3)[:n].contiguous()


def _fused(report: Report, shape: str, model: HashField, n: int) -> None:
    unit, d = _places(n, model.encoding.tables.device)
    counts, levels = Counts(model), model.encoding.resolutions
    leaves = [w.detach().clone().requires_grad_() for w in (model.encoding.tables, *model.networks)]
    gradients = torch.randn(n, device=unit.device), torch.randn(n, 3, device=unit.device)
    for precision in ("tf32", "bf16"):

        def forward(precision: str = precision) -> tuple[Tensor, Tensor]:
            return gpu.hash_field(unit, d, leaves[0], levels, tuple(leaves[1:]), precision)  # type: ignore[arg-type]

        def both(forward: Callable[[], tuple[Tensor, Tensor]] = forward) -> object:
            return torch.autograd.grad(forward(), leaves, gradients)

        def alone(forward: Callable[[], tuple[Tensor, Tensor]] = forward) -> object:
            with torch.no_grad():
                return forward()

        for name, work, back in (("hash_field forward", alone, False), ("hash_field forward + backward", both, True)):
            with report.trial(f"{name}, {shape}, {precision}"):
                took = timed(work, unit.device)
                report.add(TABLE, row_for(name, shape, counts.field(n, precision, back), took))


def _encoding(report: Report, shape: str, model: HashField, n: int) -> None:
    unit, _ = _places(n, model.encoding.tables.device)
    counts, levels = Counts(model), model.encoding.resolutions
    tables = model.encoding.tables.detach().clone().requires_grad_()
    gradient = torch.randn(n, 2 * len(levels), device=unit.device)

    def forward() -> Tensor:
        return gpu.hash_encode(unit, tables, levels)

    took = timed(lambda: forward().detach(), unit.device)
    report.add(TABLE, row_for("hash_encode forward", shape, counts.encode(n, False), took))
    took = timed(lambda: torch.autograd.grad(forward(), tables, gradient), unit.device)
    report.add(TABLE, row_for("hash_encode forward + backward", shape, counts.encode(n, True), took))


def _along_rays(report: Report, shape: str, model: HashField, n: int) -> None:
    """Marching, compositing and the whole step, for rays towards the shell from all around."""
    sampler, device, counts = model.sampler, model.encoding.tables.device, Counts(model)
    rays = max(n // 64, 8)
    eyes = torch.nn.functional.normalize(torch.randn(rays, 3, device=device), dim=-1) * 1.6
    d = torch.nn.functional.normalize(torch.rand(rays, 3, device=device) - 0.5 - eyes, dim=-1)
    asked = (eyes, d, torch.rand(rays, device=device))
    space = (sampler.contraction.centre, sampler.contraction.radius)
    where = (space, sampler.grid, sampler.lattice)
    t0, t1, offsets = gpu.march_visible(asked, *where, model.density_net, STOP)
    found = len(t0)
    room = found + 64
    took = timed(lambda: gpu.march_visible(asked, *where, model.density_net, STOP, capacity=room), device)
    report.add(TABLE, row_for("march_visible", shape, counts.march(found, rays), took) | {"_rays": rays})
    sigmas, gradient = torch.rand(found, device=device).requires_grad_(), torch.randn(found, device=device)
    took = timed(lambda: torch.autograd.grad(gpu.weights(sigmas, t0, t1, offsets), sigmas, gradient), device)
    work = Work(found, 40 * found, 20 * found, "fp32")
    report.add(TABLE, row_for("weights forward + backward", shape, work, took) | {"_rays": rays})
    batch = Batch(asked, torch.rand(rays, 3, device=device), torch.rand(rays, 3, device=device))
    field = (model.encoding.tables.detach(), model.encoding.resolutions, tuple(w.detach() for w in model.networks))
    into = [torch.zeros_like(w) for w in (field[0], *field[2])]
    aim = Aim(1e-2, 1.0, STOP)

    def step() -> object:
        return gpu.train_step(batch, *where, field, aim, into, capacity=room)  # type: ignore[arg-type]

    took = timed(step, device)
    report.add(TABLE, row_for("train_step", shape, counts.step(found, rays), took) | {"_rays": rays})


def _learning(report: Report, shape: str, model: HashField, n: int) -> None:
    tables = model.encoding.tables.detach()
    source = torch.randn_like(tables)
    param, grad, first, second = (torch.zeros_like(tables) for _ in range(4))

    def step() -> None:
        grad.copy_(source)
        gpu.adam(param, grad, first, second, 1e-2, 10)

    took, size = timed(step, tables.device), tables.numel()
    report.add(TABLE, row_for("adam, all of the tables", shape, Work(size, 40 * size, 12 * size, "fp32"), took))
