"""Train the helper between what is fixed along each ray (§4.1.2), until held-out pixels stop gaining."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.compiling import Compiling, compiling
from refield.field.descent import NonFiniteError, TableAdam
from refield.field.kernels.reference import Aim, Batch, Fixed, Unwanted
from refield.field.radiance import HashField
from refield.field.render import CHUNK
from refield.field.sampling import STOP
from refield.field.schedule import rate_factor
from refield.field.volrend import Samples, accumulate_rgb
from refield.scene.capture import Rays
from refield.update.composite import UpdatedField
from refield.update.frozen import Segments, Woven, weave
from refield.update.ground import Foothold
from refield.update.helper import HelperOccupancy, emptiness, without_directions
from refield.update.region import Region
from refield.update.supervision import Lessons
from refield.update.unseen import Sight

_RAYS = 1024, 8192  # of a step, at least and at most
_NEW = 0.5  # of a step's rays from the new photos: they alone show what arrived, and are few beside the old
_NETWORKS = 0.25  # of the tables' learning rate; at all of it, colours of what is dark may run to black, and stay so
_PER_RAY = 0.5  # samples of a ray, at least, when rays are counted out for a step


@dataclass(frozen=True)
class HelperConfig:
    """How the helper is trained."""

    steps: int = 200
    """of gradient descent"""
    max_seconds: float = 20.0
    """for all of the steps; the learning rate follows whichever of steps and seconds is further on"""
    samples: int = 8192
    """of the helper in a step"""
    directions: bool = False
    """let its colours depend on the direction, as the paper's do; what few photos say of that does not hold between
    them"""
    rate: float = 2e-2
    """Adam's learning rate, held for the first half, then brought to a thirtieth; a quarter of it in the networks"""
    distortion: float = 1e-2
    """weight of the distortion loss"""
    gradient_unit: float = 1.0
    """gradient scaling reaches 1 at this many core radii of the old field from the camera"""  # §10.1
    emptiness: float = 5e-2
    """weight of the colour that comes from where hardly anything can be: inside what left the less the nearer to its
    surface, beneath the ground that it stood on and above that in its rim and right beside it. Where nothing can be,
    deep inside and where old photos looked through, the helper is not asked at all; with 0 it is, everywhere"""
    check_every: int = 25
    """steps between looks at the held-out pixels"""
    patience: int = 3
    """looks without ``least_gain`` after which training stops"""
    least_gain: float = 0.03
    """dB"""


