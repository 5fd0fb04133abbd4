"""A visit without photos: somebody says where a thing goes.

The thing and its shadowless look are the field's own, looked up where it stands. Nothing is learnt: the place that it
leaves is empty, unless an earlier visit knows what is there.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from refield.estimate.look import spread_out
from refield.field.radiance import Field
from refield.field.render import render_camera
from refield.history import state
from refield.report import PAGE, Comparison, link_next, write_report
from refield.scene.capture import Capture, Frame
from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
from refield.scene.errors import InputError
from refield.scene.pose import invert, nearest_rotation, rigid, transform
from refield.update.store import save_updated
from refield.update.train import update_field
from refield.visits.make import SHOWN
from refield.visits.page import page
from refield.visits.telling import Telling
from refield.visits.visit import Visit
from refield.workspace import Workspace

NOTE = "moved by hand"
_VIEWS, _GLANCES = 3, 24  # old photos' places from which the page shows it, and among which they are chosen
_RIGID = 1e-3  # how far a rotation's columns may be off
_STILL = 1e-6  # of a thing's size


def move_by_hand(workspace: Workspace, grid: OccupancyGrid, new_from_old: Tensor, telling: Telling) -> Visit:
    """Keep a move that somebody says as the next visit; `refield.visits.make.take_back` takes it back like any.

    Args:
        grid: the thing, where it stands after the latest visit.
        new_from_old: (4, 4), world: how it goes from there to where it is to be.

    Raises:
        InputError: the motion is no rigid one, or none at all; the grid is empty; the workspace is being written.
    """
    motion = _checked(grid, new_from_old)
    grid = replace(grid, values=grid.values.clamp(0, 1))  # one that was resampled may be a rounding error above
    change = SceneChange((ObjectChange("moved", grid, motion, note=NOTE),), why=NOTE, by_hand=True)
    with workspace.writing():
        number = workspace.visits
        telling.stage("load the field")
        old, capture = state(workspace, number), workspace.capture()
        new = update_field(capture, old, change, on_stage=telling.stage)
        telling.stage("report")
        frames = _best_views(capture, change)
        shown = tuple(_compared(old, new, f) for f in frames)
        with workspace.new_visit() as folder:
            workspace.keep_change(folder, change)
            save_updated(folder, new)
            telling.stop()
            title = f"{workspace.path.resolve().name}, visit {number + 1}"
            report = page(title, change, ([], None), telling, None, {})
            report = replace(report, photos=shown, world=workspace.world(), number=number + 1)
            write_report(folder, replace(report, old_frames=capture.frames))
        link_next(workspace.visit(number) / PAGE, number + 1)
    return Visit(number + 1, workspace.visit(number + 1), change)


def _checked(grid: OccupancyGrid, new_from_old: Tensor) -> Tensor:
    """The motion as float64, exactly rigid."""
    where, give = "a move by hand", "give a (4, 4) of a rotation and a translation, in the capture's world"
    motion = new_from_old.detach().cpu().double()
    if motion.shape != (4, 4) or not bool(motion.isfinite().all()):
        raise InputError(where, "has a motion that is no (4, 4) of finite numbers", give)
    turn = nearest_rotation(motion[:3, :3])
    bottom = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)
    if float((turn - motion[:3, :3]).abs().max()) > _RIGID or not torch.allclose(motion[3], bottom):
        raise InputError(where, "has a motion that is not rigid", give)
    if not bool((grid.values > 0.5).any()):
        raise InputError(where, "is of a thing without a shape: its grid is empty", "pick another one")
    corners = torch.cartesian_prod(*grid.tight_aabb().double().T)
    motion = rigid(turn, motion[:3, 3])
    size = float((corners[-1] - corners[0]).norm())
    if float((transform(motion, corners) - corners).norm(dim=1).max()) < _STILL * size:
        raise InputError(where, "leaves the thing where it is", "say where it goes")
    return motion


def _best_views(capture: Capture, change: SceneChange) -> list[Frame]:
    """Of the old photos those in which the thing is seen large at both places."""

    def seen(frame: Frame) -> float:
        """The smaller of the angles at which the places are seen; 0 where one lies outside of the picture."""
        (o,) = change.objects
        assert o.new_from_old is not None
        middles = torch.stack([o.centre, transform(o.new_from_old, o.centre)])
        pixels, depths = frame.camera.project(transform(invert(frame.world_from_cam.double()), middles))
        sides = pixels.new_tensor([frame.camera.width, frame.camera.height])
        inside = (depths > 0) & (pixels > 0).all(-1) & (pixels < sides).all(-1)
        return float((inside / depths.abs().clamp_min(1e-9)).min())

    return sorted(spread_out(capture.frames, _GLANCES), key=seen, reverse=True)[:_VIEWS]


def _compared(old: Field, new: Field, frame: Frame) -> Comparison:
    """What the two show from a photo's place."""
    camera = frame.camera.within(SHOWN)
    before, after = (render_camera(field, camera, frame.world_from_cam) for field in (old, new))
    depths = before.surface(), after.surface()
    return Comparison(frame.name, None, before.rgb, after.rgb, None, None, None, frame, *depths)
