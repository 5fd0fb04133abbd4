"""The one training loop of our fields: photos with poses → a field (§10.1.1)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Generic, Literal, TypeVar

import torch

from refield.field import kernels
from refield.field.attempts import ASKED, ENDLESS, Attempts, Patience, StuckError
from refield.field.compiling import Compiling, compiling
from refield.field.coverage import beside
from refield.field.descent import NonFiniteError, TableAdam
from refield.field.encoding import Contraction
from refield.field.kernels.reference import Aim
from refield.field.occupancy import OccupancyTrainer
from refield.field.photo_model import PhotoModel, PhotoModelConfig
from refield.field.photo_size import PhotoSizeConfig, as_read, at_full_size
from refield.field.photos import UNCHANGED, HeldOut, Photos, Since
from refield.field.placing import COLOUR_IN, DIRECTED, around, new_field, opened, place_contraction, stand_outside
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.sampling import STOP
from refield.field.schedule import rate_factor
from refield.scene.capture import Capture, check_capture
from refield.scene.errors import InputError, expect


@dataclass(frozen=True)
class FitConfig:
    """Pre-training."""  # §10.1.1

    steps: int = 2000
    """of gradient descent"""
    max_seconds: float | None = field(default=None, metadata={"usual": True})
    """stop after so long. The learning rate follows whichever of steps and seconds is further on; compiling is free"""
    photo_memory: float | None = None
    """GB for the photos' pixels. Of more than fit, a part is kept, drawn from every photo alike"""
    device: Literal["cpu", "cuda"] = field(default="cpu", metadata={"usual": True})
    """where the fit runs. The field comes back to the CPU"""
    samples: int = 8192
    """a step; the rays follow from how many samples each needs, and behind the first surface it needs none"""
    samples_per_ray: float = 40
    """the lattice along the ray is made coarser, up to 1.5 times, while a ray needs more than this"""
    rate: float = 2e-2
    """Adam's learning rate, held for the first half, then brought down to a thirtieth; of dim photos in the networks
    times `PixelBank.brightness`, lest their colours run to black and stay so"""
    decay: float | None = None
    """of the tables' entries, times the learning rate; by default as the quality says, none without one"""
    distortion: float = 1e-2
    """weight of the distortion loss; without it fog fills the grid. Of dim photos less, as their squared errors
    of colour are: times the square of `PixelBank.brightness`"""
    nearness: float | None = None
    """weight, times that of the distortion, of how near to the camera light ends; it falls to none over the first 0.4
    of a fit, and is none in a fit that begins from a field. Haze before what is plain gathers where 1/2 + nearness/4 of
    the light has ended; where half of it has, plain walls and floors may end up before the cameras. With it, what few
    photos show may sink away behind itself. By default none, or 0.3 where left-out photos say early on that they are
    shown better so; 0: never"""
    gradient_unit: float = 1.0
    """gradient scaling reaches 1 at this many core radii from the camera"""  # §10.1
    directions: bool = True
    """let colours depend on the direction from which they are seen"""
    photos: PhotoModelConfig = field(default_factory=PhotoModelConfig)
    """what is found out about the photos, beside the field"""
    size: PhotoSizeConfig = field(default_factory=PhotoSizeConfig)
    """at which the photos are read"""
    field: HashFieldConfig = field(default_factory=HashFieldConfig)
    """shape of the field"""
    finest_auto: bool = True
    """choose ``field.finest`` from the photos' resolution"""
    check_every: int = 250
    """steps between looks at the held-out pixels"""
    look_around: bool | None = None
    """fit a small field first, so that the core takes in what the photos show; by default as the quality says, not
    without one"""
    sharpen: bool | None = None
    """leave out, in training, the parts of cells that are no more than haze: surfaces become sharp and rays short. Of
    few or small photos it makes a field that knows them by heart; by default as the quality says, not without one"""
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


_FIRST = 0.1  # of its time, in which only steps tell how far it is
_FORMING = 0.4  # of its time, in which a fit decides how far away things are


_Field = TypeVar("_Field")


@dataclass(frozen=True)
class Fitted(Generic[_Field]):
    """A field, and what became known of the photos that it was fitted to."""

    field: _Field
    capture: Capture
    """with the photos' exposures, poses and lenses as the fit found them, where it was to find them"""


