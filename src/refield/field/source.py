"""An object as a field was first fitted to it, however often it moved since: every later state looks it up there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from torch import Tensor

from refield.field.outlook import Outlook
from refield.field.radiance import Field
from refield.field.sampling import OccupancySampler
from refield.scene.change import OccupancyGrid
from refield.scene.pose import invert, transform


class Light(Protocol):
    """What changed the colours of surfaces."""

    def applied(self, x: Tensor, rgb: Tensor) -> Tensor:
        """World points (S, 3), colours (S, 3) -> colours in the new light (S, 3) in [0, 1]."""


@dataclass(frozen=True)
class Source:
    """A Field of the place where an object first was, in the light in which it is now; not to be asked outside of its
    grid."""

    field: Field
    """holds the object"""
    grid: OccupancyGrid
    """the object there, with the skin that it takes along"""
    now_from_then: Tensor
    """(4, 4) float64, all its moves since"""
    outlook: Outlook | None
    """the directions along which it may be asked"""
    lights: tuple[tuple[Tensor, Light], ...] = ()
    """The light that changed since, each with the motion (4, 4) that brings the object to where it changed"""

    @cached_property
    def then_from_now(self) -> Tensor:
        """(4, 4) float64"""
        return invert(self.now_from_then)

    @property
    def sampler(self) -> OccupancySampler:
        """Looks where the field's does."""
        return self.field.sampler

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        return self.field.density(x)

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (S, 3) and unit directions (S, 3) -> sigma (S,) and rgb (S, 3) in [0, 1]."""
        sigma, rgb = self.field(x, d if self.outlook is None else self.outlook.held(x, d))
        for pose, light in self.lights:
            rgb = light.applied(transform(pose, x), rgb)
        return sigma, rgb


@dataclass(frozen=True)
class Known:
    """An object that an earlier visit found."""

    grid: OccupancyGrid
    """where it is"""
    source: Source | None = None
    """where it is looked up, if nothing of it was learnt since"""
