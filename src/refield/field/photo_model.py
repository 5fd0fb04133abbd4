"""What is found out about the photos while a field is fitted to them: how each was exposed, where it was taken, and
which parts of it show what no other photo does. All of it stands beside the field, none in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from refield.field.exposures import ExposureFit
from refield.field.kernels.reference import Batch, Stepped
from refield.field.photos import HeldOut
from refield.field.pixels import Pixels
from refield.field.poses import PoseFit
from refield.field.radiance import Field
from refield.field.sampling import OccupancySampler
from refield.field.trust import PhotoTrust
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.exposure import Exposure

_EXPOSED_FROM, _POSED_FROM, _TRUSTED_FROM = 0.15, 0.25, 0.1  # of a fit: what is asked of it must be there first
# So far into a fit that finds exposures, colours do not depend on where they are seen from: each photo has directions
# of its own, by which a field would learn its exposure. Longer costs it gloss that it then has no time to learn.
_PLAIN = 0.25
_PLACES = 16  # where rays end, a side of the contracted cube
_MOVING = 4  # every so-many-th ray tells how poses are wrong


@dataclass(frozen=True)
class PhotoModelConfig:
    """What a fit finds out about its photos."""

    exposures: bool | None = None
    """exposure and white balance of each photo, vignetting of each camera, where they differ; by default as the quality
    says, and not without one"""
    poses: bool = field(default=False, metadata={"usual": True})
    """where each photo was taken and what its lens is, too. A few pixels around what is given"""
    trust: bool = False
    """parts of single photos that show what no other does count for less"""


class Asked(NamedTuple):
    """A step's rays, and what the model has to remember of them until it hears what came of them."""

    batch: Batch
    pixels: Tensor
    owner: Tensor
    basis: Tensor | None
    patches: Tensor | None