def at_plateau(looks: list[float], config: HelperConfig) -> bool:
    """Whether the last looks at the held-out pixels, dB, have gained nothing."""
    n = config.patience
    return len(looks) > n and max(looks[-n:]) < max(looks[:-n]) + config.least_gain


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
    """One run: the helper between fixed segments, until held-out pixels stop gaining.

    The first ``new`` rays of those that are taught are of the new photos.
    """

    def __init__(
        self,
        helper: HashField,
        frozen: UpdatedField,
        taught: Lit,
        new: int,
        judge: Lit,
        config: HelperConfig,
        draw: torch.Generator,
        ground: Sequence[Foothold] = (),
        sight: Sight | None = None,
    ) -> None:
        self.helper, self.config, self.frozen, self.draw = helper, config, frozen, draw
        self.taught, self.new, self.judge = taught, new, judge
        added = tuple(o.grid for o in frozen.change.objects if o.kind == "added")
        taken = Region(added + frozen.bare.grids)
        empty = emptiness(frozen.change, helper.sampler, taken, ground, sight)
        self.misplaced = config.emptiness * empty
        self.occupancy = HelperOccupancy(helper, draw, (empty == 1) & (config.emptiness > 0))
        self.adam = TableAdam(helper, networks=_NETWORKS)
        self.rays_per_step, self.steps_done = _RAYS[0], 0
        self.why_stopped = "all steps done"

    def run(self, on_progress: Callable[[UpdateProgress], None] | None = None) -> list[float]:
        """Train; the looks at the held-out pixels in dB. ``why_stopped`` says what ended it.

        The state that showed the held-out pixels best is kept: few photos are soon learnt by heart.
        """
        with compiling() as clock:
            return self._run(on_progress, clock)

    def _run(self, on_progress: Callable[[UpdateProgress], None] | None, clock: Compiling) -> list[float]:
        looks: list[float] = []
        best, c = dict[str, Tensor](), self.config
        for step in range(c.steps):
            progress = max(step / c.steps, clock.worked / c.max_seconds)
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
                    on_progress(UpdateProgress(step + 1, c.steps, looks[-1], clock.worked))
                if at_plateau(looks, c):
                    self.why_stopped = "held-out pixels stopped gaining"
                    break
        if looks and self.steps_done % c.check_every and self.psnr(self.judge) >= max(looks):
            best = {}  # the last steps, after the last look, were the best
        if best:
            self.helper.load_state_dict(best)
        self.occupancy.finish()
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
            for chosen in torch.arange(len(lit.lessons)).split(CHUNK):
                woven = self._woven(lit.lessons[chosen].rays, lit.fixed[chosen])
                out.append(accumulate_rgb(woven.weights, woven.rgb, woven.samples)[0])
        return torch.cat(out).clamp(0, 1)

    def _woven(self, rays: Rays, fixed: Segments) -> Woven:
        """The row of samples of each ray, without gradients."""
        samples = self._outside_moved(self.helper.samples(rays), rays)
        return weave(fixed, samples, *self.helper(*samples.positions(rays)))

    def _outside_moved(self, samples: Samples, rays: Rays) -> Samples:
        """Without the samples inside what moved in (§10.1.2)."""
        x, _ = samples.positions(rays)
        taken = self._taken(x)
        return samples.only(~taken) if taken.any() else samples

    def _taken(self, x: Tensor) -> Tensor:
        return self.frozen.arrived(x) >= 0

    def _drawn(self) -> Tensor:
        """Rays of a step, (N,) int64; ``new`` of those that teach, the first, are of the new photos."""
        n, new, every = self.rays_per_step, self.new, len(self.taught.lessons)
        if new in (0, every):
            return torch.randint(every, (n,), generator=self.draw)
        of_new = torch.randint(new, (round(n * _NEW),), generator=self.draw)
        return torch.cat([of_new, torch.randint(new, every, (n - len(of_new),), generator=self.draw)])

    def _step(self, step: int, rate: float) -> None:
        helper, c, n = self.helper, self.config, self.rays_per_step
        lessons, fixed = self.taught.lessons, self.taught.fixed
        chosen = self._drawn()
        rays, sampler = lessons.rays[chosen], helper.sampler
        # what stays transparent is shown noise, so that only opaque surfaces explain the photos
        jitter, shown = (torch.rand(*shape, generator=self.draw) for shape in ((n,), (n, 3)))
        batch = Batch((rays.origins, rays.directions, jitter), lessons.rgb[chosen], shown)
        done = kernels.woven_step(
            batch,
            Fixed(fixed.t_mid, fixed.optical_depth, fixed.rgb, fixed.offsets, chosen),
            Unwanted(self.misplaced, self._taken if self.frozen.moves else None),
            (sampler.contraction.centre, sampler.contraction.radius),
            sampler.grid,
            sampler.lattice,
            (helper.encoding.tables, helper.encoding.resolutions, helper.networks),
            Aim(c.distortion, c.gradient_unit * self.frozen.sampler.contraction.radius, STOP),
            self.adam.grads,
        )
        if not c.directions:
            without_directions(helper, self.adam.grads)
        if not self.adam.step(rate, done.loss):
            return
        self.occupancy.observe(step, done.cells, done.weights, done.sigmas)
        per_ray = max(len(done.cells) / n, _PER_RAY)
        self.rays_per_step = int(min(max(c.samples / per_ray, _RAYS[0]), _RAYS[1]))
