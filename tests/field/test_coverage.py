"""Right before few cameras nothing may be; what many see, and what is far, may hold something."""

from pathlib import Path

import torch

from refield.field.coverage import knowable
from refield.field.encoding import Contraction
from refield.field.sampling import OccupancySampler
from refield.scene.camera import Camera
from refield.scene.capture import Frame

SAMPLER = OccupancySampler(Contraction(torch.zeros(3), 1.0), torch.ones(64, 64, 64, dtype=torch.uint8), 0.05)


def camera_on_a_ring(turn: float) -> Frame:
    """Two units from the origin, looking at it."""
    t = torch.tensor(turn, dtype=torch.float64)
    z = -torch.stack([t.cos(), t.sin(), t * 0])
    x = torch.stack([-t.sin(), t.cos(), t * 0])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = x, torch.linalg.cross(z, x), z, -2 * z
    return Frame(Path("a.png"), Camera(64, 64, 160, 160, 32, 32), "a", pose)


def allowed(frames: tuple[Frame, ...], *point: float) -> bool:
    return bool(knowable(SAMPLER, frames)[SAMPLER.cells(torch.tensor([point]))])


def test_only_what_several_cameras_see_may_be_before_one() -> None:
    ring = tuple(camera_on_a_ring(0.6 * k) for k in range(5))
    assert not allowed(ring, 1.35, 0.0, 0.0)  # 0.65 before the first camera
    assert allowed(ring, 0.0, 0.0, 0.0)
    assert allowed(ring, -6.0, 0.0, 0.0)  # far away one camera is enough
    assert allowed(ring, 0.0, 0.0, 5.0)  # nobody sees it: nothing is decided


def test_what_is_among_the_cameras_but_in_few_pictures_is_nothing() -> None:
    ring = tuple(camera_on_a_ring(0.2 * k) for k in range(5))
    ring_and_opposite = (*ring, camera_on_a_ring(3.2), camera_on_a_ring(3.3))
    beside = (1.5, 0.0, 0.5)  # 0.7 before the first camera, above its picture; the two opposite see it
    assert not allowed(ring_and_opposite, *beside)
    assert allowed((*ring_and_opposite, camera_on_a_ring(3.1)), *beside)  # a third does
    assert allowed(ring_and_opposite, 1.5, 0.0, 0.8)  # not as near


def test_a_cell_that_only_the_edge_of_a_photo_shows_is_before_its_camera() -> None:
    ring = tuple(camera_on_a_ring(0.6 * k) for k in range(5))
    assert not allowed(ring, 1.35, 0.16, 0.0)  # its middle is outside of the picture, a part of it is not
    assert allowed(ring, 1.35, 0.0, 0.7)  # in no picture, but not as near


def test_one_camera_alone_may_see_anything() -> None:
    assert allowed((camera_on_a_ring(0.0),), 1.35, 0.0, 0.0)
