"""Fits, views and the update at the paper's size: how long until how good, and what it takes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from benchmarks.record import Report, Row, forget_peaks, median, one_line, peak_memory
from refield.field import gpu_fit, graphed
from refield.field.coverage import beside, knowable
from refield.field.fit import FitConfig, FitProgress
from refield.field.fit_nerfacto import NerfactoFitConfig, fit_nerfacto
from refield.field.gpu_fit import move
from refield.field.nerfacto import NerfactoConfig, ProposalConfig
from refield.field.photos import Photos
from refield.field.placing import finest_for, place_contraction
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.render import CHUNK, render_camera, render_many, visible_samples
from refield.field.sampling import OccupancySampler
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.images import frame_image

LEVELS = (25, 28, 30, 32)  # dB, times to which are told
PRETRAINING, NERFACTO, VIEW, UPDATE = "Pre-training", "NeRFacto shape", "A view", "Update"


@dataclass(frozen=True)
class Captures:
    """Counts and seconds of a fit's CUDA graphs, kernels compiled in the first of each shape included."""

    seconds: list[float]


def new_model(capture: Capture, config: FitConfig, device: torch.device) -> HashField:
    """As `fit_field` begins, still on the CPU; with a coarse grid if it stays there."""
    torch.manual_seed(config.seed)
    space = place_contraction(capture)
    shape = replace(config.field, finest=finest_for(capture.train, space, config.field.log2_table))
    if not config.finest_auto:
        shape = config.field
    step = max(8 * space.radius / shape.finest, space.radius / 192)
    side = 128 if device.type == "cuda" else 16
    return HashField(shape, OccupancySampler(space, torch.ones((side,) * 3, dtype=torch.uint8), step), config.seed)


@contextlib.contextmanager
def noting_captures(device: torch.device) -> Iterator[Captures]:
    """Clock what `GraphedStep` takes to warm up and to be captured; without a GPU let its steps run eagerly."""
    noted, capture, replay = Captures([]), graphed.GraphedStep.capture, graphed.GraphedStep.replay

    def eager(self: graphed.GraphedStep) -> int:
        self.run_eager()
        return 1

    def clocked(self: graphed.GraphedStep) -> int:
        begin = time.perf_counter()
        done = capture(self) if device.type == "cuda" else eager(self)
        noted.seconds.append(time.perf_counter() - begin)
        return done

    graphed.GraphedStep.capture = clocked  # type: ignore[method-assign]
    if device.type != "cuda":
        graphed.GraphedStep.replay = graphed.GraphedStep.run_eager  # type: ignore[method-assign]
    try:
        yield noted
    finally:
        graphed.GraphedStep.capture, graphed.GraphedStep.replay = capture, replay  # type: ignore[method-assign]


def fit(model: HashField, capture: Capture, config: FitConfig, device: torch.device, looks: list[FitProgress]) -> None:
    """`fit_on_gpu`; on a CPU the same loop by the same kernels."""
    if device.type == "cuda":
        gpu_fit.fit_on_gpu(model, capture, Photos.of(capture), config, (looks.append, None))
    else:
        usual = gpu_fit._SIZES, gpu_fit.EVERY
        gpu_fit._SIZES, gpu_fit.EVERY = [8], 4
        try:
            known = knowable(model.sampler, capture.train), beside(model.sampler, capture.train)
            gpu_fit._GpuFit(model, Photos.of(capture), config, (known, True), (looks.append, None)).run()
        finally:
            gpu_fit._SIZES, gpu_fit.EVERY = usual


def one_fit(capture: Capture, config: FitConfig, device: torch.device) -> tuple[HashField, Row]:
    """A fit, and its row."""
    forget_peaks(device)
    looks: list[FitProgress] = []
    begin = time.perf_counter()
    model = new_model(capture, config, device)
    with noting_captures(device) as captures:
        fit(model, capture, config, device, looks)
    whole = time.perf_counter() - begin
    row = curve_row(looks[:-1] or looks, looks[-1])  # the last look is at the settled field
    inside = looks[-1].seconds
    front = {"whole s": whole, "of it before the first step s": whole - inside, "captures": len(captures.seconds)}
    front |= {"captures s": sum(captures.seconds)}
    return model.eval().requires_grad_(False), front | row | peak_memory(device)


