"""The Field seam, and the default field: a hash grid with two small networks (Eq. 1's F: (x, d) -> (sigma, c))."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional

from refield.field import kernels
from refield.field.encoding import Contraction, HashGrid, geometric_levels
from refield.field.kernels.reference import DensityNet, Networks, Within, truncated_exp
from refield.field.networks import weight
from refield.field.sampling import STOP, OccupancySampler
from refield.field.stored import State, read_field, sampler_from, state_of, write_field
from refield.field.volrend import Rendering, Samples
from refield.scene.capture import Rays
from refield.scene.errors import wrong
from refield.scene.files import AnyPath, as_path
from refield.scene.notebook import facts


@runtime_checkable
class Field(Protocol):
    """Density and colour anywhere in the world, and a sampler that knows where to look.

    An updated field is a Field too: it renders, is viewed, saved and updated again with no new code.
    """

    @property
    def sampler(self) -> OccupancySampler: ...

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        ...

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3) and unit directions (..., 3) -> sigma (...,) and rgb (..., 3) in [0, 1]."""
        ...


def check_field(field: Field) -> None:
    """Check that a caller's field has what `Field` asks for.

    Raises:
        TypeError: it lacks something, or is no field at all.
    """
    lacks = [name for name in ("sampler", "density", "__call__") if not hasattr(field, name)]
    if lacks:
        give = f"one as refield.fit_field makes it, or an object of your own with {', '.join(lacks)} (refield.Field)"
        raise wrong("the field", field, give)


@dataclass(frozen=True)
class HashFieldConfig:
    """Shape of a `HashField`."""

    levels: int = 10
    """of the hash grid"""
    coarsest: int = 16
    """cells a side of the contracted cube on the coarsest level"""
    finest: int = 512
    """cells a side on the finest level"""
    log2_table: int = 16
    """entries of a level's table; 2^16 entries of two floats fit a core's L2 cache"""
    width: int = 32
    """of both networks' hidden layers; on a CPU they are the cost"""
    geometry_features: int = 15
    """handed from the density to the colour network"""


