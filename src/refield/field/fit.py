"""The one training loop: photos with poses → a field (§10.1.1), and what the update shares of it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.coverage import knowable
from refield.field.encoding import Contraction
from refield.field.losses import colour_loss, distortion_loss, scale_gradients
from refield.field.occupancy import OccupancyTrainer
from refield.field.pixels import PixelBank
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.render import render_many
from refield.field.sampling import OccupancySampler
from refield.field.volrend import accumulate_rgb, weights
from refield.scene.capture import Capture, Frame, Rays


@dataclass(frozen=True)
class FitConfig:
    """Pre-training (§10.1.1)."""

    steps: int = 2000
    """of gradient descent"""
    max_seconds: float | None = None
    """stop in time: the learning rate follows whichever of steps and seconds is further on"""
    samples: int = 8192
    """a step; the rays follow from how many samples each needs, and behind the first surface it needs none"""
    samples_per_ray: float = 40
    """the lattice along the ray is made coarser, up to 1.5 times, while a ray needs more than this"""
    rate: float = 2e-2
    """Adam's learning rate, held for the first half, then brought down to a thirtieth"""
    distortion: float = 1e-2
    """weight of the distortion loss; without it fog fills the grid"""
    gradient_unit: float = 1.0
    """gradient scaling reaches 1 at this many core radii from the camera (§10.1)"""
    field: HashFieldConfig = field(default_factory=HashFieldConfig)
    """shape of the field"""
    finest_auto: bool = True
    """choose ``field.finest`` from the photos' resolution"""
    check_every: int = 250
    """steps between looks at the held-out pixels"""
    patience: int = 4
    """looks without ``least_gain`` after which training stops"""
    least_gain: float = 0.02
    """dB"""
    seed: int = 0


@dataclass(frozen=True)
class FitProgress:
    """One look at a running fit."""

    step: int
    steps: int
    psnr: float
    """of the held-out pixels, dB; NaN where nothing is held out"""
    rays_per_second: float
    samples_per_ray: float
    seconds: float
    seconds_left: float


class NonFiniteError(RuntimeError):
    """The loss stayed infinite or NaN for too long."""


ProgressCallback = Callable[[FitProgress], None]
_BAD_STEPS = 20
COARSEST = 1.5  # times the final step along the ray


def fit_field(
    capture: Capture, config: FitConfig = FitConfig(), on_progress: ProgressCallback | None = None
) -> HashField:
    """Fit a field to the capture's training frames.

    Raises:
        ValueError: no frame to train on.
        NonFiniteError: the loss was not finite for 20 steps in a row.
    """
    torch.manual_seed(config.seed)
    contraction = place_contraction(capture)
    shape = config.field
    if config.finest_auto:
        shape = replace(shape, finest=_finest_for(capture.train, contraction, shape.log2_table))
    step = 2 * contraction.radius * 4 / shape.finest  # about two pixels
    grid = torch.ones(128, 128, 128, dtype=torch.uint8)
    model = HashField(shape, OccupancySampler(contraction, grid, max(step, contraction.radius / 192)), config.seed)
    _Fit(model, capture, config, on_progress).run()
    return model.eval().requires_grad_(False)


def place_contraction(capture: Capture) -> Contraction:
    """Where the core cube goes: around what the cameras look at, reaching half-way to them.

    The centre is the least-squares meeting point of the optical axes, held to what the cameras have before them where
    the axes hardly meet (a forward-facing capture): the points of the reconstruction, or else their own spread.
    """
    centres = torch.stack([f.centre for f in capture.frames])
    axes = torch.stack([f.world_from_cam[:3, 2] for f in capture.frames])
    eye = torch.eye(3, dtype=torch.float64)
    across = eye - axes[:, :, None] * axes[:, None, :]
    spread = (centres - centres.mean(0)).norm(dim=-1).mean().clamp_min(1e-6)
    ahead = _depth_of_points(capture, centres, axes)
    guess = (centres + axes * (spread if ahead is None else ahead)).mean(0)
    hold = 1e-3 * len(centres)
    centre = torch.linalg.solve(across.sum(0) + hold * eye, (across @ centres[:, :, None]).sum(0)[:, 0] + hold * guess)
    if ahead is not None and float(((centre - centres) * axes).sum(-1).median()) < 0.3 * ahead:
        centre = guess  # the axes cross by chance, among the cameras or behind them
    distance = (centres - centre).norm(dim=-1).median()
    return Contraction(centre.float(), float(distance) * 0.6)