ProgressCallback = Callable[[FitProgress], None]
StepCallback = Callable[[int, HashField], None]
"""Hears how many steps are done and the field as they left it, in training; it is not to change it."""
COARSEST = 1.5  # times the final step along the ray


def fit_field(
    capture: Capture,
    config: FitConfig = FitConfig(),
    on_progress: ProgressCallback | None = None,
    *,
    since: Since = UNCHANGED,
    start: HashField | None = None,
    on_step: StepCallback | None = None,
) -> HashField:
    """Fit a field to a capture's training photos, from random weights or on from ``start``.

    ``on_progress`` hears each look at the held-out pixels. This is the field of what `fit_capture` gives; see there for
    the rest and for what it raises.
    """
    return fit_capture(capture, config, on_progress, since=since, start=start, on_step=on_step).field


def fit_capture(
    capture: Capture,
    config: FitConfig = FitConfig(),
    on_progress: ProgressCallback | None = None,
    *,
    since: Since = UNCHANGED,
    start: HashField | None = None,
    goes_on: bool = False,
    on_step: StepCallback | None = None,
) -> Fitted[HashField]:
    """Fit a field to the capture's training frames.

    Args:
        on_progress: called at each look at the held-out pixels.
        since: newer photos to learn from as well, and pixels of the capture that are out of date.
        start: a field whose weights are trained on, in its own shape and place; its occupancy is found anew. It is
            not changed. By default the weights are random.
        on_step: called after every step.

    Raises:
        ValueError: no frame, or no pixel, to train on.
        InputError: a GPU is wanted and there is none.
        NonFiniteError: the loss or its gradient was not finite for 20 steps in a row; it holds the last good state.
    """
    check_capture(capture)
    expect("the config of a fit", config, FitConfig, "a refield.field.fit.FitConfig")
    capture, since = as_read(capture, since, config.size)
    on_gpu = config.device == "cuda"
    fit = _fit_on_cpu
    if on_gpu:
        _check_gpu(config, since)
        from refield.field.gpu_fit import fit_on_gpu

        fit = fit_on_gpu
    with compiling(triton=on_gpu) as clock:
        photos = Photos.of(capture, since, most_pixels(config))
        core = _core(capture, config) if start is None and config.look_around else None
        # a field that is begun from knows how far away things are
        attempts = Attempts(config.nearness if start is None else 0.0, config.steps, may_give_up=start is None)
        while True:
            seed = config.seed + attempts.seed
            torch.manual_seed(seed)
            model = new_field(capture, config, seed, core) if start is None else opened(start)
            tried, told = replace(config, nearness=attempts.nearness), (on_progress, on_step)
            try:
                found = fit(model, capture, photos, tried, told, clock, (attempts.patience, goes_on))
                break
            except StuckError as error:
                attempts.give_up(error)
            except NonFiniteError as error:
                error.field = model.eval().requires_grad_(False)
                raise
    return Fitted(model.eval().requires_grad_(False), at_full_size(found))


def _fit_on_cpu(
    model: HashField,
    capture: Capture,
    photos: Photos,
    config: FitConfig,
    told: tuple[ProgressCallback | None, StepCallback | None],
    clock: Compiling,
    how: tuple[Patience, bool],
) -> Capture:
    """As `gpu_fit.fit_on_gpu`."""
    run = _Fit(model, photos, config, *told, clock, goes_on=how[1])
    run.run(how[0])
    return run.photos.told(capture, run.judge, model)


# Enough to tell how far away things are: twice as many steps tell the same or up to a third more
_FIRST_LOOK = FitConfig(steps=150, samples=4096, check_every=1000, field=HashFieldConfig(log2_table=14))
_LOOKED_AT = 1e6  # pixels


def _core(capture: Capture, config: FitConfig) -> Contraction:
    """Where the core goes, going by a first look at the photos, or, where that leads nowhere, by the cameras alone."""
    core, frames = place_contraction(capture), capture.train
    pixels = sum(f.camera.width * f.camera.height for f in frames)
    look = replace(_FIRST_LOOK, size=PhotoSizeConfig(min((_LOOKED_AT / pixels) ** 0.5, 1.0)), device=config.device)
    on_gpu = config.device == "cuda"
    if on_gpu:  # of the shape that kernels are compiled for anyway
        look = replace(look, field=replace(config.field, log2_table=look.field.log2_table))
    try:
        first = fit_field(Capture(frames, capture.points, 0), look)
    except NonFiniteError:
        return core
    if on_gpu:
        from refield.field.gpu_fit import move

        move(first, torch.device("cuda"))
    return around(core, first, frames)


