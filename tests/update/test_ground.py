"""Where something stood on a plane, all above the plane is empty once it has left."""

from dataclasses import replace

import numpy as np
import torch

from refield.scene.capture import Rays
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.planes import Plane
from refield.update.ground import Foothold, footholds, planes_around
from refield.update.helper import emptiness
from refield.update.region import Region, meets, move_out
from refield.update.unseen import Sight

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


def grids_of(change):
    return [o.grid for o in change.objects]


def asked(change, x, planes, taken=()):
    """What `emptiness` says at world points (N, 3)."""
    cells = move_out(change, 1.5).sampler(0.02)
    return emptiness(change, cells, Region(taken), footholds(grids_of(change), planes))[cells.cells(x)]


def test_the_floor_is_found_around_what_left():
    torch.manual_seed(0)
    box = torch.tensor([[-0.3, -0.3, 0.0], [0.3, 0.3, 0.5]])
    (plane,) = planes_around(floor_points(2000), box, EYES, 0.01, torch.Generator().manual_seed(0))
    assert plane.normal[2] > 0.999 and abs(plane.offset) < 0.002
    assert planes_around(floor_points(20), box, EYES, 0.01, torch.Generator().manual_seed(0)) == []
    assert planes_around(torch.rand(2000, 3), box, EYES, 0.01, torch.Generator().manual_seed(0)) == []  # nothing flat


def test_above_the_floor_that_it_stood_on_is_nothing():
    torch.manual_seed(0)
    planes = planes_around(
        floor_points(2000),
        torch.tensor([[-0.3, -0.3, 0.0], [0.3, 0.3, 0.5]]),
        EYES,
        0.01,
        torch.Generator().manual_seed(0),
    )
    standing = SceneChange((box_at(0.0),))
    skin = torch.tensor([[0.17, 0.0, 0.2], [0.0, 0.0, 0.37]])  # just inside of a side and the top
    ground = torch.tensor([[0.0, 0.0, 0.01], [0.1, -0.1, 0.03]])
    assert (asked(standing, skin, ()) == 0).all()  # another thing may have been there, as far as is known
    assert (asked(standing, skin, planes) == 0.5).all()
    assert (asked(standing, skin, planes, (box_at(0.0).grid,)) == 0).all()  # something stands there now
    at, near = asked(standing, ground, planes).tolist()
    assert at < 0.05 < near < 0.3  # the less so the nearer
    outside = torch.tensor([[0.26, 0.0, 0.2]])
    assert (asked(standing, outside, planes) == 0).all()


def test_beneath_the_floor_is_nothing_either_the_less_so_the_nearer():
    standing = SceneChange((box_at(0.0),))
    planes = [Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)]
    under = torch.tensor([[0.0, 0.0, z] for z in (0.0, -0.03, -0.09)])
    at, near, deep = asked(standing, under, planes).tolist()
    assert at < 0.1 < near < 0.5 == deep
    assert (asked(standing, under, ()) == 0).all()
    beside = torch.tensor([[0.3, 0.0, -0.09]])
    assert (asked(standing, beside, planes) == 0).all()  # the edge of a table, as far as is known


def test_rays_enter_the_ground_where_the_object_stood_and_only_from_above():
    (foothold,) = footholds([box_at(0.0).grid], [Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)])
    down, level = [0.0, 0.6, -0.8], [0.0, 1.0, 0.0]
    rays = Rays(
        torch.tensor([[0.0, -0.75, 1.0], [0.0, 0.75, 1.0], [0.0, 0.0, 0.3], [0.0, 0.0, -1.0]]),
        torch.tensor([down, down, level, [0.0, 0.0, 1.0]]),
    )
    torch.testing.assert_close(foothold.entered(rays), torch.tensor([1.25] + 3 * [torch.inf]))
    assert footholds([box_at(0.3).grid], [foothold.plane]) == []
    assert isinstance(foothold, Foothold) and foothold.holds(torch.tensor([[0.0, 0.0, -5.0]])).all()


def test_what_was_looked_through_is_empty_and_what_was_seen_beneath_the_floor_may_be_there():
    cells = move_out(SceneChange((box_at(0.0),)), 1.5).sampler(0.02)
    planes = [Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)]
    x = torch.tensor([[0.26, 0.0, 0.2], [0.05, 0.05, -0.09], [-0.05, 0.05, -0.09]])
    free, hidden, leg = cells.cells(x)
    empty = replace(cells, grid=torch.zeros_like(cells.grid))
    before = torch.tensor([3.0, -3.0, -1.0])
    sight = Sight(empty, torch.stack([free, hidden, leg]), before, before)
    found = emptiness(SceneChange((box_at(0.0),)), cells, Region(()), footholds([box_at(0.0).grid], planes), sight)
    assert found[free] == 1 and found[hidden] == 0.5 and found[leg] == 0


def test_the_skin_that_the_old_field_shows_around_what_left_is_as_empty_as_its_rim():
    cells = move_out(SceneChange((box_at(0.0),)), 1.5).sampler(0.02)
    planes = [Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)]
    x = torch.tensor([[0.22, 0.0, 0.2], [0.28, 0.0, 0.2], [0.0, 0.22, -0.04]])  # its side is at 0.19
    coarse = replace(cells, grid=torch.ones(32, 32, 32, dtype=torch.uint8))
    assert 0.03 < coarse.width(torch.tensor(0.5)) < 0.05
    seen = Sight(coarse, torch.tensor([], dtype=torch.long), torch.tensor([]), torch.tensor([]))
    for ground, tolls in ((footholds([box_at(0.0).grid], planes), [0.5, 0.0, 0.0]), ((), [0.0, 0.0, 0.0])):
        found = emptiness(SceneChange((box_at(0.0),)), cells, Region(()), ground, seen)
        assert found[cells.cells(x)].tolist() == tolls


def test_around_what_is_small_beside_the_old_field_s_cells_only_as_much_as_its_rim_is_as_empty():
    cells = move_out(SceneChange((box_at(0.0),)), 1.5).sampler(0.02)
    planes = [Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)]
    huge = replace(cells, grid=torch.ones(4, 4, 4, dtype=torch.uint8))
    seen = Sight(huge, torch.tensor([], dtype=torch.long), torch.tensor([]), torch.tensor([]))
    x = torch.tensor([[0.21, 0.0, 0.2], [0.26, 0.0, 0.2]])  # its side is at 0.19, its rim 0.05 deep
    found = emptiness(SceneChange((box_at(0.0),)), cells, Region(()), footholds([box_at(0.0).grid], planes), seen)
    assert found[cells.cells(x)].tolist() == [0.5, 0.0]


def test_a_place_that_is_no_object_s_own_is_as_empty():
    """What two places of an object shared, and only its second visit uncovers."""
    planes = [Plane(np.array([0, 0, 1], np.float32), 0.0, 0.002)]
    x = torch.tensor([[0.0, 0.0, 0.2], [0.17, 0.0, 0.2], [0.0, 0.0, -0.09]])
    cells = move_out(SceneChange((box_at(0.0),)), 1.5).sampler(0.02)
    found = emptiness(SceneChange(()), cells, Region(()), footholds([box_at(0.0).grid], planes))[cells.cells(x)]
    assert found.tolist() == [1.0, 0.5, 0.5]


def test_a_plane_that_it_did_not_touch_says_nothing():
    torch.manual_seed(0)
    planes = planes_around(
        floor_points(2000),
        torch.tensor([[-0.3, -0.3, 0.0], [0.3, 0.3, 0.5]]),
        EYES,
        0.01,
        torch.Generator().manual_seed(0),
    )
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
