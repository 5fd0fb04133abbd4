"""The engine on a CPU, side by side with others, in one run on one machine.

    python benchmarks/engine.py [--data FOLDER] [--only curves loops cost] [--seconds 40] [--out build/engine.md]

Three sections, each a set of Markdown tables (and, for the curves, a picture):

- ``curves``: PSNR of the held-out views over time, from the same photos: the engine, its plain-torch twin (the same
  fit with ``REFIELD_KERNELS=reference``) and the NeRFacto architecture (§10.1) in nerfstudio's shape and in a reduced
  one, by our own training loop. PSNR at equal time, time to equal PSNR.
- ``loops``: the inner loops of the engine and of the twin on the same state and the same rays, medians and ratios.
- ``cost``: how time and memory grow with the size of photos, their number, and the size of the tables; on photos of a
  world in closed form, which need no path tracer.

Everything is timed in a process of its own, one after another; run it alone. Times are warm (kernels compiled before)
unless a column says cold.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from record import Row, markdown

ROOT = Path(__file__).resolve().parents[1]
TIMES = (5, 10, 15, 20, 40, 60, 120)  # s
LEVELS = (25.0, 28.0, 30.0, 31.0, 32.0)  # dB
RUNNERS = {
    "refield": "the engine",
    "twin": "its plain-torch twin",
    "nerfacto reduced": "NeRFacto, reduced (8 levels, 2^16, width 32, 64 + 32 + 24 samples, 1024 rays)",
    "nerfacto": "NeRFacto, nerfstudio's shape (16 levels, 2^19, width 64, 256 + 96 + 48 samples, 4096 rays)",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="a capture; by default the packaged sample")
    parser.add_argument("--only", nargs="+", default=["curves", "loops", "cost"], choices=["curves", "loops", "cost"])
    parser.add_argument("--seconds", type=float, default=40, help="of training, for each curve")
    parser.add_argument("--out", type=Path, default=ROOT / "build/engine.md")
    parser.add_argument("--plot", type=Path, help="where the picture goes; beside --out by default")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that the script works")
    parser.add_argument("--work", help=argparse.SUPPRESS)  # the job of a child process, JSON
    options = parser.parse_args()
    if options.work:
        print(json.dumps(WORK[(job := json.loads(options.work))["kind"]](job)))
        return 0
    options.out.parent.mkdir(parents=True, exist_ok=True)
    text = [f"## The engine on a CPU\n\n{_where(options)}\n"]
    for section in options.only:
        text.append({"curves": curves, "loops": loops, "cost": cost}[section](options))
        options.out.write_text("\n".join(text), encoding="utf-8")  # what is done is kept, whatever comes next
    print("\n".join(text))
    return 0


def _where(options: argparse.Namespace) -> str:
    import numba
    import torch

    cpu = next(
        (x.split(":")[1].strip() for x in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in x), ""
    )
    return (
        f"{datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} cores ({cpu or platform.processor()}), Python "
        f"{platform.python_version()}, torch {torch.__version__}, numba {numba.__version__}. Photos: "
        f"{options.data or 'the packaged sample'}. Command: `python benchmarks/engine.py {' '.join(sys.argv[1:])}`."
    )


def run(job: Row, **environment: str) -> Row:
    """One job in a process of its own."""
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    argv = [sys.executable, str(Path(__file__).resolve()), "--work", json.dumps(job)]
    print(f"  {job}", file=sys.stderr, flush=True)
    done = subprocess.run(
        argv, env={**os.environ, "PYTHONPATH": path, **environment}, stdout=subprocess.PIPE, check=False, text=True
    )
    if done.returncode:
        return {"failed": done.returncode}
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


# --- PSNR over time --------------------------------------------------------------------------------------------------


def curves(options: argparse.Namespace) -> str:
    found: dict[str, list[tuple[float, float]]] = {}
    facts: dict[str, Row] = {}
    for name in RUNNERS:
        job = {"kind": "fit", "runner": name, "data": str(options.data or ""), "seconds": options.seconds}
        run({**job, "seconds": 1.0})  # compiles
        slow = {"REFIELD_KERNELS": "reference"} if name == "twin" else {}
        found[name] = (facts.setdefault(name, run(job, **slow))).get("curve", [])
    picture = options.plot or options.out.with_suffix(".png")
    options.out.with_suffix(".json").write_text(json.dumps(found), encoding="utf-8")
    _plot(found, options.seconds, picture)
    at = [
        {
            "": RUNNERS[name],
            **{f"{t} s": _psnr_at(c, t) for t in TIMES if t <= options.seconds},
            "end": c[-1][1] if c else None,
            "steps": facts[name].get("steps"),
        }
        for name, c in found.items()
    ]
    to = [{"": RUNNERS[name], **{f"{v:.0f} dB": _time_to(c, v) for v in LEVELS}} for name, c in found.items()]
    return (
        f"### PSNR over time\n\nPSNR of held-out pixels (pooled, dB) after equal time; every fit was given "
        f"{options.seconds:.0f} s and ends its own schedule with it.\n\n{markdown(at)}\n\n"
        f"Seconds to equal PSNR (first look at or above it).\n\n{markdown(to)}\n\n![PSNR over time]({picture.name})\n"
    )


def _psnr_at(curve: list[tuple[float, float]], seconds: float) -> float | None:
    return next((p for t, p in reversed(curve) if t <= seconds), None)


def _time_to(curve: list[tuple[float, float]], psnr: float) -> float | None:
    return next((t for t, p in curve if p >= psnr), None)


def _plot(found: dict[str, list[tuple[float, float]]], seconds: float, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4), dpi=120)
    for name, curve in found.items():
        if curve:
            axes.plot(*zip(*curve), marker=".", label=RUNNERS[name].split(" (")[0])
    axes.set_xlim(0, 1.1 * seconds)  # the twin's last look comes minutes later, after its last sweep over the cells
    axes.set(xlabel="seconds of training", ylabel="held-out PSNR, dB")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize="small")
    figure.tight_layout()
    figure.savefig(path)


def _capture(job: Row) -> Any:
    from refield.scene.load import load_capture
    from refield.synthetic import sample_folder

    return load_capture(Path(job["data"]) if job.get("data") else sample_folder() / "before")


def _fit_job(job: Row) -> Row:
    from refield.field.fit import FitConfig, fit_field
    from refield.field.fit_nerfacto import NerfactoFitConfig, fit_nerfacto
    from refield.field.nerfacto import NerfactoConfig, ProposalConfig

    capture, curve, steps = _capture(job), [], [0]

    def look(p: Any) -> None:
        curve.append((p.seconds, p.psnr))
        steps[0] = p.step

    seconds = job["seconds"]
    if job["runner"] in ("refield", "twin"):
        every = 100 if job["runner"] == "refield" else 10
        most = FitConfig().steps if job["runner"] == "refield" else 100_000
        fit_field(capture, FitConfig(steps=most, max_seconds=seconds, check_every=every), look)
    else:
        shape, rays = NerfactoConfig(), 4096
        if "reduced" in job["runner"]:
            proposals = (ProposalConfig(64, 128, log2_table=14), ProposalConfig(32, 256, log2_table=14))
            shape = NerfactoConfig(proposals, samples=24, levels=8, finest=512, log2_table=16, width=32)
            shape, rays = replace(shape, first_density=0.1), 1024
        config = NerfactoFitConfig(rays=rays, max_seconds=seconds, check_every=25 if rays < 4096 else 10, field=shape)
        fit_nerfacto(capture, config, look)
    return {"curve": curve, "steps": steps[0]}


# --- inner loops -----------------------------------------------------------------------------------------------------


def loops(options: argparse.Namespace) -> str:
    job = {"kind": "loops", "data": str(options.data or ""), "steps": 40 if options.quick else 2000}
    with tempfile.TemporaryDirectory() as cache:
        cold = run({"kind": "cold", "data": job["data"]}, NUMBA_CACHE_DIR=cache)
        warm = run({"kind": "cold", "data": job["data"]}, NUMBA_CACHE_DIR=cache)
    done = run(job)
    rows = [{"kernels": "compiled now", **cold}, {"kernels": "from the cache", **warm}]
    return (
        "### Inner loops\n\nMedians of 5 on one state (a finished field) and the same rays, engine and twin in turns; "
        "the twin is the same function in plain torch. M/s: millions of trained samples a second.\n\n"
        f"{markdown(done.get('rows', [done]))}\n\n"
        f"Seconds in a fresh process, one after the other.\n\n{markdown(rows)}\n"
    )


def _cold_job(job: Row) -> Row:
    began = time.perf_counter()
    import refield

    light = time.perf_counter() - began
    for name in dir(refield):
        getattr(refield, name)
    heavy = time.perf_counter() - began
    import torch

    from refield.field.encoding import Contraction
    from refield.field.pixels import PixelBank
    from refield.field.radiance import HashField, HashFieldConfig
    from refield.field.render import render_frame
    from refield.field.sampling import OccupancySampler

    capture = _capture(job)
    grid = torch.ones(128, 128, 128, dtype=torch.uint8)
    field = HashField(HashFieldConfig(), OccupancySampler(Contraction(torch.zeros(3), 1.0), grid, 0.02))
    field.requires_grad_(False)
    began = time.perf_counter()
    from refield.field.kernels import cpu

    _Loop(field, PixelBank(capture.train), 1000).step(cpu)()
    stepped = time.perf_counter() - began
    render_frame(field.eval(), capture.frames[0])
    return {
        "import refield": light,
        "every public name": heavy,
        "first training step": stepped,
        "first view": time.perf_counter() - began - stepped,
    }


def _loops_job(job: Row) -> Row:
    import torch

    from refield.field.fit import FitConfig, fit_field
    from refield.field.kernels import cpu, reference
    from refield.field.pixels import PixelBank

    capture = _capture(job)
    field = fit_field(capture, FitConfig(steps=job["steps"]))
    bank = PixelBank(capture.train)
    rows: list[Row] = []
    for wanted in (8192, 65536):
        torch.manual_seed(0)
        loop = _Loop(field, bank, wanted)
        for what, engine, twin in (
            ("whole step: march, encode, networks, loss, gradients, Adam", loop.step(cpu), loop.step(reference)),
            ("march with the density network", loop.march(cpu), loop.march(reference)),
            ("inner loop: all of the step but marching", loop.inner(cpu), loop.inner(reference)),
            ("Adam", loop.adam(cpu), loop.adam(reference)),
        ):
            rows.append(_compared(what, engine, twin, loop.samples))
    rows.append(_view_row(field, capture.frames[0]))
    return {"rows": rows}


class _Loop:
    """A training step of about so many samples, cut into the parts that are timed."""

    def __init__(self, field: Any, bank: Any, wanted: int) -> None:
        import torch

        from refield.field.kernels import cpu
        from refield.field.kernels.reference import Aim, Batch

        s = field.sampler
        self.space, self.grid, self.lattice = (s.contraction.centre, s.contraction.radius), s.grid, s.lattice
        self.net, self.stop = field.density_net, 7.0
        self.field = (field.encoding.tables, field.encoding.resolutions, field.networks)
        self.parameters = [field.encoding.tables.clone(), *(w.clone() for w in field.networks)]
        self.into, self.first, self.second = ([torch.zeros_like(p) for p in self.parameters] for _ in range(3))
        self.aim = Aim(1e-2, self.space[1], self.stop)
        for rays in (1000, None):
            n = rays or max(int(1000 * wanted / self.samples), 64)
            chosen = torch.randint(len(bank), (n,))
            r = bank.rays(chosen)
            self.rays = (r.origins, r.directions, torch.rand(n))
            self.batch = Batch(self.rays, bank.colours(chosen), torch.rand(n, 3))
            self.samples = len(
                cpu.march_visible(self.rays, self.space, self.grid, self.lattice, self.net, self.stop)[0]
            )

    def march(self, twin: Any) -> Any:
        return lambda: twin.march_visible(self.rays, self.space, self.grid, self.lattice, self.net, self.stop)

    def adam(self, twin: Any) -> Any:
        def work() -> None:
            for p, g, a, b in zip(self.parameters, self.into, self.first, self.second):
                twin.adam(p, g, a, b, 1e-9, 3)

        return work

    def step(self, twin: Any) -> Any:
        adam = self.adam(twin)

        def work() -> None:
            twin.train_step(self.batch, self.space, self.grid, self.lattice, self.field, self.aim, self.into)
            adam()

        return work

    def inner(self, twin: Any) -> Any:
        """The step with its samples given. The engine's marching hands the encoding on: it is counted here."""
        from refield.field.kernels import cpu, reference

        whole, given = reference.march_visible, self.march(twin)()
        step, adam, known = self.step(twin), self.adam(twin), _known(self) if twin is cpu else None

        def on_twin() -> None:
            reference.march_visible = lambda *_: given
            try:
                step()
            finally:
                reference.march_visible = whole

        def on_engine() -> None:
            _inner_on_cpu(self, known)
            adam()

        return on_engine if twin is cpu else on_twin


