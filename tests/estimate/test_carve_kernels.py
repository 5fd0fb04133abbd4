"""The kernels of carving against the same in plain numpy, torch and scipy, at double precision."""

from itertools import product

import numpy as np
import pytest
import torch
from scipy import ndimage

from refield.estimate.carve_kernels import Window, count_on_surface, packed
from refield.estimate.hull import HullConfig, look_behind, votes
from refield.estimate.lattice import Lattice, grown
from refield.estimate.look import View
from refield.estimate.objects import Patch
from refield.estimate.outline import carve_solid
from refield.scene.camera import Camera
from refield.scene.capture import Frame
from tests.estimate.boxes import camera_at

CONFIG = HullConfig(surface=8.0)
LENSES = [
    Camera(40, 30, 33.0, 35.0, 19.0, 16.0, 0.1, -0.03, 0.01, -0.02, 0.01),
    Camera(24, 36, 30.0, 30.0, 12.0, 18.0, -0.2, 0.05),
    Camera(32, 32, 40.0, 40.0, 16.0, 16.0),
]


def frame_of(k, tmp_path):
    return Frame(tmp_path / f"{k}.png", LENSES[k], f"{k}.png", camera_at(110 * k, 20 + 15 * k, 1.2))


def depth_of(shape, rng):
    """Surfaces around the middle of the world, and a part where the field is empty."""
    return np.where(rng.random(shape) < 0.2, np.inf, rng.uniform(0.6, 1.8, shape)).astype(np.float32)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def views(tmp_path, rng):
    out = []
    for k, camera in enumerate(LENSES):
        shape = (camera.height, camera.width)
        blank = np.zeros((*shape, 3), np.float32)
        out.append(View(frame_of(k, tmp_path), camera, blank, blank, depth_of(shape, rng), np.zeros(shape)))
    return out


@pytest.fixture
def points(rng):
    """In view, beside it, behind the cameras, at one, and nowhere."""
    cloud = rng.uniform(-2, 2, (20_000, 3))
    cloud[::2] *= 0.3
    odd = [[np.nan, 0, 0], [np.inf, 0, 0], [0, -np.inf, np.inf], [1e30, 0, 0], camera_at(0, 20, 1.2)[:3, 3].tolist()]
    return np.concatenate([cloud, odd]).astype(np.float32)


def looked_at(frame, camera, points):
    """Pixels (N, 2), whether in the image, and distances, as the kernels should find them."""
    m = frame.world_from_cam
    local = (torch.from_numpy(points).double() - m[:3, 3]) @ m[:3, :3]
    uv, z = camera.project(local)
    size = torch.tensor([camera.width, camera.height])
    inside = (z > 1e-6) & (uv >= 0).all(-1) & (uv < size).all(-1)
    pixel = torch.where(inside[:, None], uv, torch.zeros_like(uv)).floor().long()
    return pixel.numpy(), inside.numpy(), local.norm(dim=-1).numpy()


def seen_by(view, points, image):
    pixel, inside, distance = looked_at(view.frame, view.camera, points)
    depth, value = (a[pixel[:, 1], pixel[:, 0]] for a in (view.depth, image))
    return inside, distance, depth, value, CONFIG.surface * view.pixel_angle * distance


def test_votes_are_counted(views, points, rng):
    masks = [rng.random(v.shape) < 0.5 for v in views]
    inside, against = votes(points, list(zip(views, masks)), CONFIG)
    shown, denied = np.zeros(len(points), int), np.zeros(len(points), int)
    for view, mask in zip(views, masks):
        seen, distance, front, marked, slack = seen_by(view, points, mask)
        shown += seen & marked
        denied += seen & ~marked & (distance < front + slack)
    assert set(shown) == set(denied) == {0, 1, 2, 3}
    np.testing.assert_array_equal(inside, shown)
    np.testing.assert_array_equal(against, denied)


def test_what_is_behind_a_surface_is_measured_where_it_is_least(views, points):
    through, behind = look_behind(points, views, CONFIG)
    passed, least = np.zeros(len(points), bool), np.full(len(points), np.inf)
    for view in views:
        seen, distance, front, _, slack = seen_by(view, points, view.depth)
        passed |= seen & (distance < front - slack)
        least = np.minimum(least, np.where(seen & np.isfinite(front), distance - front, np.inf))
    assert 0.1 < passed.mean() < 0.9 and 0.1 < np.isinf(least).mean() < 0.9
    np.testing.assert_array_equal(through, passed)
    np.testing.assert_allclose(behind, least, atol=1e-6)


