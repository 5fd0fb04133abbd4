"""An updated field that was saved and loaded is the same field."""

import inspect
from dataclasses import fields, replace

import pytest
import torch

from refield.artefacts import read_tensors, write_tensors
from refield.field.render import render_rays
from refield.scene.capture import Rays
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.errors import InputError
from refield.scene.pose import exp
from refield.update.composite import UpdatedField
from refield.update.learnt import Learnt
from refield.update.light import Relighting
from refield.update.store import load_updated, save_updated
from refield.update.textured import TexturedPlane
from tests.fields import small_field

STORED = {"pretrained", "change", "learnt", "eyes", "earlier", "sampler"}
LEARNT = {"helper", "region", "light", "shading", "bare"}


def a_light(seed: int) -> Relighting:
    box = torch.tensor([[-0.8, -0.8, -0.8], [0.8, 0.8, 0.8]])
    return Relighting(box, torch.randn(4, 4, 4, 3, generator=torch.Generator().manual_seed(seed)) * 0.3)


def a_plane() -> TexturedPlane:
    up, axes = torch.tensor([0.0, 0.6, 0.8]), torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6]])
    rgb = torch.rand(30, 20, 3, generator=torch.Generator().manual_seed(4))
    known = torch.rand(30, 20, generator=torch.Generator().manual_seed(5)) > 0.3
    return TexturedPlane(up, torch.tensor([-0.5, 0.1, 0.2]), axes, 0.03, 0.2, 0.1, rgb, known)


def a_change() -> SceneChange:
    grid = OccupancyGrid(torch.tensor([[-0.4, -0.4, -0.4], [0.0, 0.0, 0.0]]), torch.ones(6, 6, 6))
    there = OccupancyGrid(torch.tensor([[0.1, 0.1, 0.1], [0.3, 0.3, 0.3]]), torch.ones(6, 6, 6))
    turn = exp(torch.tensor([0.3, 0.2, 0.1, 0.0, 0.2, 0.3], dtype=torch.float64))
    return SceneChange((ObjectChange("moved", grid, turn), ObjectChange("removed", there)))


@pytest.mark.parametrize("helped", [True, False])
@pytest.mark.parametrize("lit", [True, False])
def test_round_trip(tmp_path, helped, lit):
    old, change = small_field(0), a_change()
    light, shading = (a_light(1), (a_light(2),)) if lit else (None, (None,))
    helper = small_field(3) if helped else None
    region = replace(UpdatedField(old, change, Learnt(helper)).region, planes=(a_plane(),))
    field = UpdatedField(old, change, Learnt(helper, region=region, light=light, shading=shading))
    field = field.unshown(torch.tensor([1200, 2100]))
    save_updated(tmp_path, field)
    back = load_updated(tmp_path, old, change)
    x = torch.rand(3000, 3) * 2 - 1
    d = torch.nn.functional.normalize(torch.randn(3000, 3), dim=-1)
    for ours, theirs in zip(field(x, d), back(x, d)):
        assert torch.equal(ours, theirs)
    assert field.routing.of(x).textured.numel() and torch.equal(back.region.planes[0].rgb, field.region.planes[0].rgb)
    assert torch.equal(field.sampler.grid, back.sampler.grid) and torch.equal(field.unseen, back.unseen)
    rays = Rays(torch.tensor([[0.0, 0.0, -3.0]]).expand(200, 3), torch.nn.functional.normalize(-x[:200] + 3, dim=-1))
    assert torch.equal(render_rays(field, rays).rgb, render_rays(back, rays).rgb)


def test_nothing_is_forgotten():
    """A new part of an updated field has to be stored too."""
    derived = {"self", "taken"}  # follows from what later visits took back
    assert set(inspect.signature(UpdatedField.__init__).parameters) - derived == STORED
    assert {f.name for f in fields(Learnt)} == LEARNT


def test_damage_is_named(tmp_path):
    old, change = small_field(0), a_change()
    save_updated(tmp_path, UpdatedField(old, change, Learnt(small_field(3))))
    tensors, facts = read_tensors(tmp_path)
    write_tensors(tmp_path, {k: v for k, v in tensors.items() if k != "region.0.values"}, facts)
    with pytest.raises(InputError, match=r"region\.0\.values"):
        load_updated(tmp_path, old, change)


def test_what_is_known_of_parts_of_cells_stays_where_nothing_changed(tmp_path):
    old, change = small_field(0), a_change()
    before = old.sampler.grid
    masks = torch.randint(1, 1 << 62, before.shape, generator=torch.Generator().manual_seed(6))
    old.looking_where(before, torch.where(before > 0, masks, 0))
    field = UpdatedField(old, change, Learnt(small_field(3)))
    kept = field.sampler.fine
    near = torch.cat([old.sampler.cells_in(box) for box in field.boxes])
    assert not kept.view(-1)[near].any()
    far = torch.ones_like(before, dtype=torch.bool)
    far.view(-1)[near] = False
    assert far.any() and torch.equal(kept[far], old.sampler.fine[far])
    save_updated(tmp_path, field)
    back = load_updated(tmp_path, old, change).sampler
    assert torch.equal(back.fine, torch.where(back.grid > 0, kept, 0))
    tensors, facts = read_tensors(tmp_path)
    write_tensors(tmp_path, tensors | {"parts": tensors["parts"][:-1]}, facts)
    with pytest.raises(InputError, match="mask"):
        load_updated(tmp_path, old, change)