def _depth_of_points(capture: Capture, centres: Tensor, axes: Tensor, most: int = 5000) -> Tensor | None:
    """How far before the cameras the reconstruction's points usually lie; None without points."""
    points = capture.points[:: max(1, len(capture.points) // most)].double()
    depths = ((points[None] - centres[:, None]) * axes[:, None]).sum(-1)
    return depths[depths > 0].median() if len(points) >= 20 and (depths > 0).any() else None


def _finest_for(frames: tuple[Frame, ...], contraction: Contraction, log2_table: int) -> int:
    """Cells a side so that the finest is about a pixel wide where the axes meet, within what a table can hold.

    A surface crosses about n^2 of a level's n^3 cells. Past n = 2.5 sqrt(entries) collisions cost more than detail
    gives: on real photographs 1253 cells came out 1.8 dB below 600 at 2^16 entries.
    """
    distances = torch.stack([(f.centre.float() - contraction.centre).norm() / f.camera.fx for f in frames])
    wanted = 4 * contraction.radius / float(distances.median())
    return int(min(max(wanted, 256), 2.5 * 2 ** (log2_table / 2)))


class TableAdam:
    """Adam for the hash tables (rows without gradient rest) beside torch's for the small matrices."""

    def __init__(self, model: HashField, rate: float) -> None:
        self.tables = model.encoding.tables
        self.first, self.second = torch.zeros_like(self.tables), torch.zeros_like(self.tables)
        small = [p for p in model.parameters() if p is not self.tables]
        self.small = torch.optim.Adam(small, lr=rate, betas=(0.9, 0.99), eps=1e-10, fused=True)
        self.count = 0

    def zero_grad(self) -> None:
        self.small.zero_grad(set_to_none=True)
        self.tables.grad = None

    def step(self, rate: float) -> None:
        self.count += 1
        for group in self.small.param_groups:
            group["lr"] = rate
        self.small.step()
        if self.tables.grad is not None:
            kernels.adam(self.tables, self.tables.grad, self.first, self.second, rate, self.count)


class _Fit:
    """The state of one run of :func:`fit_field`."""

    def __init__(
        self, model: HashField, capture: Capture, config: FitConfig, on_progress: ProgressCallback | None
    ) -> None:
        if not capture.train:
            raise ValueError("the capture has no frame to train on")
        self.model, self.config, self.on_progress = model, config, on_progress
        self.pixels = PixelBank(capture.train)
        self.judge = HeldOut(capture.held_out)
        self.adam = TableAdam(model, config.rate)
        self.occupancy = OccupancyTrainer(model, allowed=knowable(model.sampler, capture.train))
        model.looking_where(self.occupancy.allowed.to(torch.uint8).reshape(model.sampler.grid.shape))
        self.rays_per_step = 512
        self.samples_per_ray = config.samples / 512
        self.began = time.perf_counter()
        self.rays_done, self.bad = 0, 0
        self.finest_step, self.coarseness = model.sampler.step, COARSEST

    def run(self) -> None:
        self.model.train()
        looks: list[float] = []
        for step in range(self.config.steps):
            progress = self._progress(step)
            if progress >= 1:
                break
            self._step(step, progress)
            if (step + 1) % self.config.check_every == 0:
                looks.append(self._look(step + 1))
                if self._plateau(looks):
                    break
        self.occupancy.settle(self.pixels)
        if self.on_progress:
            self._look(self.config.steps)

    def _progress(self, step: int) -> float:
        by_time = 0.0
        if self.config.max_seconds:
            by_time = (time.perf_counter() - self.began) / self.config.max_seconds
        return max(step / self.config.steps, by_time)

    def _step(self, step: int, progress: float) -> None:
        self.model.sampler = replace(self.model.sampler, step=self.finest_step * self.coarseness)
        chosen = torch.randint(len(self.pixels), (self.rays_per_step,))
        rays = self.pixels.rays(chosen)
        samples = self.model.samples(rays, jitter=True)
        x, d = samples.positions(rays)
        radius = self.model.contraction.radius
        sigmas, rgbs = self.model(x, d)
        sigmas, rgbs = scale_gradients(sigmas, rgbs, samples, self.config.gradient_unit * radius)
        w = weights(sigmas, samples)
        rgb, opacity = accumulate_rgb(w, rgbs, samples)
        # what stays transparent is shown noise, so that only opaque surfaces explain the photos
        rgb = rgb + (1 - opacity)[:, None] * torch.rand(len(rays), 3)
        loss = colour_loss(rgb, self.pixels.colours(chosen))
        loss = loss + self.config.distortion * distortion_loss(w, samples, radius)
        self._descend(loss, progress)
        self.occupancy.observe(step, x, w.detach(), sigmas.detach())
        self._resize(len(rays), len(samples))

    def _descend(self, loss: Tensor, progress: float) -> None:
        if not math.isfinite(loss.item()):
            self.bad += 1
            if self.bad >= _BAD_STEPS:
                raise NonFiniteError(f"the loss was not finite for {_BAD_STEPS} steps in a row")
            return
        self.bad = 0
        self.adam.zero_grad()
        loss.backward()
        self.adam.step(self.config.rate * rate_factor(progress))

    def _resize(self, rays: int, samples: int) -> None:
        """Aim at the wanted number of samples in the next step."""
        self.rays_done += rays
        self.samples_per_ray += 0.3 * (samples / rays - self.samples_per_ray)
        # while little is known to be empty, a coarser lattice reaches more rays with the same samples
        if self.samples_per_ray > self.config.samples_per_ray and self.coarseness < COARSEST:
            self._set_coarseness(min(self.coarseness * 1.25, COARSEST))
        elif self.samples_per_ray < 0.75 * self.config.samples_per_ray and self.coarseness > 1:
            self._set_coarseness(max(self.coarseness / 1.25, 1.0))
        wanted = self.config.samples / max(self.samples_per_ray, 1.0)
        self.rays_per_step = int(min(max(wanted, 256), 16384))

    def _set_coarseness(self, to: float) -> None:
        self.samples_per_ray *= self.coarseness / to
        self.coarseness = to

    def _look(self, step: int) -> float:
        psnr = self.judge.psnr(self.model)
        self.model.train()
        if self.on_progress:
            seconds = time.perf_counter() - self.began
            left = seconds * (1 / max(self._progress(step), 1e-6) - 1)
            self.on_progress(
                FitProgress(
                    step,
                    self.config.steps,
                    psnr,
                    self.rays_done / seconds,
                    self.samples_per_ray,
                    seconds,
                    max(left, 0),
                )
            )
        return psnr

    def _plateau(self, looks: list[float]) -> bool:
        n = self.config.patience
        return len(looks) > n and max(looks[-n:]) < max(looks[:-n]) + self.config.least_gain


def rate_factor(progress: float) -> float:
    """Learning rate over the run: warm for the first half, then down to 1/30 along a cosine in the logarithm."""
    late = max(0.0, (progress - 0.5) / 0.5)
    return 30 ** -(0.5 - 0.5 * math.cos(math.pi * min(late, 1.0)))


class HeldOut:
    """Fixed pixels of photos that training never sees."""

    def __init__(self, frames: tuple[Frame, ...], count: int = 16384) -> None:
        self.rays: Rays | None = None
        if frames:
            bank = PixelBank(frames)
            g = torch.Generator().manual_seed(0)
            chosen = torch.randperm(len(bank), generator=g)[:count]
            self.rays, self.truth = bank.rays(chosen), bank.colours(chosen)

    def psnr(self, model: HashField) -> float:
        """dB over the pixels; NaN if there are none."""
        if self.rays is None:
            return math.nan
        model.eval()
        rgb = render_many(model, self.rays).rgb.clamp(0, 1)
        return -10 * math.log10(max(float((rgb - self.truth).square().mean()), 1e-12))
