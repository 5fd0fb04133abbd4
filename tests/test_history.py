"""Old photos as if taken now: what a later update may learn from."""

import numpy as np
import torch

from refield.estimate.look import view_of
from refield.field.render import render_camera
from refield.history import known_objects, retouched
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.images import frame_image
from refield.update.composite import UpdatedField
from refield.update.learnt import Learnt
from refield.update.light import Relighting
from refield.update.region import Region
from tests.captures import write_capture
from tests.fields import small_field
from tests.update.worlds import Ball, BallWorld, at, change_of, grid_of


def test_old_photos_are_brought_up_to_date_when_they_are_looked_at(tmp_path):
    capture = write_capture(tmp_path / "data", 3)
    ball = Ball(at(0.0, 0.0, 0.25), 0.25)
    old = BallWorld((ball,))
    now = UpdatedField(old, change_of(ObjectChange("removed", grid_of(ball))))
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    assert retouched(capture, old, scratch) is capture
    later = retouched(capture, now, scratch)
    assert not list(scratch.iterdir())
    frame, was = later.frames[1], capture.frames[1]
    image, photo = frame_image(frame).float() / 255, frame_image(was).float() / 255
    assert [p.name for p in scratch.iterdir()] == ["0001.png"]
    assert torch.equal(frame.world_from_cam, was.world_from_cam) and frame.camera == was.camera
    shown = [render_camera(f, was.camera, was.world_from_cam).rgb for f in (old, now)]
    differs = (shown[0] - shown[1]).abs().amax(-1) > 0.05
    assert differs.any()
    assert float((image - shown[1])[differs].abs().amax()) < 0.01
    same = (image - photo).abs().amax(-1) < 0.01
    assert same.any() and not same[differs].all()
    assert torch.equal(frame_image(frame), (image * 255).to(torch.uint8))  # and not made again
    assert frame.made is not None
    at_once = frame.made.at(frame.camera, *shown)  # without a file, and with what the field gets wrong in the photo
    assert torch.allclose(at_once[differs], (shown[1] + photo - shown[0]).clamp(0, 1)[differs], atol=1e-5)
    assert torch.equal(at_once[same], photo[same])
    small = frame.camera.shrunk(0.5)
    halved = frame.made.at(small, *(render_camera(f, small, frame.world_from_cam).rgb for f in (old, now)))
    assert halved.shape == (small.height, small.width, 3)
    view = view_of(now, frame, small.width * small.height)
    assert np.allclose(view.photo, halved, atol=1e-3)
    assert np.allclose(view.rgb, render_camera(now, small, frame.world_from_cam).rgb, atol=2e-3)


def test_what_moved_is_known_where_it_is_now():
    grid = OccupancyGrid(torch.tensor([[-0.3, -0.3, -0.3], [0.3, 0.3, 0.3]]), torch.ones(5, 5, 5))
    there = torch.eye(4, dtype=torch.float64)
    there[0, 3] = 1.0
    old = small_field()
    assert known_objects(old) == []
    now = UpdatedField(old, SceneChange((ObjectChange("moved", grid, there),)))
    (known,) = known_objects(now)
    assert torch.allclose(known.grid.tight_aabb().mean(0), torch.tensor([1.0, 0.0, 0.0]), atol=0.05)
    gone = UpdatedField(now, SceneChange((ObjectChange("removed", known.grid),)))
    assert known_objects(gone) == []


def test_photos_are_out_of_date_where_only_the_light_changed(tmp_path):
    """An object was put back: nothing has another shape, but the light has changed."""
    capture, scratch = write_capture(tmp_path / "data", 1), tmp_path / "scratch"
    scratch.mkdir()
    old = BallWorld((Ball(at(0.0, 0.0, 0.25), 0.25),))
    light = Relighting(torch.tensor([[-1.0] * 3, [1.0] * 3]), torch.full((3, 3, 3, 3), -0.7))
    now = UpdatedField(old, SceneChange(()), Learnt(region=Region(()), light=light))
    assert not now.boxes
    later = retouched(capture, now, scratch)
    frame, was = later.frames[0], capture.frames[0]
    image, photo = frame_image(frame).float() / 255, frame_image(was).float() / 255
    shown = [render_camera(f, was.camera, was.world_from_cam).rgb for f in (old, now)]
    darker = (shown[0] - shown[1]).amax(-1) > 0.05
    assert darker.any()
    assert float((image - shown[1])[darker].abs().amax()) < 0.01
    pixels = was.camera.width * was.camera.height
    view = view_of(now, frame, pixels)  # as taken: the photo and the picture beside it in the old light
    assert np.allclose(view.photo, photo.numpy(), atol=1e-5) and np.allclose(view.rgb, shown[0].numpy(), atol=2e-3)


def test_what_stands_in_one_place_is_one_thing():
    """As where a visit takes back a move: the field before it then knows the thing there already."""
    box = torch.tensor([[-0.3, -0.3, -0.3], [0.3, 0.3, 0.3]])
    there, back = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    there[0, 3], back[0, 3] = 1.0, -1.0
    moved = ObjectChange("moved", OccupancyGrid(box, torch.ones(5, 5, 5)), there)
    again = ObjectChange("moved", OccupancyGrid(box + torch.tensor([2.0, 0, 0]), torch.ones(5, 5, 5)), back)
    now = UpdatedField(UpdatedField(small_field(), SceneChange((moved,))), SceneChange((again,)))
    (known,) = known_objects(now)
    assert torch.allclose(known.grid.tight_aabb().mean(0), torch.tensor([1.0, 0.0, 0.0]), atol=0.05)
