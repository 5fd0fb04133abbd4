"""What is known of the parts of cells: found in training, kept in files, forgotten where something new comes."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from refield.field.encoding import Contraction
from refield.field.kernels import cpu, reference
from refield.field.parts import Parts
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.sampling import OccupancySampler
from refield.field.stored import write_field
from refield.scene.capture import Rays
from refield.scene.errors import InputError

R = 16


def bits_of(masks: Tensor) -> Tensor:
    """(R, R, R) int64 -> (4 R, 4 R, 4 R) bool."""
    r = len(masks)
    bits = (masks[..., None] >> torch.arange(64)) & 1
    return bits.reshape(r, r, r, 4, 4, 4).permute(0, 3, 1, 4, 2, 5).reshape(4 * r, 4 * r, 4 * r) > 0


def masks_of(bits: Tensor) -> Tensor:
    r = len(bits) // 4
    each = bits.reshape(r, 4, r, 4, r, 4).permute(0, 2, 4, 1, 3, 5).reshape(r, r, r, 64)
    return (each.long() << torch.arange(64)).sum(-1)


def field() -> HashField:
    """Random weights, looking everywhere."""
    sampler = OccupancySampler(Contraction(torch.zeros(3), 1.0), torch.ones(R, R, R, dtype=torch.uint8), 0.02)
    return HashField(HashFieldConfig(levels=2, coarsest=4, finest=8, log2_table=8), sampler)


def test_twins_know_the_same() -> None:
    torch.manual_seed(1)
    grid = (torch.rand(R, R, R) < 0.7).to(torch.uint8)
    states = [torch.zeros(R**3, 5, dtype=torch.int64) for _ in range(2)]
    for _ in range(4):
        cells, parts, opaque = torch.randint(R**3, (90_000,)), torch.randint(64, (90_000,)), torch.rand(90_000) < 0.02
        found = []
        for twin, known in zip((reference, cpu), states):
            twin.note(known, cells, parts, opaque)
            found.append(twin.narrow(known, grid))
        assert (found[0] == found[1]).all() and (states[0] == states[1]).all()
    open_part = bits_of(found[0])[bits_of(torch.where(grid > 0, -1, 0))].float().mean()
    assert 0.1 < open_part < 0.9
    assert (found[0][grid == 0] == 0).all()


def test_a_part_is_left_out_once_rays_found_nothing_in_it_twice() -> None:
    model = field()
    parts, grid = Parts(model), model.sampler.grid
    cell, every = (8 * R + 8) * R + 8, torch.arange(64)
    there = torch.full((64,), cell)
    parts.observe(there, every, every == 21)
    kept, fine = parts.narrowed(grid)
    assert kept.all() and fine.view(-1)[cell + 1] == -1  # nothing was asked there
    assert fine.view(-1)[cell] == 1 << 21
    for left in (1, 0):
        parts.observe(there, every, every < 0)
        kept, fine = parts.narrowed(grid)
        assert bits_of(fine)[32:36, 32:36, 32:36].sum() == left
    assert kept.view(-1)[cell] == 0 and kept.sum() == R**3 - 1
    kept, fine = parts.narrowed(grid, torch.tensor([cell]))  # tried again
    assert kept.all() and fine.view(-1)[cell] == -1
    assert not parts.narrowed(grid)[0].all()


def test_cells_are_probed_where_samples_are_and_opaque_parts_stay() -> None:
    torch.manual_seed(3)
    model = field()
    with torch.no_grad():
        model.encoding.tables.mul_(1.5e5)
    parts, sampler = Parts(model), model.sampler
    used = torch.arange(R**3)[::2]
    for _ in range(300):
        parts.probe(used, 0.3)
    grid, fine = parts.narrowed(sampler.grid)
    asked = replace(sampler, grid=grid, fine=fine)
    x = torch.rand(40_000, 3) * 2 - 1
    cells, _ = sampler.places(x)
    opaque = parts.opacity(cells, model.density(x)) > 0.5
    assert 0.003 < opaque.float().mean() < 0.5
    looked = asked.occupied(x)
    assert looked[opaque].float().mean() > 0.9 and looked[cells % 2 == 1].all()
    assert looked[cells % 2 == 0].float().mean() < 0.3


def test_a_sampler_looks_into_open_parts_alone() -> None:
    sampler = field().sampler
    bits = torch.zeros(4 * R, 4 * R, 4 * R, dtype=torch.bool)
    bits[24:40, 24:40, 30] = True
    sampler = replace(sampler, grid=(masks_of(bits) != 0).to(torch.uint8), fine=masks_of(bits))
    rays = Rays(torch.tensor([[0.1, 0.1, -1.0]]), torch.tensor([[0.0, 0.0, 1.0]]))
    x, _ = sampler(rays).positions(rays)
    assert len(x) == 3 and ((x[:, 2] + 2) * R > 30).all() and ((x[:, 2] + 2) * R < 31).all()
    assert sampler.occupied(x).all() and not sampler.occupied(x + torch.tensor([0.0, 0.0, 0.07])).any()


def test_where_something_new_is_looked_up_no_mask_stays() -> None:
    sampler = replace(field().sampler, fine=torch.full((R, R, R), 1))
    box = torch.tensor([[-0.2, -0.2, -0.2], [0.2, 0.2, 0.2]])
    fresh = sampler.refreshed(lambda x: torch.full(x.shape[:-1], 1e3), [box])
    assert fresh.fine is not None
    changed = fresh.fine.view(-1) != 1
    assert set(changed.nonzero()[:, 0].tolist()) == set(sampler.cells_in(box).tolist())
    assert fresh.occupied(torch.rand(100, 3) * 0.4 - 0.2).all()


def test_masks_are_kept_in_the_file_and_old_files_have_none(tmp_path: Path) -> None:
    torch.manual_seed(2)
    model = field()
    grid = (torch.rand(R, R, R) < 0.3).to(torch.uint8)
    masks = torch.where(grid > 0, torch.randint(-(1 << 62), 1 << 62, (R, R, R)), 0)
    model.looking_where(grid, masks)
    model.save(tmp_path)
    again = HashField.load(tmp_path)
    assert again.sampler.fine is not None and (again.sampler.fine == masks).all()
    tensors, facts = model.state()
    with pytest.raises(ValueError, match="mask"):
        HashField.from_state(tensors | {"parts": tensors["parts"][1:]}, facts)
    model.looking_where(grid)
    model.save(tmp_path)
    assert HashField.load(tmp_path).sampler.fine is None


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    model = field()
    model.looking_where(model.sampler.grid, torch.ones(R, R, R, dtype=torch.int64))
    tensors, facts = model.state()
    write_field(tmp_path, (tensors | {"parts": tensors["parts"].int()}, facts))
    with pytest.raises(InputError, match="no readable field"):
        HashField.load(tmp_path)
