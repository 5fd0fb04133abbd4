"""An object's shape, by old views from all sides and from some only."""

import numpy as np
import torch

from refield.estimate.lattice import Lattice
from refield.estimate.objects import corners_of, look_around
from refield.estimate.outline import ObjectConfig, carve_solid, free_voxels, seen_as
from refield.scene.planes import Plane
from tests.estimate.boxes import BoxWorld, camera_at, photograph, standing

CRATE = standing((0.2, 0.17, 0.18), 0.0, 0.0, 20, paint=3)
FLOOR = Plane(np.array([0, 0, 1], np.float32), 0.0, 0.005)


def test_what_nobody_saw_behind_an_object_is_not_of_it(tmp_path):
    """Cameras on one side only: all that is in the lee of the crate might be solid."""
    world = BoxWorld((CRATE,))
    before = photograph(world, tmp_path, [camera_at(azimuth, 14) for azimuth in range(-30, 31, 12)])
    low, high = np.array([-0.7, -0.4, -0.05], np.float32), np.array([0.4, 0.4, 0.5], np.float32)
    patches = look_around(world, before, corners_of(low, high), 40_000)
    lattice = Lattice.over(low, high, 56)
    free = free_voxels(lattice, [FLOOR])
    solid = carve_solid(lattice, patches, 0.05, 1.0) & free
    true = CRATE.inside(torch.from_numpy(lattice.centres).double()).numpy()
    old = seen_as(lattice, solid, free, patches, [FLOOR], ObjectConfig())
    assert old is not None

    def overlap(voxels) -> float:
        return float((voxels & true).sum() / (voxels | true).sum())

    assert overlap(old.voxels) > overlap(solid) + 0.03
    assert (old.voxels & true).sum() > 0.97 * (solid & true).sum()
