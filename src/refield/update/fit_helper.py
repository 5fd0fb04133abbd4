"""Train the helper between what is fixed along each ray (§4.1.2), until held-out pixels stop gaining."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from refield.field.fit import NonFiniteError, TableAdam, rate_factor
from refield.field.losses import colour_loss, distortion_loss
from refield.field.radiance import HashField
from refield.field.volrend import Samples, accumulate_rgb
from refield.scene.capture import Rays
from refield.scene.planes import Plane
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.frozen import Segments, Woven, weave
from refield.update.helper import HelperOccupancy, emptiness
from refield.update.region import Region
from refield.update.supervision import Lessons

_CHUNK = 16384  # rays


@dataclass(frozen=True)
class UpdateProgress:
    """One look at a running update."""

    step: int
    steps: int
    psnr: float
    """of the held-out pixels, dB"""
    seconds: float


@dataclass(frozen=True)
class Lit:
    """Rays with their colours and everything along them that is fixed."""

    lessons: Lessons
    fixed: Segments


class HelperTraining:
    """One run: the helper between fixed segments, until held-out pixels stop gaining."""

    def __init__(
        self,
        helper: HashField,
        frozen: UpdatedField,
        sparse: Lit,
        old: Lit,
        judge: Lit,
        config: UpdateConfig,
        planes: Sequence[Plane] = (),
    ) -> None:
        self.helper, self.config, self.frozen = helper, config, frozen
        self.sparse, self.old, self.judge = sparse, old, judge
        added = tuple(o.grid for o in frozen.change.objects if o.kind == "added")
        self.empty = emptiness(frozen.change, helper.sampler, Region(added + frozen.bare.grids), planes)
        self.occupancy = HelperOccupancy(helper)
        self.adam = TableAdam(helper)
        self.rays_per_step, self.steps_done = 1024, 0
        self.why_stopped = "all steps done"

    def run(self, on_progress: Callable[[UpdateProgress], None] | None = None) -> list[float]:
        """Train; the looks at the held-out pixels in dB. ``why_stopped`` says what ended it.

        The state that showed the held-out pixels best is kept: few photos are soon learnt by heart.
        """
        looks: list[float] = []
        began, c = time.perf_counter(), self.config
        best: dict[str, Tensor] = {}
        for step in range(c.steps):
            progress = max(step / c.steps, (time.perf_counter() - began) / c.max_seconds)
            if progress >= 1:
                self.why_stopped = "out of time"
                break
            self.helper.train()
            try:
                self._step(step, c.rate * rate_factor(progress))
            except NonFiniteError as error:
                if not looks:  # it broke down before there was anything worth keeping
                    raise
                self.why_stopped = str(error)
                break
            self.steps_done = step + 1
            if (step + 1) % c.check_every == 0:
                looks.append(self.psnr(self.judge))
                if looks[-1] == max(looks):
                    best = {k: v.detach().clone() for k, v in self.helper.state_dict().items()}
                if on_progress:
                    on_progress(UpdateProgress(step + 1, c.steps, looks[-1], time.perf_counter() - began))
                n = c.patience
                if len(looks) > n and max(looks[-n:]) < max(looks[:-n]) + c.least_gain:
                    self.why_stopped = "held-out pixels stopped gaining"
                    break
        if looks and self.steps_done % c.check_every and self.psnr(self.judge) >= max(looks):
            best = {}  # the last steps, after the last look, were the best
        if best:
            self.helper.load_state_dict(best)
        self.occupancy.settle()
        return looks

    def psnr(self, lit: Lit) -> float:
        """dB over rays that training does not see; NaN if there are none."""
        if len(lit.lessons) == 0:
            return math.nan
        error = (self.render(lit) - lit.lessons.rgb).square().mean()
        return -10 * math.log10(max(float(error), 1e-12))

    def render(self, lit: Lit) -> Tensor:
        """(N, 3) without gradients."""
        self.helper.eval()
        out = []
        with torch.no_grad():
            for chosen in torch.arange(len(lit.lessons)).split(_CHUNK):
                woven, _, _ = self._woven(lit.lessons[chosen].rays, lit.fixed[chosen], jitter=False)
                out.append(accumulate_rgb(woven.weights, woven.rgb, woven.samples)[0])
        return torch.cat(out).clamp(0, 1)

    def _batch(self) -> tuple[Rays, Tensor, Segments]:
        """Rays of a step, the new photos' share of them first."""
        n_sparse = round(self.rays_per_step * self.config.sparse_share) if len(self.old.lessons) else self.rays_per_step
        drawn = []
        for lit, n in ((self.sparse, n_sparse), (self.old, self.rays_per_step - n_sparse)):
            if n and len(lit.lessons):
                chosen = torch.randint(len(lit.lessons), (n,))
                drawn.append((lit.lessons[chosen], lit.fixed[chosen]))
        rays = Rays(torch.cat([a.rays.origins for a, _ in drawn]), torch.cat([a.rays.directions for a, _ in drawn]))
        return rays, torch.cat([a.rgb for a, _ in drawn]), _joined([b for _, b in drawn])

    def _woven(self, rays: Rays, fixed: Segments, jitter: bool) -> tuple[Woven, Tensor, Tensor]:
        """The batch's row of samples; positions (S, 3) and densities (S,) of the helper's own."""
        samples = self._outside_moved(self.helper.samples(rays, jitter), rays)
        x, d = samples.positions(rays)
        sigmas, rgbs = self.helper(x, d)
        return weave(fixed, samples, sigmas, rgbs), x, sigmas

    def _outside_moved(self, samples: Samples, rays: Rays) -> Samples:
        """Without the samples inside what moved in (§10.1.2)."""
        x, _ = samples.positions(rays)
        taken = self.frozen.arrived(x) >= 0
        if not taken.any():
            return samples
        kept = torch.bincount(samples.ray_ids[~taken], minlength=len(rays))
        offsets = torch.cat([kept.new_zeros(1), kept.cumsum(0)])
        return Samples(samples.t_starts[~taken], samples.t_ends[~taken], offsets)

    def _step(self, step: int, rate: float) -> None:
        rays, truth, fixed = self._batch()
        woven, x, sigmas = self._woven(rays, fixed, jitter=True)
        w = woven.weights
        rgb, opacity = accumulate_rgb(w, woven.rgb, woven.samples)
        rgb = rgb + (1 - opacity)[:, None] * torch.rand(len(rays), 3)
        radius = self.helper.contraction.radius
        loss = colour_loss(rgb, truth) + self.config.distortion * distortion_loss(w, woven.samples, radius)
        own = w[woven.own]
        cells = self.helper.sampler.cells(x)
        loss = loss + self.config.emptiness * (own * self.empty[cells]).sum() / len(rays)
        self.adam.backward(loss)
        if not self.adam.step(rate, float(loss.detach())):
            return
        self.occupancy.observe(step, cells, own.detach(), sigmas.detach())
        per_ray = max(len(x) / len(rays), 0.5)
        self.rays_per_step = int(min(max(self.config.samples / per_ray, 1024), 8192))


def _joined(parts: list[Segments]) -> Segments:
    counts = torch.cat([p.offsets.diff() for p in parts])
    return Segments(
        torch.cat([p.t_mid for p in parts]),
        torch.cat([p.optical_depth for p in parts]),
        torch.cat([p.rgb for p in parts]),
        torch.cat([counts.new_zeros(1), counts.cumsum(0)]),
    )
