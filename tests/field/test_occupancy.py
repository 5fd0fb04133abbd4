"""What of a field in training is shown."""

import torch

from refield.field.encoding import Contraction
from refield.field.occupancy import OccupancyTrainer
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.sampling import OccupancySampler


def trainer(opacity: float) -> OccupancyTrainer:
    """Every cell seen, with this opacity of a sample; nothing has been trained."""
    sampler = OccupancySampler(Contraction(torch.zeros(3), 1.0), torch.ones(32, 32, 32, dtype=torch.uint8), 0.05)
    model = HashField(HashFieldConfig(levels=2, coarsest=4, finest=8, log2_table=6), sampler)
    it = OccupancyTrainer(model, cull_from=1)
    it.state[:, 0], it.state[:, 1], it.state[:, 3] = opacity, 1.0, 0.0
    return it


def shown_at(it: OccupancyTrainer) -> tuple[float, float]:
    """The part of the cells that is shown in the core, and where cameras stand."""
    grid = it.model.sampler.grid.reshape(-1).float()
    distance = it.model.sampler.distance(torch.arange(32**3))
    return float(grid[distance < 1].mean()), float(grid[(distance > 1) & (distance < 2)].mean())


def test_haze_where_cameras_stand_is_not_kept_once_surfaces_are_sharp() -> None:
    it = trainer(opacity=0.15)
    it.renew(2)
    assert min(shown_at(it)) > 0.9
    it.renew(4)
    core, cameras = shown_at(it)
    assert core > 0.9 and cameras < 0.1


def test_a_surface_where_cameras_stand_is_kept() -> None:
    it = trainer(opacity=0.9)
    it.renew(4)
    assert min(shown_at(it)) > 0.9