def _known(loop: _Loop) -> Any:
    """Marched samples of the engine, in memory of their own."""
    from refield.field.kernels.cpu.marching import Marched, marched

    found = marched(loop.rays, loop.space, loop.grid, loop.lattice, loop.net, loop.stop)
    return Marched(*(a.copy() for a in found))


def _inner_on_cpu(loop: _Loop, known: Any) -> None:
    import numpy as np

    from refield.field.kernels.cpu import encoding, step

    res = np.asarray(loop.field[1], np.int32)
    features = known.features.view(np.float64)
    encoding.encode(known.unit, encoding.pairs(loop.field[0]), res, features, encoding.parts_of(len(known.unit)))
    step.after_march(known, loop.batch, loop.space, loop.grid.shape[0], loop.field, loop.aim, loop.into)


def _compared(what: str, engine: Any, twin: Any, samples: int) -> Row:
    """Both in turns; each is run once more before it is timed, since the other has taken caches and threads."""
    taken: tuple[list[float], list[float]] = ([], [])
    for _ in range(5):
        for work, times in zip((engine, twin), taken):
            if not times or times[0] < 1e3:
                work()
            began = time.perf_counter()
            work()
            times.append(1e3 * (time.perf_counter() - began))
    a, b = (statistics.median(t) for t in taken)
    return {
        "what": what,
        "samples": samples,
        "engine, ms": a,
        "twin, ms": b,
        "ratio": b / a,
        "engine, M/s": samples / a / 1e3,
    }


