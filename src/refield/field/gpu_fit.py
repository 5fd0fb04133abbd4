"""The training loop on a GPU: replays of a captured step, and between them what a graph cannot hold."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from refield.field.attempts import ENDLESS, Patience
from refield.field.compiling import Compiling
from refield.field.coverage import beside
from refield.field.descent import FADE_EVERY, MOST_SKIPPED, NonFiniteError, fading
from refield.field.encoding import Contraction
from refield.field.fit import (
    COARSEST,
    FitConfig,
    Fitting,
    ProgressCallback,
    StepCallback,
)
from refield.field.graphed import Descent, DevicePixels, GraphedStep
from refield.field.kernels.reference import Aim
from refield.field.nerfacto import NerfactoField
from refield.field.occupancy import DECAY, EVERY, OccupancyTrainer
from refield.field.photo_model import PhotoModel
from refield.field.photos import Photos
from refield.field.placing import COLOUR_IN, DIRECTED, stand_outside
from refield.field.radiance import HashField
from refield.field.sampling import STOP
from refield.scene.capture import Capture

_BATCH = 32  # times the samples of a step on a CPU, where the photos hold enough for it
# Samples of a whole fit for each of its pixels, at most. Of 12 random worlds, 70 photos at 128 x 128, left-out photos
# have 29.7 dB with 456 samples a pixel, which learn noise by heart, 29.8 with 114, 30.2 with 57 in a thousand steps or
# more, 30.1 with 14; `fox` has 31.1 with 160, and with 32 in smaller tables 29.7
_PER_PIXEL = 100
# two sizes an octave: a step's room for samples is at least half full, and few graphs are captured
_SIZES = sorted([1 << k for k in range(9, 18)] + [3 << k for k in range(8, 16)])
_ROOM = 0.95  # of the samples' room is aimed at; what overflows is left out


def fit_on_gpu(
    model: HashField,
    capture: Capture,
    photos: Photos,
    config: FitConfig,
    told: tuple[ProgressCallback | None, StepCallback | None] = (None, None),
    clock: Compiling | None = None,
    how: tuple[Patience, bool] = (ENDLESS, False),
) -> Capture:
    """Fit a field to photos on the current CUDA device; the model comes back to where it was. Returns the capture with
    what the fit found out about its photos.

    As many steps as on a CPU, each of up to 32 times the samples. ``told``: who hears of looks, and of every 16th step.
    ``clock``: of the fit, which may have begun before this. ``how``: what it may be given up for; whether it goes on
    where another ended.

    Raises:
        StuckError: that patience ran out.
        NonFiniteError: the loss or its gradient was not finite for 20 steps in a row.
    """
    home, device = model.encoding.tables.device, torch.device("cuda", torch.cuda.current_device())
    known = photos.knowable(model.sampler).to(device), beside(model.sampler, photos.train).to(device)
    outside = stand_outside(model.contraction, photos.train)
    move(model, device)
    try:
        with torch.device(device):  # what is made in here without a device named is made on the GPU
            fit = _GpuFit(model, photos, config, (known, outside), told, clock, goes_on=how[1])
            fit.run(how[0])
            return fit.photos.told(capture, fit.judge, model)
    finally:
        move(model, home)


def move(model: HashField | NerfactoField, device: torch.device) -> None:
    """The field's parameters and its sampler to a device, in place."""
    model.to(device)
    space = model.sampler.contraction
    grid, fine = model.sampler.grid.to(device), model.sampler.fine
    space = Contraction(space.centre.to(device), space.radius)
    model.sampler = replace(model.sampler, contraction=space, grid=grid, fine=None if fine is None else fine.to(device))