def _check_gpu(config: FitConfig, since: Since) -> None:
    """Raises InputError: there is no GPU, or it cannot fit so."""
    need_device(config.device)
    if not config.directions or since.share is not None:
        raise InputError("device cuda", "draws all pixels alike, in colours that depend on the direction", "fit on cpu")


def need_device(device: str) -> None:
    """Raises InputError: it is not there."""
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda", "torch finds no CUDA GPU on this machine", "leave the option out")


def most_pixels(config: FitConfig) -> int | None:
    """How many pixels are kept of photos that do not fit into ``photo_memory``: 3 bytes each, and 4 for its place."""
    return None if config.photo_memory is None else max(int(config.photo_memory * 1e9 / 7), 1)


class Fitting:
    """What a fit's loop knows, on whatever device: how far it is, how it goes, whether it leads anywhere."""

    def __init__(
        self,
        model: HashField,
        parts: tuple[PhotoModel, HeldOut],
        config: FitConfig,
        told: tuple[ProgressCallback | None, StepCallback | None],
        clock: Compiling | None = None,
        goes_on: bool = False,
    ) -> None:
        """``parts``: what is learnt of the photos, and the judge; ``told``: who hears of looks and of steps."""
        self.model, self.config, self.goes_on = model, config, goes_on
        self.photos, self.judge = parts
        self.on_progress, self.on_step = told
        self.clock = clock or Compiling()
        self.loss = math.nan
        self.first: tuple[float, float] | None = None
        """dB of the photos that are left out, and of the loss on those that teach, when first asked"""
        self.rays_done, self.steps_done = 0, 0
        self.samples_per_ray = math.nan
        """of late"""

    def steps(self, patience: Patience) -> None:
        """Raises StuckError early on if its ``patience`` runs out."""
        raise NotImplementedError

    def settle(self) -> None:
        """The field as it is shown from now on."""
        raise NotImplementedError

    def run(self, patience: Patience = ENDLESS) -> None:
        """Raises StuckError early on if its ``patience`` runs out."""
        self.model.train()
        try:
            self.steps(patience)
        except NonFiniteError:
            self.settle()
            raise
        self.settle()
        self.look()

    def progress(self, step: int) -> float:
        return progress_of(self.config, step, self.clock.worked)

    def rate_factor(self, progress: float) -> float:
        """Of the learning rate; of a fit that goes on as in the second half of one that begins."""
        return rate_factor((1 + progress) / 2 if self.goes_on else progress)

    def nearness(self, progress: float) -> float:
        """What it weighs how near light ends."""
        return (self.config.nearness or 0.0) * max(1 - progress / _FORMING, 0.0)

    def may_expose(self, step: int, progress: float) -> None:
        """Find out, when that is due, whether photos are exposed alike."""
        if self.photos.may_expose(max(step / self.config.steps, progress / 2)):
            self.photos.exposing = self.judge.tells_exposures(self.model)
            self.model.train()

    def give_up_if_stuck(self, patience: Patience, within: int = 1) -> None:
        """Raises StuckError: its ``patience`` ran out, and there is time to begin anew. Asked in every step, or in
        one of ``within``."""
        step = next((s for s in ASKED if 0 <= self.steps_done - s < within), None)
        if step is None or patience == ENDLESS or patience.is_late(step, self._once_worked):
            return
        now = self.judge.psnr(self.model, self.photos.exposing), -10 * math.log10(max(self.loss, 1e-12))
        self.model.train()
        if self.first is None:
            self.first = now
        elif patience.ends(step, now[0], (now[0] - self.first[0], now[1] - self.first[1])):
            raise StuckError(now[0], step)

    def _once_worked(self, times: float) -> float:
        """How far the fit is by its time alone, once it worked so many times as long as now."""
        return progress_of(self.config, 0, times * self.clock.worked)

    def look(self) -> None:
        """Tell how the fit goes, where somebody listens."""
        if self.on_progress is None:
            return
        self.photos.inform(self.judge)
        psnr = self.judge.psnr(self.model, self.photos.exposing)
        self.model.train()
        worked, step = self.clock.worked, self.steps_done
        left, seconds = seconds_left(self.config, step, worked), worked + self.clock.seconds
        speed = self.rays_done / seconds
        self.on_progress(FitProgress(step, self.config.steps, psnr, speed, self.samples_per_ray, seconds, left))