def _view_row(field: Any, frame: Any) -> Row:
    from refield.field.render import render_camera
    from refield.scene.camera import Camera

    c = frame.camera
    camera = Camera(128, 128, c.fx * 128 / c.width, c.fy * 128 / c.height, 64.0, 64.0)

    def under(kernels: str) -> Any:
        def work() -> None:
            os.environ["REFIELD_KERNELS"] = kernels
            render_camera(field, camera, frame.world_from_cam)

        return work

    row = _compared("a view of 128²", under(""), under("reference"), 0)
    os.environ["REFIELD_KERNELS"] = ""
    return {**row, "samples": None, "engine, M/s": None}


# --- growth ----------------------------------------------------------------------------------------------------------


def cost(options: argparse.Namespace) -> str:
    sizes = [(64, 70, 16), (128, 70, 16), (256, 70, 16), (512, 70, 16)]
    sizes += [(128, 20, 16), (128, 160, 16), (128, 320, 16), (512, 320, 16)]
    sizes += [(128, 70, 13), (128, 70, 14), (128, 70, 15), (128, 70, 17), (128, 70, 19)]
    if options.quick:
        sizes = [(32, 20, 10)]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        base = run({"kind": "nothing"})["peak MB"]
        for size, photos, table in sizes:
            job = {"kind": "cost", "size": size, "photos": photos, "table": table, "folder": folder}
            run({**job, "kind": "photograph"})
            job["steps"] = 40 if options.quick else 1000
            row = run(job)
            if "peak MB" in row:
                row["peak MB"] -= base
            rows.append({"photos": f"{photos} of {size}²", "table": f"2^{table}", **row})
    return (
        "### How cost grows\n\nA world in closed form, 1000 steps of 8192 samples. Stated: what `refield train` says"
        f" before it takes it. Peak: of the process, beyond the {base:.0f} MB of the program and its libraries. PSNR: "
        f"of held-out views, after these steps.\n\n{markdown(rows)}\n"
    )


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def _nothing_job(job: Row) -> Row:
    import refield.field.fit
    import refield.field.kernels.cpu

    del refield
    return {"peak MB": _peak()}


