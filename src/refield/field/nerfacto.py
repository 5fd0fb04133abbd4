"""The NeRFacto shape: a large hash field that is looked at where two small ones propose (§10.1).

This is what the paper's experiments use, nerfstudio's default without camera optimiser and appearance embedding. It
shares the world, the contraction and the kernels with `HashField` and nothing of how rays are sampled. Letters: S
points, N rays, K intervals a ray.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from refield.field import kernels
from refield.field.encoding import Contraction, geometric_levels
from refield.field.kernels.reference import truncated_exp
from refield.field.networks import HashNetwork, weight
from refield.field.proposal import Density, Histogram, Inside, Plan, Span, emptied, propose
from refield.field.sampling import OccupancySampler
from refield.field.stored import State, read_field, sampler_from, state_of, write_field
from refield.field.volrend import Samples
from refield.scene.capture import Rays
from refield.scene.files import AnyPath, as_path
from refield.scene.notebook import facts


@dataclass(frozen=True)
class ProposalConfig:
    """Shape of one proposal network, and how often it is asked."""

    samples: int
    """intervals a ray"""
    finest: int
    """cells a side of the contracted cube on the finest level"""
    coarsest: int = 16
    """cells a side on the coarsest level"""
    levels: int = 5
    """of the hash grid"""
    log2_table: int = 17
    """entries of a level's table"""
    width: int = 16
    """of the hidden layer"""


@dataclass(frozen=True)
class NerfactoConfig:
    """Shape of a `NerfactoField`."""

    proposals: tuple[ProposalConfig, ...] = (ProposalConfig(256, 128), ProposalConfig(96, 256))
    """the proposal networks, in the order in which they are asked"""
    samples: int = 48
    """intervals a ray at which the field itself is asked"""
    near: float = 0.05
    """where rays begin, core radii"""
    far: float = 1000.0
    """where they end, core radii"""
    levels: int = 16
    """of the field's hash grid"""
    coarsest: int = 16
    """cells a side of the contracted cube on the coarsest level"""
    finest: int = 2048
    """cells a side on the finest level"""
    log2_table: int = 19
    """entries of a level's table"""
    width: int = 64
    """of all hidden layers but the proposals'"""
    geometry_features: int = 15
    """handed from the density to the colour network"""
    first_density: float = 0.01
    """per core radius, where the networks say nothing yet; low, so that light gets through from the start"""
    occupancy: int = 128
    """cells a side of the occupancy grid for those who march through the field instead of proposing"""
    step: float = 1 / 192
    """length of a sample for them, core radii"""