class HashField(nn.Module):
    """Hash grid → density network → colour network, over contracted space.

    The density is exactly zero where the sampler does not look, so that the field is what its renderings show.
    """

    def __init__(self, config: HashFieldConfig, sampler: OccupancySampler, seed: int = 0) -> None:
        super().__init__()
        g = torch.Generator().manual_seed(seed)
        self.config = config
        self.sampler = sampler
        levels = geometric_levels(config.coarsest, config.finest, config.levels)
        self.encoding = HashGrid(levels, 1 << config.log2_table, g)
        w, k = config.width, config.geometry_features
        self.density_in = weight(w, self.encoding.width, g)
        self.density_out = weight(1 + k, w, g)
        self.colour_in = weight(w, k + 16, g)
        self.colour_mid = weight(w, w, g)
        self.colour_out = weight(3, w, g)

    @property
    def contraction(self) -> Contraction:
        return self.sampler.contraction

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        flat = x.reshape(-1, 3)
        if torch.is_grad_enabled() and (
            flat.requires_grad or any(p.requires_grad for p in self.density_net if isinstance(p, Tensor))
        ):
            raw = functional.linear(self._hidden(flat), self.density_out[:1])[:, 0]
        else:
            raw = kernels.hash_density(self._unit(flat), self.density_net)
        return self._where_seen(self.sigma(raw), flat).reshape(x.shape[:-1])

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3), unit directions (..., 3) -> sigma (...,), rgb (..., 3) in [0, 1]."""
        flat = x.reshape(-1, 3)
        enc = self.encoding
        raw, rgb = kernels.hash_field(self._unit(flat), d.reshape(-1, 3), enc.tables, enc.resolutions, self.networks)
        return self._where_seen(self.sigma(raw), flat).reshape(x.shape[:-1]), rgb.reshape(x.shape)

    def samples(self, rays: Rays, jitter: bool = False) -> Samples:
        """Where to evaluate the field along rays: the sampler's places, ended behind the first opaque surface."""
        return self.sampler.visible(rays, self.density_net, jitter)

    def samples_within(self, sampler: OccupancySampler, rays: Rays, within: Within) -> tuple[Samples, Tensor]:
        """Those of the samples ``within`` that light reaches, if there is nothing else, where ``sampler`` looks, which
        looks nowhere but where the field's does; and their densities (S,)."""
        return sampler.within(rays, self.density_net, within)

    def rendered(self, rays: Rays, chunk: int) -> Rendering:
        """What rays see, without gradients: `refield.field.render.render_rays`, ``chunk`` rays at once."""
        sampler, enc = self.sampler, self.encoding
        space = (sampler.contraction.centre, sampler.contraction.radius)
        field, parts = (enc.tables, enc.resolutions, self.networks), []
        for i in range(0, max(len(rays), 1), chunk):
            some = rays[i : i + chunk]
            lines = (some.origins, some.directions, some.origins.new_zeros(len(some)))
            with torch.no_grad():
                seen = kernels.render(lines, space, sampler.grid, sampler.lattice, field, STOP, sampler.fine)
            parts.append(Rendering(*seen))
        return Rendering.joined(parts)

    @property
    def networks(self) -> Networks:
        """The density network's two matrices and the colour network's three."""
        return self.density_in, self.density_out, self.colour_in, self.colour_mid, self.colour_out

    @property
    def density_net(self) -> DensityNet:
        """What marching needs to know the density: tables, their resolutions, and the network's two layers."""
        return self.encoding.tables, self.encoding.resolutions, self.density_in, self.density_out[0]

    def _unit(self, flat: Tensor) -> Tensor:
        return (self.contraction(flat) + 2) / 4

    def _hidden(self, flat: Tensor) -> Tensor:
        return functional.relu(functional.linear(self.encoding(self.contraction(flat)), self.density_in))

    def sigma(self, raw: Tensor) -> Tensor:
        """The density network's first output -> density, per world unit."""
        return truncated_exp(raw) / self.contraction.radius

    def _where_seen(self, sigma: Tensor, x: Tensor) -> Tensor:
        if self.training:
            return sigma
        return torch.where(self.sampler.occupied(x.detach()), sigma, torch.zeros_like(sigma))

    def state(self) -> State:
        """Everything needed to rebuild the field: named tensors, and facts that JSON can hold."""
        return state_of(self, self.config, self.sampler)

    @staticmethod
    def from_state(tensors: dict[str, Tensor], facts: dict[str, Any]) -> HashField:
        """Inverse of :meth:`state`. Raises KeyError or RuntimeError if something is missing or of another shape."""
        tensors = dict(tensors)
        sampler = sampler_from(tensors, facts)
        field = HashField(HashFieldConfig(**facts["config"]), sampler)
        field.load_state_dict(tensors)
        return field.eval().requires_grad_(False)

    def save(self, folder: AnyPath) -> None:
        """Write ``field.safetensors`` and ``field.json`` into an existing folder."""
        write_field(as_path(folder, "the field's folder"), self.state())

    @staticmethod
    def load(folder: AnyPath) -> HashField:
        """Inverse of :meth:`save`. Raises InputError naming the file that is missing or not ours."""
        return read_field(as_path(folder, "the field's folder"), "HashField", HashField.from_state)

    def __repr__(self) -> str:
        return f"HashField({'; '.join(f'{name} {value}' for name, value in self._facts())})"

    def _facts(self) -> list[tuple[str, object]]:
        c = self.config
        grid = f"of {c.levels} levels, {c.coarsest} to {c.finest} cells a side, 2^{c.log2_table} entries each"
        return [("hash grid", grid), ("networks", f"{c.width} wide"), *self.sampler.facts()]

    def _repr_html_(self) -> str:
        return facts("HashField", self._facts())

    def looking_where(self, grid: Tensor, fine: Tensor | None = None) -> None:
        """Replace the occupancy grid (R, R, R) uint8, and what is known of its cells' parts (R, R, R) int64."""
        self.sampler = replace(self.sampler, grid=grid, fine=fine)
