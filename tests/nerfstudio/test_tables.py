"""Hash tables laid out anew: the same features at the same places."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from refield.field import kernels
from refield.nerfstudio.tables import GridSettings, features_in, laid_out, torch_levels
from refield.nerfstudio.tiny_cuda import grid_levels, grid_size, network_layers
from tests.nerfstudio.runs import hashed, trilinear


@pytest.mark.parametrize("features", [1, 2, 3, 4, 8])
def test_any_number_of_features(features):
    """Levels that fit our table, and levels that do not."""
    settings = GridSettings(3, 4, 36, 9, features)
    g = torch.Generator().manual_seed(features)
    table, weight = torch.randn(3 << 9, features, generator=g), torch.randn(5, 3 * features, generator=g)
    tables, shape = laid_out(torch_levels(table, settings), 9)
    unit = torch.rand(20, 3, generator=g)
    ours = kernels.hash_encode(unit, tables, shape.resolutions) @ features_in(weight, settings).T
    theirs = []
    for u in unit.double().numpy():
        parts = []
        for rows, cells in zip(table.double().numpy().reshape(3, 512, features), sorted(set(shape.resolutions))):
            parts.append(trilinear(u * cells, lambda c, rows=rows: rows[hashed(c, 512)]))
        theirs.append(weight.double().numpy() @ np.concatenate(parts))
    assert np.allclose(ours.numpy(), np.stack(theirs), atol=1e-4)


def test_what_has_another_size_is_refused():
    settings = GridSettings(3, 4, 36, 9)
    with pytest.raises(ValueError, match="not that of"):
        torch_levels(torch.zeros(100, 2), settings)
    with pytest.raises(ValueError, match="not those of"):
        grid_levels(torch.zeros(grid_size(settings) + 2), settings)
    with pytest.raises(ValueError, match="not those of a network"):
        network_layers(torch.zeros(17), (10, 16, 1), ones=True)


@pytest.mark.parametrize("alignment", [16, 8])
def test_padding_of_either_kernel(alignment):
    """Three outputs are padded to 16 where the kernels are fused, to 8 where not; ten inputs to 16 either way."""
    packed = torch.arange(16.0 * 16 + alignment * 16)
    (first, bias), (last, none) = network_layers(packed, (10, 16, 3), ones=True)
    assert torch.equal(first, packed[:256].reshape(16, 16)[:, :10])
    assert torch.equal(bias, packed[:256].reshape(16, 16)[:, 10:].sum(1))
    assert torch.equal(last, packed[256:].reshape(alignment, 16)[:3]) and not none.any()