def curve_row(looks: list[FitProgress], last: FitProgress) -> Row:
    """What a fit's looks say. Samples are summed from look to look, each part at its end's samples a ray."""
    samples = rays = 0.0
    for look in looks:
        done = look.rays_per_second * look.seconds
        samples, rays = samples + (done - rays) * look.samples_per_ray, done
    curve = [(look.seconds, look.psnr) for look in (*looks, last)]
    end = looks[-1]
    row: Row = {
        "training s": last.seconds,
        "steps": end.step,
        "steps/s": end.step / end.seconds,
        "M rays/s": rays / end.seconds / 1e6,
        "M samples/s": samples / end.seconds / 1e6,
    }
    row |= {f"to {level} dB s": time_to(curve, level) for level in LEVELS}
    return row | {"PSNR at the end": last.psnr, "_curve": curve}


def time_to(curve: list[tuple[float, float]], psnr: float) -> float | None:
    """Seconds until the first look at least that good."""
    return next((seconds for seconds, seen in curve if seen >= psnr), None)


def middle_of(rows: list[Row]) -> Row:
    """Medians over several runs."""
    numbers = [k for k, v in rows[0].items() if isinstance(v, int | float) or v is None]
    return {k: median([row[k] for row in rows]) for k in numbers} | {"_curves": [row["_curve"] for row in rows]}


def pretraining(
    report: Report,
    capture: Capture,
    configs: dict[str, FitConfig],
    device: torch.device,
    run: tuple[int, Path],
) -> None:
    """A first fit of each shape in this process, then ``run[0]`` more; the last field is kept in ``run[1]``."""
    repeats, folder = run
    for shape, config in configs.items():
        with report.trial(f"pre-training, {shape}"):
            model, row = one_fit(capture, config, device)
            report.add(PRETRAINING, {"field": shape, "run": "cold"} | row)
            keep(model, folder / f"field-{shape}")
            rows: list[Row] = []
            while len(rows) < repeats and report.left > 1.3 * (rows[-1]["whole s"] if rows else 0):
                rows.append(one_fit(capture, config, device)[1])
                report.add("Each warm fit", {"field": shape, "run": len(rows)} | rows[-1])
            if rows:
                report.add(PRETRAINING, {"field": shape, "run": f"warm, median of {len(rows)}"} | middle_of(rows))