def _photograph_job(job: Row) -> Row:
    import torch
    from closed_form import closed_form_capture

    closed_form_capture(_photos(job), "cube", job["size"], job["photos"], torch.device("cpu"))
    return {}


def _photos(job: Row) -> Path:
    return Path(job["folder"]) / f"{job['size']}-{job['photos']}"


def _cost_job(job: Row) -> Row:
    from refield.field.fit import FitConfig, fit_field
    from refield.field.memory import memory_of
    from refield.field.radiance import HashFieldConfig
    from refield.field.render import render_frame
    from refield.scene.transforms_json import load_transforms

    capture = load_transforms(_photos(job), decode=False)
    config = FitConfig(steps=job["steps"], field=HashFieldConfig(log2_table=job["table"]))
    looks: list[Any] = []
    began = time.perf_counter()
    field = fit_field(capture, config, looks.append)
    seconds = time.perf_counter() - began
    times = []
    for frame in capture.frames[:4]:
        view = time.perf_counter()
        render_frame(field, frame)
        times.append(time.perf_counter() - view)
    return {
        "ms a step": 1e3 * seconds / job["steps"],
        "samples a ray": looks[-1].samples_per_ray,
        "view, s": statistics.median(times),
        "stated MB": memory_of(capture, config).total / 1e6,
        "peak MB": _peak(),
        "PSNR, dB": looks[-1].psnr,
    }


WORK = {
    "fit": _fit_job,
    "cold": _cold_job,
    "loops": _loops_job,
    "cost": _cost_job,
    "photograph": _photograph_job,
    "nothing": _nothing_job,
}

if __name__ == "__main__":
    sys.exit(main())
