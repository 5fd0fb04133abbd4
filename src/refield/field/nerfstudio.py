"""A field that nerfstudio's ``nerfacto`` has trained, as it is: the same function, and looked at in the same places.

Its networks have biases, its grid is turned against the world (nerfstudio turns, shifts and scales what it trains on),
and a ray that nothing stops shows the colour of its last sample: none of this a `NerfactoField` can say. What belongs
to nerfstudio stays inside; the world is that of the photos. Letters: S points, N rays, K intervals a ray, L levels; a
*run unit* is nerfstudio's unit of length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from refield.field import kernels
from refield.field.encoding import Contraction, large_zeros
from refield.field.kernels.reference import contract, truncated_exp
from refield.field.proposal import Density, Histogram, Inside, Span, emptied, even_edges, resampled
from refield.field.sampling import OccupancySampler
from refield.field.stored import State, read_field, sampler_from, state_of, write_field
from refield.field.volrend import Samples, weights
from refield.scene.capture import Rays

_LARGEST = 15.0  # up to there `truncated_exp` is exp
_OPAQUE = 40.0  # optical depth of the sky's sample
_BLOCK = 1 << 16  # points; some 100 MB in networks 128 wide
SKY = 3.0
"""The sky lies so many times the far end of a ray behind what it looks like"""


@dataclass(frozen=True)
class GridShape:
    """A hash grid over the unit cube."""

    resolutions: tuple[int, ...]
    """cells a side on each level"""
    log2_table: int
    """entries of a level's table"""
    scales: tuple[float, ...] = ()
    """of a staggered grid (tiny-cuda-nn's): a point x of the unit cube lies at x * scale + 1/2 of a level's lattice; at
    x * resolution of any other's"""


@dataclass(frozen=True)
class NetworkShape:
    """A hash grid and the network behind it."""

    grid: GridShape
    layers: tuple[int, ...]
    """widths of the hidden layers, then how many outputs"""


@dataclass(frozen=True)
class NerfstudioConfig:
    """What a run was: its shapes, and how it looks along rays."""

    trunk: NetworkShape
    """→ raw density and what the colour network is handed"""
    colour: tuple[int, ...]
    """widths of the colour network's layers; the last is 3"""
    proposals: tuple[NetworkShape, ...]
    """→ raw density, in the order in which they are asked"""
    counts: tuple[int, ...]
    """intervals a ray: for each proposal network, then for the field"""
    radius: float
    """a run unit in world units"""
    far: float = 1000.0
    """where rays end, run units; they begin at the camera"""
    even: bool = False
    """the first intervals are even in distance; else in distance up to a run unit, in disparity beyond"""
    first_density: float = 1.0
    """per run unit, where the networks say nothing"""
    box: tuple[float, ...] | None = None
    """x, y, z of the two corners of all there is, run units; None where space is contracted, and has no end"""
    halved: bool = True
    """spherical harmonics are those of (d + 1) / 2, as in nerfstudio's torch implementation; else of d"""
    sky: tuple[float, float, float] | bool = True
    """what a ray shows that nothing stops: a colour; that of its last sample (True); nothing (False)"""