def keep(model: HashField, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    model.save(folder)


def nerfacto(report: Report, capture: Capture, config: NerfactoFitConfig, device: torch.device) -> None:
    """The NeRFacto shape on the same photos."""
    forget_peaks(device)
    looks: list[FitProgress] = []
    with report.trial("the NeRFacto shape"):
        fit_nerfacto(capture, replace(config, device=device.type), looks.append)
    if looks:
        row = curve_row(looks, looks[-1]) | peak_memory(device)
        report.add(NERFACTO, {"asked for": f"{config.steps} steps or {config.max_seconds:.0f} s"} | row)


def view(report: Report, capture: Capture, fields: list[Path], device: torch.device, repeats: int) -> None:
    """A held-out view of each field that a fit has left, its rays made on the device."""
    frame = (capture.held_out or capture.frames)[0]
    for folder in fields:
        model = HashField.load(folder)
        move(model, device)
        pose = frame.world_from_cam.to(device)
        for chunk in (CHUNK, 1 << 18, 1 << 20):
            with report.trial(f"a view of {folder.name}, {chunk} rays at a time"):
                report.add(VIEW, {"field": folder.name[6:]} | one_view(model, frame, pose, (chunk, repeats)))
        with report.trial(f"render_camera of {folder.name} on the GPU"):
            ms = _eager_ms(partial(render_camera, model, frame.camera, frame.world_from_cam), device, repeats)
            report.add(VIEW, {"field": folder.name[6:], "rays at a time": "render_camera", "ms": ms})


def one_view(model: HashField, frame: Frame, pose: torch.Tensor, how: tuple[int, int]) -> Row:
    """Median time of a view, with its rays, and what it takes."""
    chunk, repeats = how
    device, camera = pose.device, frame.camera

    def show() -> torch.Tensor:
        with torch.device(device):
            return render_many(model, camera_rays(camera, pose), chunk).rgb

    forget_peaks(device)
    ms = _eager_ms(show, device, repeats)
    memory = peak_memory(device)
    with torch.device(device), torch.no_grad():
        rays = camera_rays(camera, pose)
        parts = (rays[i : i + chunk] for i in range(0, len(rays), chunk))
        samples = sum(len(visible_samples(model, part)) for part in parts)
    truth = frame_image(frame).reshape(-1, 3).float() / 255
    error = float((show().clamp(0, 1).cpu() - truth).square().mean())
    row: Row = {"pixels": f"{camera.width} x {camera.height}", "rays at a time": chunk, "ms": ms}
    row |= {"M rays/s": len(truth) / ms / 1e3, "samples a ray": samples / len(truth)}
    psnr = -10 * torch.tensor(error).clamp_min(1e-12).log10()
    return row | {"M samples/s": samples / ms / 1e3, "PSNR": float(psnr)} | memory


def _eager_ms(work: Callable[[], object], device: torch.device, repeats: int) -> float:
    """By the host's clock around work that asks the device for numbers, and so cannot be held in a graph."""
    taken: list[float | None] = []
    for turn in range(repeats + 2):
        begin = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize()
        if turn > 1:
            taken.append(1e3 * (time.perf_counter() - begin))
    return median(taken) or 0.0


def update(report: Report, folder: Path, device: torch.device, sizes: list[tuple[int, int]]) -> None:
    """Update training with the true change, on a field on the device, for pixels a side and photos in turn.

    The first that fails is the last that is tried.
    """
    for size, cameras in sizes:
        try:
            report.add(UPDATE, _one_update(folder / f"update-{size}", size, cameras, device))
        except Exception as error:
            what = "not on a GPU yet" if device.type == "cuda" else "failed"
            report.add(UPDATE, {"pixels": size, "photos": cameras, "training s": f"{what} ({one_line(error)})"})
            return


def _one_update(folder: Path, size: int, cameras: int, device: torch.device) -> Row:
    from benchmarks.closed_form import closed_form_capture, photograph
    from refield.synthetic.cameras import ring, square_camera
    from refield.synthetic.worlds import WORLDS
    from refield.synthetic.write import true_change
    from refield.update.config import UpdateConfig
    from refield.update.fit_helper import HelperConfig
    from refield.update.train import update_field

    world, tiny = WORLDS["table"](0), size <= 64
    capture = closed_form_capture(folder / "before", "table", size, cameras, device)
    frames = photograph(folder / "after", world.after, square_camera(size), ring(world.target), device)
    looks: list[FitProgress] = []
    config = FitConfig(steps=16 if tiny else FitConfig.steps)
    if device.type != "cuda":
        config = replace(config, steps=4, samples=8, finest_auto=False, field=tiny_shape())
    model = new_model(capture, config, device)
    with noting_captures(device):
        fit(model, capture, config, device, looks)
    model.eval().requires_grad_(False)
    move(model, device)
    stages: list[tuple[str, float]] = []
    change = true_change(world, capture, frames)
    begin = time.perf_counter()
    said = UpdateConfig(fit=HelperConfig(steps=2)) if tiny else UpdateConfig()
    update_field(capture, model, change, said, lambda name: stages.append((name, time.perf_counter() - begin)))
    whole = time.perf_counter() - begin
    training = dict(stages).get("show", whole) - dict(stages).get("train", 0.0)
    return {"pixels": size, "photos": cameras, "training s": training, "whole s": whole, "_stages": stages}


def tiny_shape() -> HashFieldConfig:
    """For a trial run on a CPU."""
    return HashFieldConfig(levels=2, coarsest=4, finest=8, log2_table=8, width=16)


def tiny_nerfacto() -> NerfactoConfig:
    """For a trial run on a CPU."""
    small = {"finest": 8, "coarsest": 4, "levels": 2, "log2_table": 8, "width": 8}
    proposals = (ProposalConfig(8, **small), ProposalConfig(6, **small))
    return NerfactoConfig(proposals, 4, levels=2, coarsest=4, finest=8, log2_table=8, width=8, occupancy=16)
