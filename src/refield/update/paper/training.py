"""Train the helper and fine-tune the proposals, the old field frozen (§4.1.2, §10.1)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from refield.field.descent import MOST_SKIPPED, NonFiniteError
from refield.field.fit_nerfacto import proposal_interval, rate_at
from refield.field.interlevel import interlevel_loss
from refield.field.losses import colour_loss, distortion_loss, scale_gradients
from refield.field.pixels import PixelBank
from refield.field.proposal import Histogram
from refield.field.volrend import Samples, accumulate_rgb, weights
from refield.scene.capture import Rays
from refield.update.fit_helper import UpdateProgress
from refield.update.paper.config import PaperUpdateConfig
from refield.update.paper.field import PaperField

OnProgress = Callable[[UpdateProgress], None]


class PaperTraining:
    """One run. The proposals are trusted in full from the first step: they have been trained before."""

    def __init__(self, field: PaperField, bank: PixelBank, config: PaperUpdateConfig, draw: torch.Generator) -> None:
        """``bank``: the pixels that teach; its photos are the helper's looks."""
        self.field, self.bank, self.config, self.draw = field, bank, config, draw
        self.learning = [*field.helper.parameters(), *field.proposals.parameters()]
        self.adam = torch.optim.Adam(self.learning, lr=config.rate, eps=1e-15, fused=True)
        self.proposed = -config.proposal_every
        """the last step at which the proposals learnt"""
        self.why_stopped = "all steps done"

    def run(self, on_progress: OnProgress | None = None) -> None:
        """All steps, or as many as the time allows; ``why_stopped`` says which. No pixel is held out, so that looks
        tell no PSNR.

        Raises:
            NonFiniteError: the loss or its gradient was not finite for 20 steps in a row.
        """
        c, began, skipped = self.config, time.perf_counter(), 0
        for step in range(c.steps):
            if c.max_seconds is not None and time.perf_counter() - began > c.max_seconds:
                self.why_stopped = "out of time"
                break
            skipped = 0 if self._step(step) else skipped + 1
            if skipped >= MOST_SKIPPED:
                raise NonFiniteError(f"the loss or its gradient was not finite for {MOST_SKIPPED} steps in a row")
            if on_progress and (step + 1) % c.check_every == 0:
                on_progress(UpdateProgress(step + 1, c.steps, math.nan, time.perf_counter() - began))

    def _step(self, step: int) -> bool:
        """Whether it could be taken."""
        pixels = torch.randint(len(self.bank), (self.config.rays,), generator=self.draw)
        learning = step - self.proposed >= proposal_interval(step, self.config)
        loss = self._loss(pixels, learning)
        if not math.isfinite(loss.item()):
            return False
        self.adam.zero_grad(set_to_none=True)  # Adam passes over networks that took no part
        loss.backward()
        # a gradient that is not finite shows in the networks', through which all of it has gone
        if not all(bool(p.grad.isfinite().all()) for p in self.learning if p.grad is not None and p.dim() == 2):
            return False
        for group in self.adam.param_groups:
            group["lr"] = rate_at(step, self.config)
        self.adam.step()
        if learning:
            self.proposed = step
        return True

    def _loss(self, pixels: Tensor, learning: bool) -> Tensor:
        """Of one batch (N,). If the proposals are not ``learning``, nothing of theirs is kept for a backward pass."""
        field, bank, c = self.field, self.bank, self.config
        rays, photo = bank.rays(pixels), bank.frame_of(pixels)
        with torch.set_grad_enabled(learning):
            told, edges = field.propose(rays, jitter=True, draw=self.draw)
        samples = field.base.span.samples(edges)
        x, d = samples.positions(rays)
        sigmas, rgbs = field.seen_in(photo[samples.ray_ids], x, d)
        if c.gradient_unit > 0:
            sigmas, rgbs = scale_gradients(sigmas, rgbs, samples, c.gradient_unit * field.base.contraction.radius)
        w = weights(sigmas, samples)
        errors = self._shown(w, rgbs, samples, rays) - bank.colours(pixels)
        loss = colour_loss(errors) + c.distortion * distortion_loss(w, edges, samples)
        if learning:
            loss = loss + c.interlevel * interlevel_loss(Histogram(edges, w.reshape(len(rays), -1)), told)
        return loss

    def _shown(self, w: Tensor, rgbs: Tensor, samples: Samples, rays: Rays) -> Tensor:
        """The rays' colours (N, 3) (Eq. 4), over noise, as in pre-training: only opaque surfaces explain the photos."""
        rgb, opacity = accumulate_rgb(w, rgbs, samples)
        return rgb + (1 - opacity)[:, None] * torch.rand(len(rays), 3, generator=self.draw)