class _GpuFit(Fitting):
    """The state of one run of :func:`fit_on_gpu`."""

    def __init__(
        self,
        model: HashField,
        photos: Photos,
        config: FitConfig,
        places: tuple[tuple[torch.Tensor, torch.Tensor], bool],
        told: tuple[ProgressCallback | None, StepCallback | None],
        clock: Compiling | None = None,
        goes_on: bool = False,
    ) -> None:
        """``places``: cells that are `Photos.knowable`, and those `beside` cameras; whether these `stand_outside`."""
        (allowed, near), outside = places
        device = model.encoding.tables.device
        with torch.device("cpu"):  # photos are read and posed there
            bank = photos.bank()
            brightness = bank.brightness
            self.pixels = DevicePixels(bank, device)
            del bank  # large
            judge = photos.judge()
        judge.move(device)
        learnt = PhotoModel(self.pixels, model.sampler, config.photos)
        super().__init__(model, (learnt, judge), config, told, clock, goes_on)
        self.distortion = config.distortion * brightness**2  # as `fit._Fit`
        self.occupancy = OccupancyTrainer(model, allowed=allowed, outside=outside, beside=near if outside else None)
        model.looking_where(allowed.to(torch.uint8).reshape(model.sampler.grid.shape))
        self.grid = model.sampler.grid.clone()  # the one that graphs read
        self.descent = Descent(model, networks=brightness)
        self.plain = not self.descent.networks[COLOUR_IN - 1][:, -DIRECTED:].any()
        self.capacity = _room(config, len(self.pixels))
        self.rays_per_step, self.coarseness = _SIZES[0], COARSEST
        self.finest_step = model.sampler.step
        self.nearness_now = torch.zeros((), device=device)

    def settle(self) -> None:
        self.occupancy.settle(self.pixels)
        self.model.sampler = self.model.sampler.for_pictures()

    def steps(self, patience: Patience) -> None:
        """All rounds of steps, each followed by what a graph cannot hold."""
        due = self.config.check_every
        graph, step = self._captured(0)
        while self.progress(step) < 1:
            stage = self.photos.stage(graph.progress)
            step = self._round(graph, step)
            samples = int(graph.samples)
            self.steps_done, self.samples_per_ray, loss = step, samples / self.rays_per_step, float(graph.loss)
            self.loss = loss if math.isfinite(loss) else self.loss
            if self.on_step:
                self.on_step(step, self.model)
            if int(self.descent.bad) >= MOST_SKIPPED:
                error = NonFiniteError(f"the loss or its gradient was not finite for {MOST_SKIPPED} steps in a row")
                error.steps = int(self.descent.count)
                raise error
            self.give_up_if_stuck(patience, within=EVERY)
            if step >= due:
                due += self.config.check_every
                self.look()
            if self._resized(samples) or self.photos.stage(self._expose(step)) != stage:
                graph, step = self._captured(step)

    def _round(self, graph: GraphedStep, step: int) -> int:
        """Steps up to the next update of the occupancy grid, and that."""
        graph.now.fill_(self.occupancy.rounds)
        for _ in range(EVERY - step % EVERY):
            self._set_pace(step)
            graph.replay()
            self._learn(graph, step)
            step += 1
            self.rays_done += self.rays_per_step
        if self.config.decay and step % FADE_EVERY == 0:
            self.descent.tables.detach().mul_(fading(self.config.decay, self._rate(step)))
        self.occupancy.renew(step - 1)
        self.grid.copy_(self.model.sampler.grid)
        return step

    def _captured(self, step: int) -> tuple[GraphedStep, int]:
        """The step for the present number of rays and lattice, captured; and the count of steps after its warm-up."""
        sampler = replace(self.model.sampler, step=self.finest_step * self.coarseness)
        self.model.sampler = sampler
        space = (sampler.contraction.centre, sampler.contraction.radius)
        nearness = self.nearness_now if self.config.nearness else 0.0
        aim = Aim(self.distortion, self.config.gradient_unit * space[1], STOP, nearness)
        where = (space, self.grid, sampler.lattice, self.model.encoding.resolutions)
        occupancy = (self.occupancy.state, DECAY)
        graph = GraphedStep(self.descent, self.photos, where, aim, occupancy, (self.rays_per_step, self.capacity))
        graph.progress = self._expose(step)
        graph.plain = self.plain and self.photos.plain(graph.progress)
        graph.now.fill_(self.occupancy.rounds)
        self._set_pace(step)
        return graph, step + graph.capture()

    def _expose(self, step: int) -> float:
        """How far the fit is; and find out, when that is due, whether photos are exposed alike."""
        progress = self.progress(step)
        self.may_expose(step, progress)
        return progress

    def _learn(self, graph: GraphedStep, step: int) -> None:
        """What a replay found goes to the photos; outside of the graph, since it solves equations."""
        assert graph.asked is not None and graph.found is not None
        progress = self.progress(step)
        self.photos.learn(graph.asked, graph.found, progress, self.rate_factor(progress))

    def _set_pace(self, step: int) -> None:
        """What changes from step to step, where graphs read it."""
        self.descent.rate.fill_(self._rate(step))
        self.nearness_now.fill_(self.nearness(self.progress(step)))

    def _rate(self, step: int) -> float:
        return self.config.rate * self.rate_factor(self.progress(step))

    def _resized(self, samples: int) -> bool:
        """Choose the rays of a step and the lattice anew, after a step with so many samples; whether either changed."""
        rays, coarseness = self.rays_per_step, self.coarseness
        per_ray, overfull = samples / rays, samples >= self.capacity
        if per_ray > self.config.samples_per_ray:
            self.coarseness = COARSEST
        elif per_ray < 0.75 * self.config.samples_per_ray / COARSEST:
            self.coarseness = 1.0
        per_ray *= coarseness / self.coarseness * (2 if overfull else 1)  # how many more there would be is not known
        fits = [n for n in _SIZES if n * per_ray <= _ROOM * self.capacity]
        wanted = fits[-1] if fits else _SIZES[0]
        # half an octave more is not worth a capture while this one is well filled; less is needed at once
        if overfull or wanted < rays or wanted > 1.4 * rays or self.coarseness != coarseness:
            self.rays_per_step = wanted
        return (self.rays_per_step, self.coarseness) != (rays, coarseness)


def _room(config: FitConfig, pixels: int) -> int:
    """For the samples of a step, of a fit to so many pixels; at least for the fewest rays while they are longest."""
    most = _PER_PIXEL * pixels / (config.steps * config.samples)
    least = int(_SIZES[0] * config.samples_per_ray / _ROOM)
    return max(round(config.samples * min(max(most, 1), _BATCH)), least)
