"""Training of the NeRFacto shape: photos with poses → a field and its proposal networks (§10.1.1)."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.descent import MOST_SKIPPED, NonFiniteError
from refield.field.fit import FitProgress, ProgressCallback
from refield.field.interlevel import interlevel_loss
from refield.field.losses import colour_loss, scale_gradients
from refield.field.nerfacto import NerfactoConfig, NerfactoField, ProposalConfig, looking_everywhere
from refield.field.photos import HeldOut
from refield.field.pixels import PixelBank
from refield.field.placing import place_contraction
from refield.field.proposal import Histogram, annealing
from refield.field.sampling import OccupancySampler
from refield.field.volrend import Samples, accumulate_rgb, weights
from refield.scene.capture import Capture, Rays


@dataclass(frozen=True)
class NerfactoFitConfig:
    """Pre-training of the NeRFacto shape (§10.1.1); the numbers are nerfstudio's, but for the background."""

    steps: int = 30_000
    """of gradient descent"""
    max_seconds: float | None = None
    """stop in time"""
    rays: int = 4096
    """a step"""
    rate: float = 1e-2
    """Adam's learning rate at the first step"""
    final_rate: float = 1e-4
    """and after ``decay_steps``, exponentially"""
    decay_steps: int = 200_000
    """longer than training: the rate only halves in 30 000"""
    interlevel: float = 1.0
    """weight of the proposals' loss"""
    distortion: float = 2e-3
    """weight of the distortion loss"""
    gradient_unit: float = 1.0
    """gradient scaling reaches 1 at this many core radii from the camera (§10.1); 0 turns it off"""
    anneal_slope: float = 10.0
    """how steeply the proposals come to be trusted"""
    anneal_steps: int = 1000
    """after which they are trusted in full"""
    proposal_every: int = 5
    """steps between the proposals' own steps, at the end"""
    proposal_warmup: int = 5000
    """steps over which that interval grows from 1"""
    background: Literal["random", "last_sample"] = "random"
    """what is seen through what stays transparent: noise, or as in nerfstudio the last sample's colour. That leaves the
    last sample's density open, and renderings here are on black"""
    field: NerfactoConfig = field(default_factory=NerfactoConfig)
    """shape of the field"""
    check_every: int = 250
    """steps between looks at the held-out pixels"""
    seed: int = 0


REDUCED = NerfactoFitConfig(
    steps=1500,
    rays=1024,
    decay_steps=1500,
    field=NerfactoConfig(
        (ProposalConfig(64, 128, log2_table=14), ProposalConfig(32, 256, log2_table=14)),
        samples=24,
        levels=8,
        finest=512,
        log2_table=16,
        width=32,
        first_density=0.1,
        step=1 / 80,
    ),
)
"""A shape and a schedule for a CPU: nerfstudio's take hours there"""


def fit_nerfacto(
    capture: Capture, config: NerfactoFitConfig = NerfactoFitConfig(), on_progress: ProgressCallback | None = None
) -> NerfactoField:
    """Fit a NeRFacto field to the capture's training frames.

    Raises:
        ValueError: no frame to train on.
        NonFiniteError: the loss was not finite for 20 steps in a row.
    """
    if not capture.train:
        raise ValueError("the capture has no frame to train on")
    torch.manual_seed(config.seed)
    model = NerfactoField(config.field, looking_everywhere(place_contraction(capture), config.field), config.seed)
    _NerfactoFit(model, capture, config, on_progress).run()
    model.eval().requires_grad_(False)
    # proposals know nothing of what an update moves: its field is marched through, where this one may hold something
    sampler = OccupancySampler.from_density(
        model.density, model.contraction, model.sampler.step, model.sampler.resolution
    )
    model.looking_where(sampler.grid)
    return model


