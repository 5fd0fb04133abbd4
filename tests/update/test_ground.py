"""Where something stood on a plane, all above the plane is empty once it has left."""

import numpy as np
import torch

from refield.scene.capture import Rays
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.planes import Plane
from refield.update.ground import planes_around
from refield.update.helper import emptiness
from refield.update.region import Region, meets, move_out

EYES = torch.tensor([[1.0, 0, 1], [-1, 0, 1], [0, 1, 1], [0, -1, 1.2]])


def box_at(z):
    """A box of 0.4 that stands at the height z."""
    values = torch.zeros(24, 24, 24)
    values[2:-2, 2:-2, 2:-2] = 1
    aabb = torch.tensor([[-0.22, -0.22, z - 0.02], [0.22, 0.22, z + 0.42]])
    return ObjectChange("removed", OccupancyGrid(aabb, values))


def floor_points(count):
    xy = torch.rand(count, 2) * 1.6 - 0.8
    return torch.cat([xy, 0.002 * torch.randn(count, 1)], 1)


def asked(change, x, planes, taken=()):
    """What `emptiness` says at world points (N, 3)."""
    cells = move_out(change, 1.5).sampler(0.02)
    return emptiness(change, cells, Region(taken), planes)[cells.cells(x)]


def test_the_floor_is_found_around_what_left():
    torch.manual_seed(0)
    box = torch.tensor([[-0.3, -0.3, 0.0], [0.3, 0.3, 0.5]])
    (plane,) = planes_around(floor_points(2000), box, EYES, 0.01)
    assert plane.normal[2] > 0.999 and abs(plane.offset) < 0.002
    assert planes_around(floor_points(20), box, EYES, 0.01) == []
    assert planes_around(torch.rand(2000, 3), box, EYES, 0.01) == []  # nothing flat


def test_above_the_floor_that_it_stood_on_is_nothing():
    torch.manual_seed(0)
    planes = planes_around(floor_points(2000), torch.tensor([[-0.3, -0.3, 0.0], [0.3, 0.3, 0.5]]), EYES, 0.01)
    standing = SceneChange((box_at(0.0),))
    skin = torch.tensor([[0.17, 0.0, 0.2], [0.0, 0.0, 0.37]])  # just inside of a side and the top
    ground = torch.tensor([[0.0, 0.0, 0.01], [0.1, -0.1, 0.03]])
    assert (asked(standing, skin, ()) == 0).all()  # another thing may have been there, as far as is known
    assert (asked(standing, skin, planes) == 0.5).all()
    assert (asked(standing, skin, planes, (box_at(0.0).grid,)) == 0).all()  # something stands there now
    assert (asked(standing, ground, planes) == 0).all()
    outside = torch.tensor([[0.26, 0.0, 0.2]])
    assert (asked(standing, outside, planes) == 0).all()


def test_a_plane_that_it_did_not_touch_says_nothing():
    torch.manual_seed(0)
    planes = planes_around(floor_points(2000), torch.tensor([[-0.3, -0.3, 0.0], [0.3, 0.3, 0.5]]), EYES, 0.01)
    above = SceneChange((box_at(0.3),))
    bottom = torch.tensor([[0.0, 0.0, 0.315]])
    assert (asked(above, bottom, planes) == 0).all()


def test_a_grid_that_holds_nothing_says_nothing():
    empty = OccupancyGrid(torch.tensor([[-0.2, -0.2, 0.0], [0.2, 0.2, 0.4]]), torch.zeros(8, 8, 8))
    planes = [Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)]
    assert (asked(SceneChange((ObjectChange("removed", empty),)), torch.zeros(1, 3), planes) == 0).all()


def test_rays_meet_a_region_as_its_cells_say():
    torch.manual_seed(1)
    sampler = move_out(SceneChange((box_at(0.0),)), 1.5).sampler(0.02)
    origins = torch.randn(400, 3)
    aims = 0.6 * torch.rand(400, 3) - 0.3
    rays = Rays(origins, torch.nn.functional.normalize(aims - origins, dim=-1))
    met = meets(sampler, rays)
    assert 20 < int(met.sum()) < 380
    assert torch.equal(met, sampler(rays).ray_offsets.diff() > 0)
