"""Carving with oracle masks returns the object; planes that hold things up are found and nothing else."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from refield.estimate import associate, recipe
from refield.estimate.detect import Changed
from refield.estimate.hull import HullConfig, carve, find_regions
from refield.estimate.lattice import Lattice, components
from refield.estimate.look import median_depth, view_of
from refield.field.volrend import Samples
from refield.scene.planes import EXACT, Plane, _edges, holds_up, rough_planes, support_planes, support_tops
from tests.estimate.boxes import BoxWorld, camera_at, photograph, standing

CRATE = standing((0.2, 0.17, 0.18), -0.1, -0.1, 20)


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """Four views of the world with the crate, and where they show it."""
    folder = tmp_path_factory.mktemp("photos")
    frames = photograph(BoxWorld((CRATE,)), folder, [camera_at(20 + 90 * k, 34) for k in range(4)])
    return [view_of(BoxWorld((CRATE,)), f, 10_000) for f in frames]


def true_mask(view):
    inward = torch.from_numpy(view.surface + 0.02 * view.directions)
    return CRATE.inside(torch.nan_to_num(inward)).numpy() & np.isfinite(view.depth)


def test_no_mask_no_region(views):
    nothing = np.zeros(views[0].shape, bool)
    changed = [Changed(v, nothing, nothing, nothing, nothing, nothing) for v in views]
    assert find_regions(changed, HullConfig(), 0.0) == []


SMALL = standing((0.06, 0.05, 0.08), 0.55, 0.45, 0, paint=3)


def test_a_small_thing_beside_a_large_one_has_voxels_of_its_own(tmp_path):
    world = BoxWorld((CRATE, SMALL))
    frames = photograph(world, tmp_path, [camera_at(20 + 90 * k, 34) for k in range(4)])
    views = [view_of(world, f, 10_000) for f in frames]
    inward = [torch.nan_to_num(torch.from_numpy(v.surface + 0.01 * v.directions)) for v in views]
    shown = [(CRATE.inside(p) | SMALL.inside(p)).numpy() & np.isfinite(v.depth) for v, p in zip(views, inward)]
    blank = np.zeros(views[0].shape)
    changed = [Changed(v, blank, blank, m, *np.zeros((2, *m.shape), bool)) for v, m in zip(views, shown)]
    config, seen = HullConfig(), list(zip(views, shown))
    hulls = [carve(place, seen, views, (), config) for place in find_regions(changed, config, 0.003)]
    for box in (CRATE, SMALL):
        mine = [h for h in hulls if box.inside(torch.from_numpy(h.lattice.centres[h.hull])).any()]
        assert len(mine) == 1
        inside = box.inside(torch.from_numpy(mine[0].lattice.centres)).numpy()
        assert inside.sum() > 40 and mine[0].hull[inside].mean() > 0.9
    larger = max(float(m.mean()) for m in shown)
    assert find_regions(changed, config, 1.1 * larger) == []  # nothing is as large as that


def test_the_floor_holds_up_and_the_lid_does_not(views):
    points = np.concatenate([v.surface.reshape(-1, 3) for v in views])
    points = points[np.isfinite(points).all(-1)]
    cameras = np.stack([v.centre for v in views])
    planes = support_planes(points, cameras, 0.012)
    assert len(planes) == 1
    np.testing.assert_allclose(planes[0].normal, [0, 0, 1], atol=0.01)
    assert abs(planes[0].offset) < 0.01


def test_median_depth_is_where_half_the_light_is_stopped():
    # one ray through a slab of sigma 2 from t = 1: half is stopped ln(2) / 2 further on; one ray through nothing
    t = torch.arange(10) * 0.1 + 1.0
    samples = Samples(t, t + 0.1, torch.tensor([0, 10, 10]))
    depth = median_depth(torch.full((10,), 2.0), samples)
    assert float(depth[0]) == pytest.approx(1 + np.log(2) / 2, abs=1e-5)
    assert torch.isinf(depth[1])


def test_lattice_knows_what_lies_in_a_voxel():
    lattice = Lattice.over(np.zeros(3, np.float32), np.array([1, 2, 0.5], np.float32), 20)
    voxels = np.zeros(lattice.shape, bool)
    voxels[3, 4, 2] = voxels[10, 10, 2] = True
    points = lattice.centres[voxels] + 0.3 * lattice.cell
    assert lattice.holds(voxels, points).all()
    assert not lattice.holds(voxels, points + lattice.cell).any()
    assert not lattice.holds(voxels, np.array([[9.0, 0, 0], [np.nan, 0, 0]])).any()
    assert [p.sum() for p in components(voxels, 1)] == [1, 1] and components(voxels, 2) == []
    grid = lattice.grid(voxels.astype(np.float32))
    assert grid.contains(torch.from_numpy(lattice.centres))[3, 4, 2]


def test_a_view_finds_its_own_surface_again(views):
    view = views[0]
    uv, distance, inside = view.project(view.surface)
    seen = np.isfinite(view.depth)
    i, j = np.nonzero(seen)
    np.testing.assert_allclose(uv[seen], np.stack([j, i], -1) + 0.5, atol=2e-2)
    np.testing.assert_allclose(distance[seen], view.depth[seen], rtol=1e-4)
    assert inside[seen].all()
    assert view.lookup(view.depth, uv, inside)[i[0], j[0]] == view.depth[i[0], j[0]]
    assert replace(view, depth=view.depth).surface.shape == (*view.shape, 3)


@pytest.mark.parametrize(
    ("shown", "apart", "crumb"),
    [
        ((3, 3), 1.5, False),  # as much as the price in either
        ((3, 0), 1.5, False),  # a photo that does not show it costs nothing
        ((3, 3), 0.5, True),  # not changed by as much as counts
        ((2, 2), 1.5, True),  # too small
        ((2, 2), 6.0, False),  # small, and plainly not there
    ],
)
def test_a_crumb_is_what_would_not_pay_for_a_body(monkeypatch, shown, apart, crumb):
    """Of photos of 1000 pixels, of which a body must explain 2.7 that are as wrong as a pose may be."""
    sizes = iter(shown)

    def silhouette(view, old):
        mask = np.zeros((10, 100), bool)
        mask[0, : next(sizes)] = True
        return mask

    monkeypatch.setattr(associate, "silhouette", silhouette)
    ground = SimpleNamespace(believe=SimpleNamespace(smallest=0.003))
    of_photo = SimpleNamespace(view=None, difference=np.full((10, 100), apart), threshold=np.ones((10, 100)))
    assert associate.is_crumb(ground, [of_photo] * 2, None) is crumb


def table_and_floor(count=4000, seed=0):
    """Points on a table top 1 x 1 at height 0.7 and on the floor beside and around it, seen from above all around."""
    rng = np.random.default_rng(seed)
    top = np.concatenate([rng.uniform(-0.5, 0.5, (count, 2)), np.full((count, 1), 0.7)], -1)
    floor = np.concatenate([rng.uniform(-2, 2, (count, 2)), np.zeros((count, 1))], -1)
    points = np.concatenate([top, floor])
    points[:, 2] += 0.003 * rng.normal(size=len(points))
    around = rng.uniform(0, 2 * np.pi, len(points))
    eyes = np.stack([2 * np.cos(around), 2 * np.sin(around), np.full(len(points), 1.6)], -1)
    part = (eyes[:, 2] - 0.7) / (eyes[:, 2] - points[:, 2])  # of the way to where the table's height is met
    met = eyes + part[:, None] * (points - eyes)
    hidden = (points[:, 2] < 0.5) & (np.abs(met[:, :2]) < 0.5).all(-1)
    return points[~hidden].astype(np.float32), eyes[~hidden].astype(np.float32)


def test_a_table_top_ends_and_the_floor_is_seen_beside_it():
    points, eyes = table_and_floor()
    everything = np.ones(len(points), bool)
    top = next(p for p in support_tops(points, eyes, everything, EXACT * 0.012) if p.offset > 0.5)
    np.testing.assert_allclose(top.normal, [0, 0, 1], atol=0.02)
    assert top.offset == pytest.approx(0.7, abs=0.005)
    asked = np.array([[0, 0, 0.9], [0.4, -0.4, 0.5], [0.9, 0, 0.5], [0, -1.2, 0.9]], np.float32)
    np.testing.assert_allclose(top.above(asked), [0.2, -0.2, np.inf, np.inf], atol=0.02)
    assert not any(p.offset > 0.5 for p in rough_planes(points, eyes, 0.012))  # which asks that nothing is beneath


def test_what_moved_holds_nothing_up():
    points, eyes = table_and_floor()
    still = points[:, 2] < 0.5
    for rough in (1, 2, 4):
        assert not any(p.offset > 0.5 for p in support_tops(points, eyes, still, rough * EXACT * 0.012))


def test_what_is_behind_the_side_of_a_thing_does_not_stand_on_it():
    """The side of a cupboard that stayed is as even, and ends, as the top of a table does."""
    points, eyes = table_and_floor()
    everything = np.ones(len(points), bool)
    top = next(p for p in support_tops(points, eyes, everything, EXACT * 0.012) if p.offset > 0.5)
    box = np.random.default_rng(1).uniform([-0.1, -0.1, 0.7], [0.1, 0.1, 0.9], (500, 3)).astype(np.float32)
    tol = EXACT * 0.012
    assert holds_up(top, box, tol)
    assert not holds_up(top, box - np.float32([0, 0, 0.3]), tol)
    assert holds_up(top, box + np.float32([2, 0, -0.3]), tol)  # of what is beside it nothing is known
    assert holds_up(top, np.concatenate([box, box[:400] - np.float32([0, 0, 0.3])]), tol)
    on_top = np.concatenate([points[points[:, 2] > 0.5][:600], box[:500] - np.float32([0, 0, 0.3])])
    assert holds_up(top, on_top, tol)


def test_only_planes_that_hold_up_what_changed_count(monkeypatch, views):
    floor, above = (Plane(np.float32([0, 0, 1]), height, 0.003) for height in (0.0, 1.5))
    blank = np.zeros(views[0].shape)
    changed = [Changed(v, blank, blank, true_mask(v), *np.zeros((2, *v.shape), bool)) for v in views]
    for sought, others in (("support_planes", "support_tops"), ("support_tops", "support_planes")):
        monkeypatch.setattr(recipe, sought, lambda *_: [above, floor])
        monkeypatch.setattr(recipe, others, lambda *_: [])
        assert recipe._planes(views, changed) == [floor]
    monkeypatch.setattr(recipe, "support_planes", lambda *_: [above])  # which is no reason to look for no others
    assert recipe._planes(views, changed) == [floor]


def test_a_slice_of_what_fills_space_is_no_plane():
    points = np.random.default_rng(0).uniform(0, 0.1, (4000, 3)).astype(np.float32)
    eyes = np.tile(np.array([0.05, 0.05, 3], np.float32), (4000, 1))
    for rough in (1, 2, 4):
        assert support_tops(points, eyes, np.ones(4000, bool), rough * EXACT * 0.004) == []


def test_a_strip_of_points_has_edges_too():
    """All on one line, from which no area could be told."""
    line = np.stack([np.linspace(-1, 1, 500), np.zeros(500), np.zeros(500)], -1)
    edges = _edges(Plane(np.array([0, 0, 1], np.float32), 0.0, 0.01), line, 0.02)
    strip = Plane(np.array([0, 0, 1], np.float32), 0.0, 0.01, edges)
    asked = np.array([[0, 0.01, 0.3], [0.9, 0, -0.3], [0, 0.1, 0.3], [1.2, 0, 0.3]])
    np.testing.assert_allclose(strip.above(asked), [0.3, -0.3, np.inf, np.inf], atol=1e-6)