class _NerfactoFit:
    """The state of one run of :func:`fit_nerfacto`."""

    def __init__(
        self, model: NerfactoField, capture: Capture, config: NerfactoFitConfig, on_progress: ProgressCallback | None
    ) -> None:
        self.model, self.config, self.on_progress = model, config, on_progress
        self.pixels = PixelBank(capture.train)
        self.judge = HeldOut(capture.held_out)
        self.adam = torch.optim.Adam(model.parameters(), lr=config.rate, eps=1e-15, fused=True)
        self.began = time.perf_counter()
        self.done, self.looked = 0, -1
        self.bad = 0
        self.proposed = -config.proposal_every
        """the last step at which the proposals learnt"""

    def run(self) -> None:
        self.model.train()
        while self.done < self.config.steps and self._progress() < 1:
            self._step(self.done)
            self.done += 1
            if self.done % self.config.check_every == 0:
                self._look()
        if self.looked < self.done:
            self._look()

    def _progress(self) -> float:
        by_time = (time.perf_counter() - self.began) / self.config.max_seconds if self.config.max_seconds else 0.0
        return max(self.done / self.config.steps, by_time)

    def _step(self, step: int) -> None:
        chosen = torch.randint(len(self.pixels), (self.config.rays,))
        learning = step - self.proposed >= proposal_interval(step, self.config)
        loss = self._loss(self.pixels.rays(chosen), self.pixels.colours(chosen), step, learning)
        if not math.isfinite(loss.item()):
            self.bad += 1
            if self.bad >= MOST_SKIPPED:
                raise NonFiniteError(f"the loss was not finite for {MOST_SKIPPED} steps in a row")
            return
        self.bad = 0
        if learning:
            self.proposed = step
        self._descend(loss, step)

    def _descend(self, loss: Tensor, step: int) -> None:
        self.adam.zero_grad(set_to_none=True)  # Adam passes over networks that took no part
        loss.backward()
        for group in self.adam.param_groups:
            group["lr"] = rate_at(step, self.config)
        self.adam.step()

    def _loss(self, rays: Rays, truth: Tensor, step: int, learning: bool) -> Tensor:
        """Of one batch. If the proposals are not ``learning``, nothing of theirs is kept for a backward pass."""
        config, model = self.config, self.model
        with torch.set_grad_enabled(learning):
            told, edges = model.propose(rays, True, annealing(step, config.anneal_slope, config.anneal_steps))
        samples = model.span.samples(edges)
        sigmas, rgbs = model(*samples.positions(rays))
        if config.gradient_unit > 0:
            sigmas, rgbs = scale_gradients(sigmas, rgbs, samples, config.gradient_unit * model.contraction.radius)
        w = weights(sigmas, samples)
        loss = colour_loss(self._seen(w, rgbs, samples), truth)
        loss = loss + config.distortion * _distortion(w, edges, samples)
        if learning:
            loss = loss + config.interlevel * interlevel_loss(Histogram(edges, w.reshape(len(rays), -1)), told)
        return loss

    def _seen(self, w: Tensor, rgbs: Tensor, samples: Samples) -> Tensor:
        """The colour of each ray before the background, (N, 3)."""
        rgb, opacity = accumulate_rgb(w, rgbs, samples)
        last = self.config.background == "last_sample"
        behind = rgbs[samples.ray_offsets[1:] - 1] if last else torch.rand_like(rgb)
        return rgb + (1 - opacity)[:, None] * behind

    def _look(self) -> None:
        psnr = self.judge.psnr(cast(Any, self.model))
        self.model.train()
        self.looked = self.done
        if self.on_progress:
            seconds = time.perf_counter() - self.began
            left = seconds * (1 / max(self._progress(), 1e-6) - 1)
            rate = self.done * self.config.rays / seconds
            shape = self.config.field
            self.on_progress(
                FitProgress(self.done, self.config.steps, psnr, rate, shape.samples, seconds, max(left, 0.0))
            )


def rate_at(step: int, config: NerfactoFitConfig) -> float:
    """Adam's learning rate: exponentially from ``rate`` to ``final_rate``, then constant."""
    return config.rate * (config.final_rate / config.rate) ** min(step / config.decay_steps, 1.0)


def proposal_interval(step: int, config: NerfactoFitConfig) -> float:
    """Steps from one of the proposals' own steps to the next: from 1 to ``proposal_every`` over the warm-up."""
    share = min(step / config.proposal_warmup, 1.0) if config.proposal_warmup else 1.0
    return max(1.0, share * config.proposal_every)


def _distortion(w: Tensor, edges: Tensor, samples: Samples) -> Tensor:
    """Mean of mip-NeRF 360's Eq. 15 over the rays, in s, so that far haze counts as near haze does."""
    starts, ends = edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1)
    return kernels.distortion(w, starts, ends, samples.ray_offsets).mean()