class _Fit(Fitting):
    """The state of one run of :func:`fit_field`."""

    def __init__(
        self,
        model: HashField,
        photos: Photos,
        config: FitConfig,
        on_progress: ProgressCallback | None,
        on_step: StepCallback | None,
        clock: Compiling | None = None,
        goes_on: bool = False,
    ) -> None:
        self.taught, self.pixels = photos, photos.bank()
        learnt = PhotoModel(self.pixels, model.sampler, config.photos)
        super().__init__(model, (learnt, photos.judge()), config, (on_progress, on_step), clock, goes_on)
        brightness = self.pixels.brightness
        self.distortion = config.distortion * brightness**2  # errors of colour are as much less
        self.adam = TableAdam(model, config.decay or 0.0, networks=brightness)
        if not config.directions:
            self.adam.parameters[COLOUR_IN].detach()[:, -DIRECTED:] = 0
        self.plain = not self.adam.parameters[COLOUR_IN][:, -DIRECTED:].any()
        allowed, outside = photos.knowable(model.sampler), stand_outside(model.contraction, photos.train)
        near = beside(model.sampler, photos.train) if outside else None
        self.occupancy = OccupancyTrainer(model, allowed=allowed, outside=outside, beside=near)
        model.looking_where(self.occupancy.allowed.to(torch.uint8).reshape(model.sampler.grid.shape))
        self.rays_per_step = 512
        self.samples_per_ray = config.samples / 512
        self.finest_step, self.coarseness = model.sampler.step, 1.0
        self._set_coarseness(COARSEST)

    def settle(self) -> None:
        self.occupancy.settle(self.pixels)
        self.model.sampler = self.model.sampler.for_pictures()

    def steps(self, patience: Patience) -> None:
        for step in range(self.config.steps):
            progress = self.progress(step)
            if progress >= 1:
                break
            self._step(step, progress)
            self.steps_done = step + 1
            if self.on_step:
                self.on_step(step + 1, self.model)
            self.give_up_if_stuck(patience)
            if (step + 1) % self.config.check_every == 0:
                self.look()

    def _step(self, step: int, progress: float) -> None:
        self.may_expose(step, progress)
        n = self.rays_per_step
        asked = self.photos.ask(self.taught.drawn(self.pixels, n), progress)
        model, sampler = self.model, self.model.sampler
        space = (sampler.contraction.centre, sampler.contraction.radius)
        aim = Aim(self.distortion, self.config.gradient_unit * space[1], STOP, self.nearness(progress))
        field = (model.encoding.tables, model.encoding.resolutions, model.networks)
        where = (space, sampler.grid, sampler.lattice)
        done = kernels.train_step(asked.batch, *where, field, aim, self.adam.grads, fine=sampler.fine)
        rate = self.rate_factor(progress)
        if not self.config.directions or (self.plain and self.photos.plain(progress)):
            self.adam.grads[COLOUR_IN][:, -DIRECTED:] = 0
        if self.adam.step(self.config.rate * rate, done.loss):
            self.loss = done.loss if math.isnan(self.loss) else self.loss + 0.03 * (done.loss - self.loss)
            parts = done.parts if self.config.sharpen else None
            self.occupancy.observe(step, done.cells, done.weights, done.sigmas, parts)
            self.photos.learn(asked, done, progress, rate)
        self._resize(n, len(done.weights))

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
        self.model.sampler = replace(self.model.sampler, step=self.finest_step * to)


def progress_of(config: FitConfig, step: int, seconds: float) -> float:
    """How far a fit is, 1 at its end: by its steps or by the seconds that it works, whichever is further on.

    The first seconds do not count, so that a fit which ends long before its time is the same on any machine: the first
    steps take the longest.
    """
    part = seconds / config.max_seconds if config.max_seconds else 0.0
    return max(step / config.steps, (part - _FIRST) / (1 - _FIRST))


def seconds_left(config: FitConfig, step: int, seconds: float) -> float:
    """Until a fit ends that has done so many steps in so many seconds, if it goes on like that."""
    by_steps = seconds * (config.steps / max(step, 1) - 1)
    return max(min(by_steps, (config.max_seconds or math.inf) - seconds), 0.0)
