"""Where to look along a ray: an occupancy grid over contracted space."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from refield.field import kernels
from refield.field.encoding import Contraction
from refield.field.kernels.masks import marked, part_of
from refield.field.kernels.onward import Span
from refield.field.kernels.reference import DensityNet, Lattice, Rays3, Space, Within
from refield.field.volrend import Samples
from refield.scene.capture import Rays

RESOLUTION = 128  # cells a side of the occupancy grid
IN_PICTURES = 1.5  # samples a step
STOP = 7.0  # optical depth at which a ray ends: e^-7 is a thousandth


@dataclass(frozen=True, repr=False)
class OccupancySampler:
    """Samples on a regular lattice along the ray, kept where the grid says that something may be."""

    contraction: Contraction
    grid: Tensor
    """(R, R, R) uint8 over the contracted cube; 0 is empty"""
    step: float
    """world units within the core cube; grows as the distance to the power of 1.5 outside it"""
    near: float = 0.0
    """world units"""
    far: float = 1e3
    """in radii of the core cube"""
    fine: Tensor | None = None
    """(R, R, R) int64: which parts of occupied cells may hold something, see `kernels.masks.marked`; 0, or None for all
    of them, where nothing so fine is known. Whoever lets something new into a cell has to set its mask to 0."""
    per_step: float = 1.0
    """samples a step; a step is as long as surfaces are thick"""

    @property
    def resolution(self) -> int:
        return self.grid.shape[0]

    def __repr__(self) -> str:
        return f"OccupancySampler({'; '.join(f'{name} {value}' for name, value in self.facts())})"

    def facts(self) -> list[tuple[str, object]]:
        """What to tell a person of it."""
        least = 1e-6 * self.contraction.radius
        at = ", ".join(f"{v if abs(v) > least else 0:.4g}" for v in self.contraction.centre.tolist())
        full = 100 * float((self.grid > 0).float().mean())
        where = f"({at}), {self.contraction.radius:.4g} to each side"
        return [("core around", where), ("occupied", f"{full:.2g} % of {self.resolution}³ cells")]

    def __call__(self, rays: Rays, jitter: bool = False) -> Samples:
        """Packed samples of N rays; see `Samples`."""
        with torch.no_grad():
            return Samples(*kernels.march(*self._question(rays, jitter), self.fine))

    def visible(self, rays: Rays, net: DensityNet, jitter: bool = False, stop: float = STOP) -> Samples:
        """As a call, but nothing behind the sample where the optical depth passes ``stop``."""
        with torch.no_grad():
            return Samples(*kernels.march_visible(*self._question(rays, jitter), net, stop, self.fine))

    def within(self, rays: Rays, net: DensityNet, within: Within) -> tuple[Samples, Tensor]:
        """As `visible`, but only of the samples that are ``within``; and their densities (S,)."""
        with torch.no_grad():
            t0, t1, sigmas, offsets = kernels.march_within(*self._question(rays, False), net, STOP, self.fine, within)
            return Samples(t0, t1, offsets), sigmas

    def onward(self, rays: Rays, span: Span, most: int) -> tuple[Tensor, Tensor, Tensor]:
        """The next samples of N rays, ``most`` of each: see `kernels.next_samples`."""
        with torch.no_grad():
            lines, space, grid, lattice = self._question(rays, False)
            return kernels.next_samples(lines, space, grid, lattice, span, most, self.fine)

    def first(self, rays: Rays, enter: Tensor, leave: Tensor) -> Tensor:
        """Where the first sample of each of N rays begins, of those from ``enter`` to ``leave`` (N,), and perhaps some
        beside them; (N,), infinite where there is none."""
        return self.onward(rays, (torch.full_like(enter, self.near), enter, leave), 1)[0][:, 0]

    def _question(self, rays: Rays, jitter: bool) -> tuple[Rays3, Space, Tensor, Lattice]:
        n = len(rays)
        shift = torch.rand(n, device=rays.origins.device) if jitter else rays.origins.new_zeros(n)
        space = (self.contraction.centre, self.contraction.radius)
        return (rays.origins, rays.directions, shift), space, self.grid, self.lattice

    @property
    def lattice(self) -> Lattice:
        """near, far and length of a sample in the core, world units."""
        return self.near, self.far * self.contraction.radius, self.step / self.per_step

    def for_pictures(self) -> OccupancySampler:
        """The same with shorter samples. Where a fit's samples lie is drawn anew for each ray, and what it learns is
        right for their mean; a picture with one of a ray's draws has the noise of that (see docs/results.md)."""
        return replace(self, per_step=IN_PICTURES)

    def cells(self, x: Tensor) -> Tensor:
        """Flat index of the grid cell that holds each world point, (..., 3) -> (...,) int64."""
        return self.places(x)[0]

    def places(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The grid cell (flat index) that holds each world point, and which of its 64 parts; (..., 3) -> (...,) int64
        each."""
        r = self.resolution
        quarter = ((self.contraction(x) + 2) * (r / 4) * 4).long().clamp_(0, 4 * r - 1)
        i, j, k = (quarter >> 2).unbind(-1)
        return (i * r + j) * r + k, part_of(quarter)

    def occupied(self, x: Tensor) -> Tensor:
        """Whether the sampler would look at world points (..., 3) -> (...,) bool."""
        places = (self.contraction(x.reshape(-1, 3)) + 2) * (self.resolution / 4)
        return marked(places, self.grid, self.fine).reshape(x.shape[:-1])

    def step_at(self, cells: Tensor) -> Tensor:
        """Length of a step in the given cells (K,), world units (K,)."""
        return self.step * self.distance(cells).clamp_min(1.0) ** 1.5

    def distance(self, cells: Tensor) -> Tensor:
        """L-infinity distance of the given cells' centres from the core's, in core radii, (K,) -> (K,)."""
        m = self._contracted(cells, None).abs().amax(-1)
        return torch.where(m > 1, 1 / (2 - m).clamp_min(1e-3), m)

    def width(self, reach: Tensor) -> Tensor:
        """Side of a cell, world units, ``reach`` core radii (any shape) from the core's centre."""
        # the contraction makes cells outside of the core as much larger as their distance squared
        return 4 * self.contraction.radius / self.resolution * reach.clamp_min(1.0) ** 2

    def points_in(self, cells: Tensor, jitter: bool = True, draw: torch.Generator | None = None) -> Tensor:
        """A world point in each cell: random, of ``draw`` if given, or its centre. (K,) -> (K, 3)."""
        offset = torch.rand(len(cells), 3, device=cells.device, generator=draw) if jitter else None
        return self.contraction.inverse(self._contracted(cells, offset))

    def _contracted(self, cells: Tensor, offset: Tensor | None) -> Tensor:
        r = self.resolution
        ijk = torch.stack([cells // (r * r), cells // r % r, cells % r], -1).float()
        return (ijk + (0.5 if offset is None else offset)) * (4 / r) - 2

    def refreshed(
        self,
        density: Callable[[Tensor], Tensor],
        boxes: Iterable[Tensor],
        threshold: float = 1e-2,
        probes: int = 8,
    ) -> OccupancySampler:
        """The same sampler with the cells that touch the world boxes (2, 3) looked up anew in ``density``.

        A cell is occupied if at one of ``probes`` points a step would have an opacity above ``threshold``: of many,
        since a moved surface crosses cells at any angle. They are always the same. Of the cells' parts nothing is known
        any more.
        """
        grid, fine = self.grid.clone(), None if self.fine is None else self.fine.clone()
        for box in boxes:
            cells = self.cells_in(box)
            grid.view(-1)[cells] = self._probe(density, cells, threshold, probes)
            if fine is not None:
                fine.view(-1)[cells] = 0
        return replace(self, grid=grid, fine=fine)

    def _probe(self, density: Callable[[Tensor], Tensor], cells: Tensor, threshold: float, probes: int) -> Tensor:
        found = torch.zeros(len(cells), dtype=torch.bool, device=cells.device)
        length, draw = self.step_at(cells), torch.Generator(cells.device).manual_seed(0)
        with torch.no_grad():
            for i in range(probes):
                x = self.points_in(cells, jitter=i > 0, draw=draw)
                found |= density(x) * length > -torch.log1p(torch.tensor(-threshold))
        return found.to(self.grid.dtype)

    def cells_in(self, box: Tensor) -> Tensor:
        """Flat indices of the cells whose contracted extent meets a world box (2, 3), one cell of margin."""
        r = self.resolution
        corners = torch.cartesian_prod(*torch.as_tensor(box, dtype=torch.float32, device=self.grid.device).T)
        y = (self.contraction(corners) + 2) * (r / 4)
        lo, hi = (y.amin(0) - 1).long().clamp(0, r - 1), (y.amax(0) + 1).long().clamp(0, r - 1)
        axes = [torch.arange(int(a), int(b) + 1, device=self.grid.device) for a, b in zip(lo, hi)]
        i, j, k = torch.meshgrid(*axes, indexing="ij")
        return ((i * r + j) * r + k).reshape(-1)

    @staticmethod
    def from_density(
        density: Callable[[Tensor], Tensor], contraction: Contraction, step: float, resolution: int = RESOLUTION
    ) -> OccupancySampler:
        """Look the whole world up in ``density``."""
        empty = torch.zeros(resolution, resolution, resolution, dtype=torch.uint8)
        sampler = OccupancySampler(contraction, empty, step)
        everything = torch.arange(resolution**3)
        found = [sampler._probe(density, c, 1e-2, 4) for c in everything.split(1 << 18)]
        return replace(sampler, grid=torch.cat(found).reshape(empty.shape))
