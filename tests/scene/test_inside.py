"""Compiled loops over points and rays say what plain torch does."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from refield.scene.capture import Rays
from refield.scene.change import OccupancyGrid
from refield.scene.inside import in_boxes, in_grid, trilinear

BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 1.0, 2.0]])


def points(count: int, dtype: torch.dtype) -> torch.Tensor:
    """Within and around BOX, some on its sides, some that are not numbers."""
    x = (torch.rand(count, 3, generator=torch.Generator().manual_seed(1), dtype=dtype) - 0.5) * 6
    x[:10, 0], x[10:20, 1], x[20:30] = 1.0, -2.0, float("nan")
    x[30], x[31] = BOX[0], BOX[1]
    return x


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_in_a_grid(dtype):
    values = torch.rand(11, 7, 9, generator=torch.Generator().manual_seed(2))
    x = points(20_000, dtype)
    real = x.isfinite().all(-1)
    expected = trilinear(x, BOX, values) > 0.5
    found = in_grid(x, BOX, values, 0.5)
    assert torch.equal(found[real], expected[real]) and not found[~real].any()
    assert 100 < int(found.sum()) < 10_000
    assert torch.equal(in_grid(x[:, [2, 1, 0]], BOX.flip(-1), values.permute(2, 1, 0), 0.5), found)  # not contiguous


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_in_boxes(dtype):
    x = points(5000, dtype)
    boxes = torch.stack([BOX, BOX + 0.7])
    lo, hi = boxes.to(dtype).unbind(1)
    found = in_boxes(x, boxes)
    assert torch.equal(found, ((x[:, None] >= lo) & (x[:, None] <= hi)).all(-1).any(-1))
    assert found[30] and found[31] and not found[20:30].any()
    assert in_boxes(x[:0], boxes).shape == (0,)


def test_rays_that_meet_a_shape():
    rng = np.random.default_rng(0)
    values = ndimage.gaussian_filter(rng.standard_normal((14, 9, 11)), 1.5).astype(np.float32)
    grid = OccupancyGrid(
        torch.tensor([[-0.5, -0.3, 0.1], [0.4, 0.5, 0.8]]), torch.from_numpy(values / values.max() / 2 + 0.4)
    )
    origins = torch.from_numpy(rng.uniform(-1.5, 1.5, (4000, 3)).astype(np.float32))
    aim = torch.from_numpy(rng.uniform(-0.5, 0.8, (4000, 3)).astype(np.float32)) - origins
    aim[::7] *= -1
    aim[::5, 1] = 0  # along a wall of the box
    directions = torch.nn.functional.normalize(aim, dim=-1)
    # ray by ray, the places where the shape is asked for
    o, d = origins.double(), directions.double()
    inverse = 1 / torch.where(d.abs() < 1e-9, torch.full_like(d, 1e-9), d)
    a, b = ((side - o) * inverse for side in grid.tight_aabb().double())
    near, far = torch.minimum(a, b).amax(-1).clamp_min(0), torch.maximum(a, b).amin(-1)
    t = near[:, None] + (far - near)[:, None] * (torch.arange(40) + 0.5) / 40
    expected = (far > near) & grid.contains(o[:, None] + d[:, None] * t[..., None]).any(1)
    assert 0.1 < expected.float().mean() < 0.9
    assert torch.equal(grid.met_by(Rays(origins, directions)), expected)
