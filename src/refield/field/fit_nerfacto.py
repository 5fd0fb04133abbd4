"""Training of the NeRFacto shape: photos with poses → a field and its proposal networks (§10.1.1)."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import torch
from torch import Tensor

from refield.field.descent import MOST_SKIPPED, NonFiniteError
from refield.field.fit import FitProgress, Fitted, ProgressCallback, need_device
from refield.field.interlevel import interlevel_loss
from refield.field.kernels.reference import Batch, Stepped, compared
from refield.field.losses import colour_loss, distortion_loss, scale_gradients
from refield.field.nerfacto import NerfactoConfig, NerfactoField, ProposalConfig, looking_everywhere
from refield.field.photo_model import PhotoModel, PhotoModelConfig
from refield.field.photo_size import PhotoSizeConfig, as_read, at_full_size
from refield.field.photos import UNCHANGED, Photos, Since
from refield.field.pixels import PixelBank, Pixels
from refield.field.placing import DIRECTED, place_contraction
from refield.field.proposal import Histogram, annealing
from refield.field.sampling import OccupancySampler
from refield.field.schedule import rate_factor
from refield.field.volrend import Samples, accumulate_rgb, weights
from refield.scene.capture import Capture, Rays


@dataclass(frozen=True)
class Schedule:
    """What a NeRFacto field's training and the paper's update share; the numbers are nerfstudio's."""  # §10.1.1

    steps: int = 30_000
    """of gradient descent"""
    max_seconds: float | None = None
    """stop in time"""
    rays: int = 4096
    """a step, drawn from all pixels that teach"""
    rate: float = 1e-2
    """Adam's learning rate at the first step, of the field and of the proposal networks"""
    final_rate: float = 1e-4
    """and after ``decay_steps``, exponentially"""
    decay_steps: int = 200_000
    """longer than training: the rate only halves in 30 000"""
    interlevel: float = 1.0
    """weight of the proposals' loss"""
    distortion: float = 2e-3
    """weight of the distortion loss"""
    gradient_unit: float = 1.0
    """gradient scaling reaches 1 at this many core radii of the fitted field from the camera; 0: off"""  # §10.1
    proposal_every: int = 5
    """steps between the proposals' own steps, at the end"""
    proposal_warmup: int = 5000
    """steps over which that interval grows from 1"""
    check_every: int = 250
    """steps between looks at how far it is"""
    seed: int = 0
    """of all that is drawn at random"""


@dataclass(frozen=True)
class NerfactoFitConfig(Schedule):
    """Pre-training of the NeRFacto shape; the numbers are nerfstudio's, but for the background."""  # §10.1.1

    device: Literal["cpu", "cuda"] = "cpu"
    """where the fit runs. The field comes back to the CPU"""
    anneal_slope: float = 10.0
    """how steeply the proposals come to be trusted"""
    anneal_steps: int = 1000
    """after which they are trusted in full"""
    background: Literal["random", "last_sample"] = "random"
    """what is seen through what stays transparent: noise, or as in nerfstudio the last sample's colour. That leaves the
    last sample's density open, and renderings here are on black"""
    photos: PhotoModelConfig = field(default_factory=PhotoModelConfig)
    """what is found out about the photos, beside the field"""
    size: PhotoSizeConfig = field(default_factory=PhotoSizeConfig)
    """at which the photos are read"""
    field: NerfactoConfig = field(default_factory=NerfactoConfig)
    """shape of the field"""


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
    capture: Capture,
    config: NerfactoFitConfig = NerfactoFitConfig(),
    on_progress: ProgressCallback | None = None,
    *,
    since: Since = UNCHANGED,
) -> Fitted[NerfactoField]:
    """Fit a NeRFacto field to the capture's training frames.

    ``since``: newer photos to learn from as well, and pixels of the capture that are out of date; what it says to be
    empty is not heeded.

    Raises:
        ValueError: no frame to train on.
        InputError: a GPU is wanted and there is none.
        NonFiniteError: the loss or its gradient was not finite for 20 steps in a row; it holds the last good state.
    """
    need_device(config.device)
    capture, since = as_read(capture, since, config.size)
    if not capture.train:
        raise ValueError("the capture has no frame to train on")
    torch.manual_seed(config.seed)
    model = NerfactoField(config.field, looking_everywhere(place_contraction(capture), config.field), config.seed)
    photos = Photos.of(capture, since)
    with _on(config.device, model):
        fit = _NerfactoFit(model, photos, config, on_progress)
        try:
            fit.run()
        except NonFiniteError as error:
            error.field, error.steps = _ready(model), fit.taken
            raise
        told = fit.photos.told(capture, fit.judge, cast(Any, model))
        _ready(model)
    return Fitted(model, at_full_size(told))


