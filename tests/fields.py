"""Fields for tests: a small random hash field, and the samplers of fields in closed form."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from refield.field.encoding import Contraction
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.sampling import OccupancySampler


def small_field(seed: int = 0) -> HashField:
    """Something to see: random, and dense everywhere its sampler looks."""
    g = torch.Generator().manual_seed(seed)
    grid = (torch.rand(16, 16, 16, generator=g) > 0.3).to(torch.uint8)
    sampler = OccupancySampler(Contraction(torch.zeros(3), 1.0), grid, 0.1)
    config = HashFieldConfig(levels=3, coarsest=4, finest=16, log2_table=10, width=8)
    field = HashField(config, sampler, seed)
    with torch.no_grad():
        field.encoding.tables.normal_(generator=g)
    return field.eval().requires_grad_(False)


def oracle_sampler(density: Callable[[Tensor], Tensor], space: Contraction, step: float) -> OccupancySampler:
    """Looks wherever a density in closed form may be, and one cell further.

    Random probes miss the corners of hard edges; these fields are oracles and may not.
    """
    found = OccupancySampler.from_density(density, space, step, resolution=64)
    grown = functional.max_pool3d(found.grid[None, None].float(), 3, 1, 1)[0, 0]
    return replace(found, grid=grown.to(torch.uint8))
