"""Which voxels belong to which thing: cut by colour and depth, joined over views."""

import numpy as np
import pytest
import torch

from refield.estimate.detect import Changed
from refield.estimate.faces import changed_parts
from refield.estimate.hull import HullConfig, carve
from refield.estimate.lattice import Lattice
from refield.estimate.look import view_of
from refield.scene.planes import Plane
from refield.vision.segmenter import GrabCutSegmenter
from tests.estimate.boxes import BoxWorld, camera_at, photograph, standing

CRATE = standing((0.18, 0.18, 0.2), -0.15, 0.0, 15, paint=3)
DRUM = standing((0.18, 0.18, 0.25), 0.3, 0.25, -20, paint=5)


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    world = BoxWorld((CRATE, DRUM))
    frames = photograph(world, tmp_path_factory.mktemp("photos"), [camera_at(20 + 90 * k, 34) for k in range(4)])
    return [view_of(world, f, 10_000) for f in frames]


def shown(view, box):
    return box.inside(torch.nan_to_num(torch.from_numpy(view.surface + 0.02 * view.directions))).numpy()


def parts_of(views, masks):
    blank = np.zeros(views[0].shape)
    changed = [Changed(v, blank, blank, m, *np.zeros((2, *m.shape), bool)) for v, m in zip(views, masks)]
    lattice = Lattice.over(np.array([-0.7, -0.5, -0.05], np.float32), np.array([0.8, 0.8, 0.7], np.float32), 60)
    floor = Plane(np.array([0, 0, 1], np.float32), 0.0, 0.01)
    carved = carve(lattice, list(zip(views, masks)), views, [floor], HullConfig())
    return changed_parts(changed, [carved], HullConfig(smallest=20), GrabCutSegmenter())


def share_in(box, part):
    return float(box.inside(torch.from_numpy(part.body.places)).float().mean())


def test_two_things_that_changed_are_two_parts(views):
    parts = parts_of(views, [shown(v, CRATE) | shown(v, DRUM) for v in views])
    for box in (CRATE, DRUM):
        mine = [t for t in parts.things if share_in(box, t) > 0.7]
        assert len(mine) == 1 and mine[0].body.volume > 0.5 * 8 * float(np.prod(box.half))


def test_a_part_of_what_goes_on_outside_of_the_mask_is_no_thing(views):
    """A newcomer hides a strip of the drum from every side; the crate left."""
    strip = [shown(v, DRUM) & (v.surface[..., 2] > 0.1) & (v.surface[..., 2] < 0.3) for v in views]
    parts = parts_of(views, [shown(v, CRATE) | s for v, s in zip(views, strip)])
    thing = parts.things[0]
    assert share_in(CRATE, thing) > 0.7
    (hidden,) = [p for p in parts.others if share_in(DRUM, p) > 0.7]
    assert thing.where[thing.voxels].mean() > 0.8 and hidden.where[hidden.voxels].mean() < 0.1