class PhotoModel:
    """See the module."""

    def __init__(self, bank: Pixels, sampler: OccupancySampler, config: PhotoModelConfig) -> None:
        self.bank = bank
        frames = bank.frames
        middle = sampler.contraction.centre.cpu()
        distance = torch.stack([f.centre.float() - middle for f in frames]).norm(dim=-1).median()
        self._side = sampler.resolution
        self._across = min(_PLACES, self._side)
        places = self._across**3
        self.exposures = ExposureFit(frames, places) if config.exposures else None
        self.exposing = False
        """whether they are heeded; set by the fit, which knows photos that are left out"""
        self._asked_whether = False
        self.poses = PoseFit(frames, float(distance)) if config.poses else None
        self.trust = PhotoTrust(bank, places) if config.trust else None

    def may_expose(self, done: float) -> bool:
        """Whether now, once in a fit, is to be found out if the photos' exposures differ at all: gains of photos that
        were exposed alike would take up what the field does not show yet. ``done`` of the fit, in [0, 1]; the first
        steps take the longest, so its time runs ahead of what the field has learnt."""
        now = self.exposures is not None and not self._asked_whether and done >= _EXPOSED_FROM
        self._asked_whether |= now
        return now

    def plain(self, progress: float) -> bool:
        """Whether colours are not to depend on where they are seen from yet, lest the field learn the exposures."""
        if self.exposures is None:
            return False
        return progress < _PLAIN if self.exposing else not self._asked_whether

    def stage(self, progress: float) -> tuple[bool, ...]:
        """What of all this is asked of a step, at ``progress`` of the fit: steps of one stage are alike."""
        trusting, posing = self.trust is not None, self.poses is not None
        heeded = trusting and progress >= _TRUSTED_FROM, posing and progress >= _POSED_FROM
        return self.exposing, self.plain(progress), *heeded

    def ask(self, pixels: Tensor, progress: float) -> Asked:
        """Rays of pixels (N,) as they stand, with the photos' gains and trust; ``progress`` of the fit in [0, 1]."""
        bank, n = self.bank, len(pixels)
        owner = bank.frame_of(pixels)
        if self.poses is None:
            rays = bank.rays(pixels)
        else:
            rays = self.poses.rays(owner, bank.camera_directions(pixels, owner))
        gains = basis = patches = trust = None
        if self.exposures is not None and self.exposing:
            basis = bank.vignetting_basis(pixels, owner)
            gains = self.exposures.gains(owner, basis)
        if self.trust is not None and progress >= _TRUSTED_FROM:
            patches = self.trust.patches(pixels, owner)
            trust = self.trust.trust[patches]
        moving = n // _MOVING if self.poses is not None and progress >= _POSED_FROM else 0
        # what stays transparent is shown noise, so that only opaque surfaces explain the photos
        lines = (rays.origins, rays.directions, torch.rand(n, device=pixels.device))
        background = torch.rand(n, 3, device=pixels.device)
        batch = Batch(lines, bank.colours(pixels), background, gains, trust, moving)
        return Asked(batch, pixels, owner, basis, patches)

    def learn(self, asked: Asked, done: Stepped, progress: float, rate: float) -> None:
        """Take in what a step found; ``rate`` in [0, 1] falls as the fit's."""
        batch, owner = asked.batch, asked.owner
        if self.exposures is not None and asked.basis is not None:
            assert batch.gains is not None and done.shown is not None and done.errors is not None
            weight = 1.0 if batch.trust is None else batch.trust[:, None].sqrt()
            seen, errors = weight * batch.gains * done.shown, weight * done.errors
            self.exposures.learn(owner, asked.basis, seen, errors, self._surface(done), rate)
        if self.poses is not None and batch.moving:
            self.poses.learn(owner, batch, done, rate)
        if self.trust is not None and asked.patches is not None:
            assert done.errors is not None
            self.trust.learn(asked.patches, self._surface(done), done.errors)

    def _surface(self, done: Stepped) -> Tensor:
        """The place where each ray ends, (N,); -1: nowhere."""
        assert done.heaviest is not None
        if not len(done.cells):
            return torch.full_like(done.heaviest, -1)
        cell, side = done.cells[done.heaviest.clamp_min(0)], self._side
        across = self._across
        i, j, k = (x * across // side for x in (cell // (side * side), cell // side % side, cell % side))
        return torch.where(done.heaviest >= 0, (i * across + j) * across + k, -1)

    def inform(self, judge: HeldOut) -> None:
        """Tell the judge what has become known of the cameras."""
        if not self.exposing and self.poses is None:
            return
        lenses = self._lenses()
        fallen = [self._vignetting(f.camera) for f in judge.frames]
        judge.learn([lenses.get(f.camera, f.camera) for f in judge.frames], torch.tensor(fallen).reshape(-1, 3))

    def told(self, capture: Capture, judge: HeldOut, field: Field) -> Capture:
        """The capture with what was found: poses and lenses of its training frames, lenses of those that were held
        out, exposures of both."""
        self.inform(judge)
        found = {f.name: f for f in self._training()}
        lenses = self._lenses()
        gains = judge.gains(field).tolist() if self.exposing else []
        for i, frame in enumerate(judge.frames):
            exposure = frame.exposure
            if i < len(gains):
                exposure = Exposure(tuple(gains[i]), self._vignetting(frame.camera)).on(frame.exposure)
            found[frame.name] = replace(frame, camera=lenses.get(frame.camera, frame.camera), exposure=exposure)
        return replace(capture, frames=tuple(found[f.name] for f in capture.frames))

    def _lenses(self) -> dict[Camera, Camera]:
        return {} if self.poses is None else self.poses.lenses()

    def _vignetting(self, camera: Camera) -> tuple[float, float, float]:
        return (0.0, 0.0, 0.0) if self.exposures is None else self.exposures.of_camera(camera)

    def _training(self) -> tuple[Frame, ...]:
        frames = self.bank.frames if self.poses is None else self.poses.found()
        if self.exposures is None or not self.exposing:
            return frames
        return tuple(replace(f, exposure=e.on(f.exposure)) for f, e in zip(frames, self.exposures.found()))
