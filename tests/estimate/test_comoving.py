"""An object outlined by what went along with it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from refield.estimate import comoving, recipe, settle
from refield.estimate.associate import without
from refield.estimate.comoving import with_comoving
from refield.estimate.fit import rest_of
from refield.estimate.outline import restricted
from tests.estimate.boxes import BoxWorld, capture_of, new_photos, standing, turn

CRATE = standing((0.2, 0.17, 0.18), -0.2, -0.15, 20, paint=3)
DRUM = standing((0.09, 0.09, 0.28), 0.13, -0.1, 20, paint=7)
"""stays, right beside it"""
BEFORE = BoxWorld((CRATE, DRUM))
AWAY = turn(CRATE.world_from_box[:3, 3], 70, (0.1, 0.5, 0))
CONFIG = recipe.EstimateConfig(survey=6)


class _Stop(Exception):
    pass


def begun(folder, monkeypatch, after: BoxWorld, count: int | None = None):
    """What an estimate knows before it looks for poses."""
    capture = capture_of(BEFORE, folder / "before")
    kept = []

    class Stopped(settle.Search):
        def settle(self, olds, begun=None):
            kept.append((self.ground, olds, self.changed))
            raise _Stop

    monkeypatch.setattr(recipe, "Search", Stopped)
    with pytest.raises(_Stop):
        recipe.estimate_change(capture, BEFORE, new_photos(after, folder / "after")[:count], CONFIG)
    return kept[0]


def held(old, box) -> tuple[float, float]:
    """The part of a box that an outline holds, and the part of the outline that is in the box."""
    box_from_world = torch.linalg.inv(box.world_from_box).numpy()
    half = np.asarray(box.half)
    inner = np.stack(np.meshgrid(*[np.linspace(-0.9, 0.9, 12)] * 3, indexing="ij"), -1).reshape(-1, 3) * half
    world = (inner - box_from_world[:3, 3]) @ box_from_world[:3, :3]
    mine = old.lattice.centres[old.voxels] @ box_from_world[:3, :3].T + box_from_world[:3, 3]
    in_box = (np.abs(mine) < half + 1.5 * old.lattice.cell).all(-1)
    return float(old.lattice.holds(old.voxels, world.astype(np.float32)).mean()), float(in_box.mean())


@pytest.mark.parametrize(("moved", "photos"), [(True, None), (False, None), (True, 1)])
def test_an_outline_grows_to_all_that_went_along(tmp_path, monkeypatch, moved, photos):
    after = BoxWorld((CRATE.moved(AWAY), DRUM) if moved else (DRUM,))
    ground, olds, changed = begun(tmp_path, monkeypatch, after, photos)
    whole = max(olds, key=lambda o: held(o, CRATE)[0])
    places = whole.lattice.centres[..., 2]
    half = restricted(whole, whole.voxels & (places > np.median(places[whole.voxels])), ground.shape)
    assert held(half, CRATE)[0] < 0.6
    pose = AWAY if moved else None
    grown = with_comoving(ground, half, without(ground, changed, [half]), pose)
    share, own = held(grown, CRATE)
    assert share > 0.85 and own > 0.9
    assert held(grown, DRUM)[0] < 0.15


def test_what_reaches_the_end_of_what_was_asked_is_asked_for_further(tmp_path, monkeypatch):
    ground, olds, changed = begun(tmp_path, monkeypatch, BoxWorld((CRATE.moved(AWAY), DRUM)))
    whole = max(olds, key=lambda o: held(o, CRATE)[0])
    x, _, z = np.moveaxis(whole.lattice.centres, -1, 0)
    far = [at > np.quantile(at[whole.voxels], 0.7) for at in (x, z)]
    corner = restricted(whole, whole.voxels & far[0] & far[1], ground.shape)
    past = without(ground, changed, [corner])
    grown = with_comoving(ground, corner, past, AWAY)
    share, own = held(grown, CRATE)
    assert share > 0.85 and own > 0.9 and held(grown, DRUM)[0] < 0.15
    monkeypatch.setattr(comoving, "_TIMES", 1)
    assert held(with_comoving(ground, corner, past, AWAY), CRATE)[0] < 0.7


def test_what_changed_by_itself_is_no_part_of_another(tmp_path, monkeypatch):
    ground, olds, changed = begun(tmp_path, monkeypatch, BoxWorld((DRUM,)))
    whole = max(olds, key=lambda o: held(o, CRATE)[0])
    places = whole.lattice.centres[..., 2]
    above = places > np.median(places[whole.voxels])
    upper, lower = (restricted(whole, whole.voxels & part, ground.shape) for part in (above, ~above))
    grown = with_comoving(ground, upper, without(ground, changed, [upper, lower]), None, [lower])
    assert not lower.lattice.holds(lower.voxels, grown.lattice.centres[grown.voxels]).any()


def test_a_rest_has_no_other_outline(tmp_path, monkeypatch):
    ground, olds, _ = begun(tmp_path, monkeypatch, BoxWorld((DRUM,)))
    whole = max(olds, key=lambda o: o.voxels.sum())
    places = whole.lattice.centres[..., 2]
    part = restricted(whole, whole.voxels & (places > np.median(places[whole.voxels])), ground.shape)
    rest = rest_of(ground, replace(whole, instead=whole), part)
    assert rest is not None and rest.instead is None
    assert not (rest.voxels & part.voxels).any()
