"""The Field seam: what a radiance field is to everything else. (Eq. 1's F: (x, d) -> (sigma, c).)"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

from refield.field.volrend import Samples
from refield.scene.capture import Rays


class Sampler(Protocol):
    """Proposes where along each ray the field may be non-empty."""

    def __call__(self, rays: Rays, jitter: bool = False) -> Samples:
        """Packed samples; ``jitter`` moves each ray's lattice by a random part of a step (training)."""
        ...


@runtime_checkable
class Field(Protocol):
    """Density and colour anywhere in the world, and a sampler that knows where to look.

    An updated field is a Field too: it renders, is viewed, saved and updated again with no new code.
    """

    @property
    def sampler(self) -> Sampler: ...

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        ...

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3) and unit directions (..., 3) -> sigma (...,) and rgb (..., 3) in [0, 1]."""
        ...