class NerfactoField(nn.Module):
    """Hash grid → density network → colour network, and the proposal networks that know where to ask it."""

    def __init__(self, config: NerfactoConfig, sampler: OccupancySampler, seed: int = 0) -> None:
        super().__init__()
        g = torch.Generator().manual_seed(seed)
        self.config, self.sampler = config, sampler
        w, k = config.width, config.geometry_features
        levels = geometric_levels(config.coarsest, config.finest, config.levels)
        self.trunk = HashNetwork(levels, config.log2_table, (w, 1 + k), g)
        self.colour_in = weight(w, k + 16, g)
        self.colour_mid = weight(w, w, g)
        self.colour_out = weight(3, w, g)
        shapes = ((p, geometric_levels(p.coarsest, p.finest, p.levels)) for p in config.proposals)
        self.proposals = nn.ModuleList(HashNetwork(r, p.log2_table, (p.width, 1), g) for p, r in shapes)

    @property
    def contraction(self) -> Contraction:
        return self.sampler.contraction

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        return self._sigma(self.trunk(self._contracted(x), slice(1))[:, 0]).reshape(x.shape[:-1])

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3), unit directions (..., 3) -> sigma (...,), rgb (..., 3) in [0, 1]."""
        out = self.trunk(self._contracted(x))
        features = torch.cat([out[:, 1:], kernels.spherical_harmonics(d.reshape(-1, 3))], -1)
        hidden = functional.relu(functional.linear(features, self.colour_in))
        hidden = functional.relu(functional.linear(hidden, self.colour_mid))
        rgb = torch.sigmoid(functional.linear(hidden, self.colour_out))
        return self._sigma(out[:, 0]).reshape(x.shape[:-1]), rgb.reshape(x.shape)

    @property
    def span(self) -> Span:
        """The part of a ray that is looked at."""
        return Span(self.config.near, self.config.far, self.contraction.radius)

    @property
    def densities(self) -> tuple[Density, ...]:
        """What the proposal networks take the density to be, at world points (S, 3)."""
        return tuple(self.told_by(p) for p in self.proposals)

    def told_by(self, network: nn.Module) -> Density:
        """What a proposal network, the field's own or a copy of it, takes the density to be."""
        return lambda x: self._sigma(network(self._contracted(x))[:, 0])

    def propose(
        self,
        rays: Rays,
        jitter: bool = False,
        anneal: float = 1.0,
        densities: tuple[Density, ...] | None = None,
        draw: torch.Generator | None = None,
    ) -> tuple[tuple[Histogram, ...], Tensor]:
        """The proposals' histograms of N rays, and the edges (N, K + 1) in s at which to ask the field.

        ``densities`` may ask the proposal networks elsewhere than where a sample lies (Eq. 16).
        """
        counts = (*(p.samples for p in self.config.proposals), self.config.samples)
        return propose(rays, densities or self.densities, Plan(self.span, counts, anneal), jitter, draw)

    def samples(self, rays: Rays, jitter: bool = False, without: Inside | None = None) -> Samples:
        """Where to evaluate the field along rays: where the proposal networks expect something to be seen.

        ``without`` says of which places the field holds nothing any more: nothing is looked at there, and more
        closely at what is behind.
        """
        with torch.no_grad():
            if without is None:
                return self.span.samples(self.propose(rays, jitter)[1])
            left = tuple(emptied(d, without) for d in self.densities)
            found = self.span.samples(self.propose(rays, jitter, densities=left)[1])
            return found.only(~without(found.positions(rays)[0]))

    def _contracted(self, x: Tensor) -> Tensor:
        return self.contraction(x.reshape(-1, 3))

    def _sigma(self, raw: Tensor) -> Tensor:
        return truncated_exp(raw) * (self.config.first_density / self.contraction.radius)

    def state(self) -> State:
        """Everything needed to rebuild the field: named tensors, and facts that JSON can hold."""
        return state_of(self, self.config, self.sampler)

    @staticmethod
    def from_state(tensors: dict[str, Tensor], facts: dict[str, Any]) -> NerfactoField:
        """Inverse of :meth:`state`. Raises KeyError, TypeError or RuntimeError if something is missing or of another
        shape."""
        tensors, shape = dict(tensors), dict(facts["config"])
        shape["proposals"] = tuple(ProposalConfig(**p) for p in shape["proposals"])
        sampler = sampler_from(tensors, facts)
        field = NerfactoField(NerfactoConfig(**shape), sampler)
        field.load_state_dict(tensors)
        return field.eval().requires_grad_(False)

    def save(self, folder: AnyPath) -> None:
        """Write ``field.safetensors`` and ``field.json`` into an existing folder."""
        write_field(as_path(folder, "the field's folder"), self.state())

    @staticmethod
    def load(folder: AnyPath) -> NerfactoField:
        """Inverse of :meth:`save`. Raises InputError naming the file that is missing or not ours."""
        return read_field(as_path(folder, "the field's folder"), "NerfactoField", NerfactoField.from_state)

    def __repr__(self) -> str:
        return f"NerfactoField({'; '.join(f'{name} {value}' for name, value in self._facts())})"

    def _facts(self) -> list[tuple[str, object]]:
        c = self.config
        grid = f"of {c.levels} levels, {c.coarsest} to {c.finest} cells a side, 2^{c.log2_table} entries each"
        asked = " and ".join(str(p.samples) for p in c.proposals)
        return [("hash grid", grid), ("samples a ray", f"{c.samples}, proposed from {asked}"), *self.sampler.facts()]

    def _repr_html_(self) -> str:
        return facts("NerfactoField", self._facts())

    def looking_where(self, grid: Tensor) -> None:
        """Replace the occupancy grid (R, R, R) uint8 that others march through; own samples do not heed it."""
        self.sampler = replace(self.sampler, grid=grid)


def looking_everywhere(contraction: Contraction, config: NerfactoConfig) -> OccupancySampler:
    """A sampler that leaves nothing out, for those who only ask where a field may hold something."""
    grid = torch.ones(config.occupancy, config.occupancy, config.occupancy, dtype=torch.uint8)
    near, step = (u * contraction.radius for u in (config.near, config.step))
    return OccupancySampler(contraction, grid, step, near, config.far)
