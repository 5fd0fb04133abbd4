"""An outline that holds two things that touch is cut where they meet."""

import numpy as np
import pytest
import torch

from refield.estimate.lattice import Lattice
from refield.estimate.objects import Old, corners_of, look_around, surface_cloud
from refield.estimate.outline import ObjectConfig, carve_solid, restricted
from refield.estimate.split import halves
from tests.estimate.boxes import BoxWorld, camera_at, photograph, standing

CRATE = standing((0.18, 0.18, 0.2), -0.18, 0.0, 0, paint=-1)
LOW, HIGH = np.array([-0.45, -0.35, 0.02], np.float32), np.array([0.5, 0.35, 0.6], np.float32)


def seen_as_one(tmp_path, other) -> Old:
    world = BoxWorld((CRATE, other))
    frames = photograph(world, tmp_path, [camera_at(45 * k, 34) for k in range(8)])
    patches = look_around(world, frames, corners_of(LOW, HIGH), 60_000)
    lattice = Lattice.over(LOW, HIGH, 48)
    voxels = carve_solid(lattice, patches, 0.05, 0.8)
    free = np.ones(lattice.shape, bool)
    return Old(lattice, voxels, free, surface_cloud(lattice, voxels, patches, 1500), tuple(patches))


def share_of(box, old: Old) -> float:
    return float(box.inside(torch.from_numpy(old.lattice.centres[old.voxels])).float().mean())


@pytest.mark.parametrize(
    "other",
    [
        standing((0.08, 0.08, 0.28), 0.08, 0.05, 0, paint=-1),  # as red as the crate; only its shape tells it apart
        standing((0.18, 0.18, 0.2), 0.18, 0.0, 0, paint=4),  # as high and as wide, and painted
    ],
    ids=["shape", "colour"],
)
def test_things_that_touch_are_cut_apart_where_they_meet(tmp_path, other):
    whole = seen_as_one(tmp_path, other)
    assert max(share_of(CRATE, whole), share_of(other, whole)) < 0.85
    (one, rest), (again, first) = halves(whole, ObjectConfig())
    assert again is rest and first is one
    assert not (one.voxels & rest.voxels).any() and ((one.voxels | rest.voxels) == whole.voxels).all()
    red = max(one, rest, key=lambda o: share_of(CRATE, o))
    assert share_of(CRATE, red) > 0.85
    assert share_of(other, rest if red is one else one) > 0.85


def test_a_crumb_is_not_cut(tmp_path):
    whole = seen_as_one(tmp_path, standing((0.08, 0.08, 0.28), 0.08, 0.05, 0, paint=-1))
    crumb = np.zeros_like(whole.voxels)
    crumb[tuple(np.argwhere(whole.voxels)[:3].T)] = True
    assert halves(restricted(whole, crumb, ObjectConfig()), ObjectConfig()) == []
