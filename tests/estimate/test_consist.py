"""What photos agree on of a newcomer's surface."""

import numpy as np
import pytest
import torch

from refield.estimate.consist import colours_of_others
from refield.estimate.lattice import Body, Lattice
from refield.estimate.look import View
from refield.scene.camera import Camera
from refield.vision import pixels

SIDE, SHIFT = 60, 8  # pixels; by how many the wall is shifted from one camera to the next


def view_of(k: int, wide: np.ndarray) -> View:
    """One of three cameras side by side before a wall one metre away."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = k * SHIFT / 100
    camera = Camera(SIDE, SIDE, 100.0, 100.0, SIDE / 2, SIDE / 2)
    frame = type("F", (), {"world_from_cam": pose, "camera": camera, "name": "x"})()
    photo = np.ascontiguousarray(wide[:, k * SHIFT : k * SHIFT + SIDE])
    return View(frame, camera, photo, photo, np.ones((SIDE, SIDE), np.float32), np.ones((SIDE, SIDE), np.float32))


@pytest.mark.parametrize(("away", "right"), [(1.0, True), (0.6, False)])
def test_the_others_show_the_same_of_a_surface_where_it_is(away, right):
    """And something else where it is not; nothing where they do not look."""
    wide = np.random.default_rng(0).random((SIDE, SIDE + 2 * SHIFT, 3)).astype(np.float32)
    views = [view_of(k, pixels.blur(wide, 2.0)) for k in range(3)]
    lattice = Lattice.over(np.array([-0.1, -0.1, away]), np.array([0.26, 0.1, away]), 72)
    body = Body(lattice, np.ones(lattice.shape, bool))
    everywhere = np.ones((SIDE, SIDE), bool)
    for view, told in zip(views, colours_of_others(body, [(v, everywhere) for v in views])):
        known = np.isfinite(told[..., 0])
        assert 0.1 < known.mean() < 0.9
        near = np.abs(told - view.photo)[known].mean() < 0.01
        assert near == right
    (alone,) = colours_of_others(body, [(views[0], everywhere)])
    assert np.isnan(alone).all()
    hidden = [(view, everywhere if k == 0 else ~everywhere) for k, view in enumerate(views)]
    assert np.isnan(colours_of_others(body, hidden)[0]).all()