def times_on_surface(points, views, far):
    lenses, depths = packed(Window(v.camera, v.frame.world_from_cam, v.depth) for v in views)
    out = np.zeros(len(points), np.uint16)
    slack = np.array([2 * CONFIG.surface * v.pixel_angle for v in views])
    count_on_surface(points, lenses, depths, slack, far, out)
    return out


@pytest.mark.parametrize("far", [1e9, 0.5])
def test_views_that_show_a_point_on_a_surface_are_counted(views, points, far):
    found = np.zeros(len(points), int)
    for view in views:
        seen, distance, front, _, slack = seen_by(view, points, view.depth)
        nothing = np.isinf(front) & (distance > far)
        found += seen & ((np.abs(front - distance) < 2 * slack) | nothing)
    assert {0, 1, 2} <= set(found)
    np.testing.assert_array_equal(times_on_surface(points, views, far), found)


def test_without_views_nothing_is_known(points):
    assert not any(a.any() for a in votes(points, [], CONFIG))
    through, behind = look_behind(points, [], CONFIG)
    assert not through.any() and np.isinf(behind).all()
    assert not times_on_surface(points, [], 1.0).any()


@pytest.mark.parametrize(("through", "deepest"), [(0.0, 0.3), (0.4, 0.1), (1.0, 9.0)])
def test_the_solid_is_carved_by_rectangles_of_views(tmp_path, rng, through, deepest):
    boxes = [(5, 3, 38, 28), (0, 10, 24, 36), (8, 8, 30, 20)]
    patches = []
    for k, (x0, y0, x1, y1) in enumerate(boxes):
        depth = depth_of((y1 - y0, x1 - x0), rng)
        patches.append(Patch(frame_of(k, tmp_path), LENSES[k], boxes[k], np.zeros((*depth.shape, 3)), depth))
    lattice = Lattice.over(np.full(3, -0.7, np.float32), np.array([0.8, 0.6, 0.9], np.float32), 30)
    points = lattice.centres.reshape(-1, 3)
    passed, least = np.zeros(len(points)), np.full(len(points), np.inf)
    for patch in patches:
        x0, y0, x1, y1 = patch.box
        pixel, inside, distance = looked_at(patch.frame, patch.camera, points)
        inside &= ((pixel >= (x0, y0)) & (pixel < (x1, y1))).all(-1)
        pixel = np.where(inside[:, None], pixel - (x0, y0), 0)
        behind = np.where(inside, distance - patch.depth[pixel[:, 1], pixel[:, 0]], np.inf)
        passed += behind < -0.75 * lattice.cell
        least = np.minimum(least, behind)
    expected = ((passed <= through * len(patches)) & (least < deepest)).reshape(lattice.shape)
    assert 0 < expected.sum() < expected.size
    np.testing.assert_array_equal(carve_solid(lattice, patches, through, deepest), expected)
    assert not carve_solid(lattice, [], through, deepest).any()


@pytest.mark.parametrize("steps", [-1, 0, 1, 2, 5, 30])
def test_voxels_grow(rng, steps):
    for shape, share in product([(12, 17, 9), (1, 20, 5)], [0.0, 0.003, 0.2]):
        voxels = rng.random(shape) < share
        for within in (None, rng.random(shape) < 0.3, rng.random(shape) < 0.6):
            cube = np.ones((3, 3, 3), bool)
            expected = ndimage.binary_dilation(voxels, cube, iterations=max(steps, 0), mask=within) if steps else voxels
            np.testing.assert_array_equal(grown(voxels, steps, within), expected)


def test_points_are_held_by_the_voxel_they_round_to():
    rng = np.random.default_rng(4)
    lattice = Lattice(np.array([-0.3, 0.1, 0.2], np.float32), 0.04, (9, 7, 5))
    voxels = rng.random(lattice.shape) < 0.5
    points = (lattice.low + lattice.cell * rng.uniform(-2, 11, (4000, 3))).astype(np.float32)
    points[:3] = [[np.nan, 0, 0], [np.inf, 0, 0], [0, -np.inf, 0]]
    ijk, inside = lattice.index(points)
    expected = inside & voxels[tuple(ijk.T)]
    real = np.isfinite(points).all(-1)
    clear = ~real  # of the border between two voxels, where rounding decides
    clear[real] = np.abs((points[real] - lattice.low) / lattice.cell % 1 - 0.5).min(-1) > 1e-3
    assert expected.any() and (lattice.holds(voxels, points) == expected)[clear].all()
