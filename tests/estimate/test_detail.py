"""Texture that a field has not learnt is taken from old photos, and moves with the object."""

import numpy as np
import torch

from refield.estimate.detail import Detail
from refield.estimate.objects import Patch
from refield.scene.camera import Camera
from refield.scene.capture import Frame

CAMERA = Camera(80, 60, 60.0, 60.0, 40.0, 30.0)


def down_from(tmp_path, x, z):
    """A camera at (x, 0, z) that looks down at the plane z = 0."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    pose[:3, 3] = torch.tensor([x, 0.0, z])
    return Frame(tmp_path / "none.png", CAMERA, "none.png", pose)


def looked_at(frame, box=(0, 0, 80, 60)):
    x0, y0, x1, y1 = box
    v, u = np.mgrid[y0:y1, x0:x1] + 0.5
    slant = np.sqrt(((u - 40) / 60) ** 2 + ((v - 30) / 60) ** 2 + 1)
    depth = (float(frame.centre[2]) * slant).astype(np.float32)
    return Patch(frame, CAMERA, box, np.zeros((*depth.shape, 3), np.float32), depth)


def stripes(patch):
    """What the field lacks: a pattern painted on the plane."""
    x = patch.points[..., 0]
    return np.repeat((0.1 * np.sin(12 * x))[..., None], 3, -1).astype(np.float32)


def test_detail_is_found_where_it_is_painted(tmp_path):
    patches = tuple(looked_at(down_from(tmp_path, x, 2.0)) for x in (-0.2, 0.3))
    detail = Detail(patches, tuple(stripes(p) for p in patches))
    points = torch.tensor([[0.1, 0.05, 0.0], [0.25, -0.2, 0.0], [-0.3, 0.1, 0.0]])
    found = detail.at(points, torch.tensor([0.0, 0.0, 2.0]))
    assert torch.allclose(found[:, 0], 0.1 * torch.sin(12 * points[:, 0]), atol=0.01)


def test_nothing_is_said_where_no_old_photo_looks(tmp_path):
    patch = looked_at(down_from(tmp_path, 0.0, 2.0), (20, 10, 60, 50))
    detail = Detail((patch,), (stripes(patch) + 0.2,))
    eye = torch.tensor([0.0, 0.0, 2.0])
    beside, above, beneath = [5.0, 0.0, 0.0], [0.1, 0.0, 0.5], [0.1, 0.0, -0.5]
    assert (detail.at(torch.tensor([beside, above, beneath]), eye) == 0).all()
    assert (detail.at(torch.tensor([[0.1, 0.0, 0.0]]), torch.tensor([0.0, 0.0, -2.0])) == 0).all()  # from behind
    assert (Detail((), ()).at(torch.zeros(2, 3), eye) == 0).all()
    assert detail.at(torch.zeros(0, 3), eye).shape == (0, 3)


def test_the_photo_that_looked_from_there_counts_most(tmp_path):
    near, far = looked_at(down_from(tmp_path, 0.0, 2.0)), looked_at(down_from(tmp_path, 1.2, 2.0))
    flat = [np.full((60, 80, 3), v, np.float32) for v in (0.1, -0.1)]
    detail = Detail((near, far), tuple(flat))
    found = detail.at(torch.tensor([[0.3, 0.0, 0.0]]), torch.tensor([0.0, 0.0, 2.0]))
    assert 0.0 < float(found[0, 0]) < 0.1