class HashMlp(nn.Module):
    """Hash grid → linear layers with relu between them."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.grid = shape.grid
        levels = len(shape.grid.resolutions)
        self.tables = nn.Parameter(large_zeros(levels, 1 << shape.grid.log2_table, 2))
        self.layers = _linear_layers((2 * levels, *shape.layers))

    def forward(self, unit: Tensor, outputs: slice = slice(None)) -> Tensor:
        """Points of the unit cube (S, 3) -> the chosen ``outputs``, (S, O)."""
        *layers, last = self.layers
        hidden = self._features(unit)
        for layer in layers:
            hidden = functional.relu(layer(hidden))
        return functional.linear(hidden, cast(Tensor, last.weight)[outputs], cast(Tensor, last.bias)[outputs])

    def _features(self, unit: Tensor) -> Tensor:
        if not self.grid.scales:
            return kernels.hash_encode(unit, self.tables, self.grid.resolutions)
        each = zip(self.grid.resolutions, self.grid.scales, self.tables.split(1))
        return torch.cat([kernels.hash_encode((unit * s + 0.5) / r, table, (r,)) for r, s, table in each], -1)


def _linear_layers(widths: tuple[int, ...]) -> nn.ModuleList:
    """From each width to the next."""
    return nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))


class NerfstudioField(nn.Module):
    """What nerfstudio shows of a trained ``nerfacto``, in the world of its photos."""

    centre: Tensor
    turn: Tensor

    def __init__(self, config: NerfstudioConfig, sampler: OccupancySampler) -> None:
        """All weights are to be loaded; so are ``centre``, (3,), where nerfstudio has its origin in the world, and
        ``turn``, (3, 3), the rotation from world to run axes."""
        super().__init__()
        self.config, self.sampler = config, sampler
        self.trunk = HashMlp(config.trunk)
        self.colour = _linear_layers((16 + config.trunk.layers[-1] - 1, *config.colour))
        self.proposals = nn.ModuleList(HashMlp(p) for p in config.proposals)
        self.register_buffer("centre", torch.zeros(3))
        self.register_buffer("turn", torch.eye(3))

    @property
    def contraction(self) -> Contraction:
        """The sampler's; the field's own is turned."""
        return self.sampler.contraction

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        flat = x.reshape(-1, 3)
        here = self._run_from_world(flat)
        sigma = self._density_of(self.trunk, here)
        return torch.where(self._is_sky(here), self._sky_density, sigma).reshape(x.shape[:-1])

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3), unit directions (..., 3) -> sigma (...,), rgb (..., 3) in [0, 1]."""
        parts = [self._seen(*p) for p in zip(_blocks(x.reshape(-1, 3)), _blocks(d.reshape(-1, 3)))]
        sigma, rgb = (torch.cat(each) for each in zip(*parts))
        return sigma.reshape(x.shape[:-1]), rgb.reshape(x.shape)

    def _seen(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points and directions (S, 3) -> sigma (S,), rgb (S, 3)."""
        here, along = self._run_from_world(x), d @ self.turn.T
        sky = self._is_sky(here)
        here = torch.where(sky[:, None], here - SKY * self.config.far * along, here)
        unit, within = self._unit(here)
        out = self.trunk(unit)
        rgb = self._rgb(out[:, 1:], along)
        if isinstance(self.config.sky, tuple):
            rgb = torch.where(sky[:, None], rgb.new_tensor(self.config.sky), rgb)
        return torch.where(sky, self._sky_density, self._sigma(out[:, 0]) * within), rgb

    def _rgb(self, features: Tensor, along: Tensor) -> Tensor:
        # nerfstudio maps directions to [0, 1] for tiny-cuda-nn, which maps them back; its torch code does not
        harmonics = kernels.spherical_harmonics((along + 1) / 2 if self.config.halved else along)
        hidden = torch.cat([harmonics, features], -1)
        *layers, last = self.colour
        for layer in layers:
            hidden = functional.relu(layer(hidden))
        return torch.sigmoid(last(hidden))

    @property
    def densities(self) -> tuple[Density, ...]:
        """What the proposal networks take the density to be, at world points (S, 3)."""

        def asking(network: nn.Module) -> Density:
            return lambda x: self._density_of(network, self._run_from_world(x))

        return tuple(asking(p) for p in self.proposals)

    @property
    def span(self) -> Span:
        """The part of a ray that is looked at."""
        return Span(0.0, self.config.far, self.config.radius, self.config.even)

    def samples(self, rays: Rays, jitter: bool = False, without: Inside | None = None) -> Samples:
        """Where to evaluate the field along rays: where nerfstudio does, and the sky.

        ``without`` says of which world points (S, 3) -> (S,) bool the field holds nothing any more: nothing is looked
        at there, and more closely at what is behind.
        """
        with torch.no_grad():
            asked = self.densities if without is None else tuple(emptied(d, without) for d in self.densities)
            found = self.span.samples(self._edges(rays, asked, jitter))
            if self.config.sky is not False:
                found = self._with_sky(found)
            return found if without is None else found.only(~without(found.positions(rays)[0]))

    def _edges(self, rays: Rays, densities: tuple[Density, ...], jitter: bool) -> Tensor:
        """(N, K + 1) in s; unlike those of `propose` they do not reach the far end."""
        edges = even_edges(len(rays), self.config.counts[0], jitter, rays.origins.device)
        for density, following in zip(densities, self.config.counts[1:], strict=True):
            samples = self.span.samples(edges)
            w = weights(density(samples.positions(rays)[0]), samples)
            edges = resampled(Histogram(edges, w.reshape(len(rays), edges.shape[1] - 1)), following + 1, jitter)[:, :-1]
        return edges

    def _with_sky(self, found: Samples) -> Samples:
        """One more sample a ray: far behind its last one, so that the field knows it by where it lies."""
        k, half = self.config.counts[-1], self.config.radius / 2
        starts, ends = found.t_starts.reshape(-1, k), found.t_ends.reshape(-1, k)
        at = (starts[:, -1:] + ends[:, -1:]) / 2 + SKY * self.config.far * self.config.radius
        starts, ends = torch.cat([starts, at - half], 1), torch.cat([ends, at + half], 1)
        offsets = torch.arange(len(starts) + 1, device=starts.device) * (k + 1)
        return Samples(starts.reshape(-1), ends.reshape(-1), offsets)

    def _run_from_world(self, x: Tensor) -> Tensor:
        return (x - self.centre) @ self.turn.T / self.config.radius

    def _is_sky(self, here: Tensor) -> Tensor:
        """Whether points (S, 3), run units, are further away than any ray's last sample."""
        if self.config.sky is False:
            return torch.zeros(len(here), dtype=torch.bool, device=here.device)
        return here.detach().norm(dim=-1) > (SKY + 1) / 2 * self.config.far

    @property
    def _sky_density(self) -> Tensor:
        return self.centre.new_tensor(_OPAQUE / self.config.radius)

    def _unit(self, here: Tensor) -> tuple[Tensor, Tensor]:
        """Run units (S, 3) -> places in the unit cube (S, 3), and which are strictly inside of it, (S,) bool."""
        if self.config.box is None:
            unit = (contract(here, torch.zeros_like(self.centre), 1.0) + 2) / 4
        else:
            low, high = here.new_tensor(self.config.box).reshape(2, 3)
            unit = (here - low) / (high - low)
        within = ((unit > 0) & (unit < 1)).all(-1)
        return unit * within[:, None], within

    def _density_of(self, network: nn.Module, here: Tensor) -> Tensor:
        parts = [self._unit(block) for block in _blocks(here)]
        return torch.cat([self._sigma(network(unit, slice(1))[:, 0]) * within for unit, within in parts])

    def _sigma(self, raw: Tensor) -> Tensor:
        """Per world unit."""
        beyond = (raw.detach() - _LARGEST).clamp(0, 50).exp()
        return truncated_exp(raw) * beyond * (self.config.first_density / self.config.radius)

    def state(self) -> State:
        """Everything needed to rebuild the field: named tensors, and facts that JSON can hold."""
        return state_of(self, self.config, self.sampler)

    @staticmethod
    def from_state(tensors: dict[str, Tensor], facts: dict[str, Any]) -> NerfstudioField:
        """Inverse of :meth:`state`. Raises KeyError, TypeError or RuntimeError if something is missing or of another
        shape."""
        tensors = dict(tensors)
        sampler = sampler_from(tensors, facts)
        field = NerfstudioField(_config_from(facts["config"]), sampler)
        field.load_state_dict(tensors)
        return field.eval().requires_grad_(False)

    def save(self, folder: Path) -> None:
        """Write ``field.safetensors`` and ``field.json`` into an existing folder."""
        write_field(folder, self.state())

    @staticmethod
    def load(folder: Path) -> NerfstudioField:
        """Inverse of :meth:`save`. Raises InputError naming the file that is missing or not ours."""
        return read_field(folder, "NerfstudioField", NerfstudioField.from_state)

    def looking_around(self, resolution: int = 128) -> NerfstudioField:
        """The same field, its occupancy found; that of others who march through it, own samples do not heed it."""
        space = self.sampler.contraction
        found = OccupancySampler.from_density(
            lambda x: self._density_of(self.trunk, self._run_from_world(x)), space, self.sampler.step, resolution
        )
        self.sampler = replace(self.sampler, grid=found.grid)
        return self


def _blocks(points: Tensor) -> tuple[Tensor, ...]:
    """(S, 3) in parts small enough for what the networks make of them; one at least."""
    return points.split(_BLOCK) if len(points) else (points,)


def looking_everywhere(centre: Tensor, config: NerfstudioConfig) -> OccupancySampler:
    """A sampler that leaves nothing out, over a core cube of a run unit around ``centre`` (3,), world."""
    grid = torch.ones(1, 1, 1, dtype=torch.uint8)
    space = Contraction(centre, config.radius)
    return OccupancySampler(space, grid, config.radius / 192, 0.05 * config.radius, config.far)


def _config_from(facts: dict[str, Any]) -> NerfstudioConfig:
    facts = dict(facts)
    for name in ("colour", "counts"):
        facts[name] = tuple(facts[name])
    for name in ("box", "sky"):
        facts[name] = tuple(facts[name]) if isinstance(facts[name], list) else facts[name]
    facts["trunk"] = _shape_from(facts["trunk"])
    facts["proposals"] = tuple(_shape_from(p) for p in facts["proposals"])
    return NerfstudioConfig(**facts)


def _shape_from(facts: dict[str, Any]) -> NetworkShape:
    grid = facts["grid"]
    shape = GridShape(tuple(grid["resolutions"]), grid["log2_table"], tuple(grid["scales"]))
    return NetworkShape(shape, tuple(facts["layers"]))
