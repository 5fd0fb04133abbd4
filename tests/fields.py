"""A small hash field with something to see: random, and dense everywhere its sampler looks."""

import torch

from refield.field.encoding import Contraction
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.sampling import OccupancySampler


def small_field(seed: int = 0) -> HashField:
    g = torch.Generator().manual_seed(seed)
    grid = (torch.rand(16, 16, 16, generator=g) > 0.3).to(torch.uint8)
    sampler = OccupancySampler(Contraction(torch.zeros(3), 1.0), grid, 0.1)
    config = HashFieldConfig(levels=3, coarsest=4, finest=16, log2_table=10, width=8)
    field = HashField(config, sampler, seed)
    with torch.no_grad():
        field.encoding.tables.normal_(generator=g)
    return field.eval().requires_grad_(False)