@contextmanager
def _on(device: str, model: NerfactoField) -> Iterator[None]:
    """With the field on a device, where all is made that names none; it comes back to the CPU."""
    if device == "cpu":
        yield
        return
    from refield.field.gpu_fit import move

    move(model, torch.device(device))
    try:
        with torch.device(device):
            yield
    finally:
        move(model, torch.device("cpu"))


def _ready(model: NerfactoField) -> NerfactoField:
    """The field for use, its occupancy found."""
    model.eval().requires_grad_(False)
    # proposals know nothing of what an update moves: its field is marched through, where this one may hold something
    sampler = OccupancySampler.from_density(
        model.density, model.contraction, model.sampler.step, model.sampler.resolution
    )
    model.looking_where(sampler.grid)
    return model


def _pixels(bank: PixelBank, device: str) -> Pixels:
    """What they are drawn from, on a device."""
    if device == "cpu":
        return bank
    from refield.field.graphed import DevicePixels

    return DevicePixels(bank, torch.device(device))


class _NerfactoFit:
    """The state of one run of :func:`fit_nerfacto`."""

    def __init__(
        self, model: NerfactoField, photos: Photos, config: NerfactoFitConfig, on_progress: ProgressCallback | None
    ) -> None:
        self.model, self.config, self.on_progress = model, config, on_progress
        with torch.device("cpu"):  # photos are read and posed there
            bank, self.taught, self.judge = photos.bank(), photos, photos.judge()
        self.photos = PhotoModel(_pixels(bank, config.device), model.sampler, config.photos)
        self.judge.move(model.sampler.grid.device)
        if config.photos.exposures:  # see `PhotoModel.plain`
            with torch.no_grad():
                model.colour_in[:, -DIRECTED:] = 0
        self.adam = torch.optim.Adam(model.parameters(), lr=config.rate, eps=1e-15, fused=True)
        self.began = time.perf_counter()
        self.done, self.looked = 0, -1
        self.taken, self.bad = 0, 0
        """steps, and those in a row that were left out since"""
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
        progress = self._progress()
        if self.photos.may_expose(progress):
            self.photos.exposing = self.judge.tells_exposures(cast(Any, self.model))
            self.model.train()
        asked = self.photos.ask(self.taught.drawn(self.photos.bank, self.config.rays), progress)
        learning = step - self.proposed >= proposal_interval(step, self.config)
        ways = Rays(*(r.detach().requires_grad_(asked.batch.moving > 0) for r in asked.batch.rays[:2]))
        loss, done = self._loss(asked.batch, ways, step, learning)
        if not self._descend(loss, step, self.photos.plain(progress)):
            self.bad += 1
            if self.bad >= MOST_SKIPPED:
                raise NonFiniteError(f"the loss or its gradient was not finite for {MOST_SKIPPED} steps in a row")
            return
        self.taken, self.bad = self.taken + 1, 0
        if learning:
            self.proposed = step
        if moving := asked.batch.moving:
            assert ways.origins.grad is not None and ways.directions.grad is not None
            done = done._replace(to_rays=(ways.origins.grad[:moving], ways.directions.grad[:moving]))
        self.photos.learn(asked, done, progress, rate_factor(progress))

    def _descend(self, loss: Tensor, step: int, plain: bool) -> bool:
        """Take a step if the loss and its gradient are finite; whether it was taken."""
        if not math.isfinite(loss.item()):
            return False
        self.adam.zero_grad(set_to_none=True)  # Adam passes over networks that took no part
        loss.backward()
        # a gradient that is not finite shows in the networks', through which all of it has gone
        networks = [p.grad for p in self.model.parameters() if p.grad is not None and p.dim() == 2]
        if not all(bool(g.isfinite().all()) for g in networks):
            return False
        if plain and self.model.colour_in.grad is not None:
            self.model.colour_in.grad[:, -DIRECTED:] = 0
        for group in self.adam.param_groups:
            group["lr"] = rate_at(step, self.config)
        self.adam.step()
        return True

    def _loss(self, batch: Batch, ways: Rays, step: int, learning: bool) -> tuple[Tensor, Stepped]:
        """Of one batch. If the proposals are not ``learning``, nothing of theirs is kept for a backward pass.

        ``ways`` are the batch's rays, by which the field's part of the loss is differentiable.
        """
        config, rays = self.config, Rays(*batch.rays[:2])
        with torch.set_grad_enabled(learning):
            told, edges = self.model.propose(rays, True, annealing(step, config.anneal_slope, config.anneal_steps))
        loss, done = self._compare(batch, ways, edges)
        if learning:
            w = done.weights.reshape(len(rays), -1)
            loss = loss + config.interlevel * interlevel_loss(Histogram(edges, w), told)
        return loss, done

    def _compare(self, batch: Batch, ways: Rays, edges: Tensor) -> tuple[Tensor, Stepped]:
        """The field asked between the edges (N, K + 1) of each ray: its part of the loss, and what there is to tell.

        Colours heed the batch's directions, not those of ``ways``: see `Stepped.to_rays`.
        """
        config, model = self.config, self.model
        samples = model.span.samples(edges)
        x, _ = samples.positions(ways)
        sigmas, rgbs = model(x, batch.rays[1][samples.ray_ids])
        told = sigmas.detach()
        if config.gradient_unit > 0:
            sigmas, rgbs = scale_gradients(sigmas, rgbs, samples, config.gradient_unit * model.contraction.radius)
        w = weights(sigmas, samples)
        shown = self._shown(w, rgbs, samples)
        errors = compared(shown, batch)
        loss = colour_loss(errors, batch.trust) + config.distortion * distortion_loss(w, edges, samples)
        with torch.no_grad():
            cells = model.sampler.cells(x.detach())
            each = w.reshape(len(edges), -1)
            heaviest = each.argmax(-1) + torch.arange(len(each)) * each.shape[1]
        done = Stepped(float(loss.detach()), cells, w.detach(), told, len(edges))
        return loss, done._replace(shown=shown[:, :3].detach(), errors=errors.detach(), heaviest=heaviest)

    def _shown(self, w: Tensor, rgbs: Tensor, samples: Samples) -> Tensor:
        """What is composited along each ray, with its opacity, (N, 4)."""
        rgb, opacity = accumulate_rgb(w, rgbs, samples)
        if self.config.background == "last_sample":
            rgb = rgb + (1 - opacity)[:, None] * rgbs[samples.ray_offsets[1:] - 1]
            opacity = torch.ones_like(opacity)
        return torch.cat([rgb, opacity[:, None]], -1)

    def _look(self) -> None:
        self.photos.inform(self.judge)
        psnr = self.judge.psnr(cast(Any, self.model), self.photos.exposing)
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


def rate_at(step: int, config: Schedule) -> float:
    """Adam's learning rate: exponentially from ``rate`` to ``final_rate``, then constant."""
    return config.rate * (config.final_rate / config.rate) ** min(step / config.decay_steps, 1.0)


def proposal_interval(step: int, config: Schedule) -> float:
    """Steps from one of the proposals' own steps to the next: from 1 to ``proposal_every`` over the warm-up."""
    share = min(step / config.proposal_warmup, 1.0) if config.proposal_warmup else 1.0
    return max(1.0, share * config.proposal_every)
