"""``refield.open(WORK)``: a workspace as an object; every step of the command line from Python."""

from __future__ import annotations

import os
from collections.abc import Sequence
from html import escape
from pathlib import Path

from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_camera
from refield.field.volrend import Rendering
from refield.history import changed_visits, known_objects, state
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.change import OccupancyGrid, SceneChange
from refield.scene.errors import InputError, expect, wrong
from refield.scene.files import AnyPath, as_path, log_warning
from refield.scene.left_out import Warn
from refield.scene.world import World
from refield.visits.by_hand import move_by_hand
from refield.visits.make import VisitConfig, make_visit, take_back
from refield.visits.picking import thing_at
from refield.visits.telling import Hearer, OnProgress, OnStage
from refield.visits.visit import Visit, kept_visits
from refield.workspace import Workspace

DEFAULTS = VisitConfig()
_KEPT = 2  # fields in memory: before and after


class Scene:
    """A scene as its workspace has it: the capture, the field, and what changed at each visit.

    Whatever is asked is read from the folder, so that it also sees what the command line does there meanwhile; whatever
    is changed, the command line sees. Make one with `refield.open`.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._fields: dict[tuple[object, ...], Field] = {}

    @property
    def path(self) -> Path:
        """The workspace's folder."""
        return self._workspace.path

    @property
    def visits(self) -> tuple[Visit, ...]:
        """Every update that was made and not taken back, the first one first.

        Raises:
            InputError: one is damaged.
        """
        return kept_visits(self._workspace)

    @property
    def world(self) -> World:
        """Which way is up, how large the scene is, and metres per unit if they are known."""
        return self._workspace.world()

    def capture(self) -> Capture:
        """The photos that the field was fitted to, with what the fit found out about them.

        Raises:
            InputError: a photo is missing.
        """
        return self._workspace.capture()

    def field(self, visit: int | None = None) -> Field:
        """The field as it was after a visit; the latest by default, 0 is before any.

        Raises:
            InputError: there is no such visit, or its files are damaged.
        """
        number = self._number(visit)
        key = self._key(number)
        if key not in self._fields:
            while len(self._fields) >= _KEPT:
                del self._fields[next(iter(self._fields))]
            self._fields[key] = state(self._workspace, number)
        return self._fields[key]

    def change(self, visit: int | None = None) -> SceneChange:
        """What changed at a visit, from 1; the latest by default.

        Raises:
            InputError: there is no such visit, or its files are damaged.
        """
        number = self._number(visit)
        if number == 0:
            what = "visit 0 is the state before any" if visit == 0 else "has had no visit"
            raise InputError(self.path, what, "give 1 or more" if self._workspace.visits else "update it first")
        return self._workspace.change(number, self.capture())

    def update(
        self,
        photos: AnyPath | Sequence[Frame],
        config: VisitConfig = DEFAULTS,
        *,
        evaluation: AnyPath | None = None,
        on_stage: OnStage | None = None,
        on_progress: OnProgress | None = None,
        warn: Warn = log_warning,
    ) -> Visit:
        """Find out from a few new photos what moved, left or arrived, bring the field up to date, and keep both as a
        visit: what ``refield update`` does.

        Args:
            photos: the new photos' folder, a transforms.json, or frames with poses in the capture's world.
            evaluation: a folder of further photos (transforms.json, images/, masks_in/, masks_out/) to measure by.
            on_stage: hears the name of each stage as it begins.
            on_progress: hears each look at the training of what is new.
            warn: hears what you should know; the logger "refield" by default.

        Raises:
            InputError: the photos cannot be used, or another process is writing; the workspace is as it was.
        """
        expect("the config of an update", config, VisitConfig, "a refield.visits.make.VisitConfig")
        given = _frames(photos)
        by = None if evaluation is None else as_path(evaluation, "the evaluation of an update")
        return make_visit(self._workspace, given, Hearer(on_stage, on_progress, warn), config, evaluation=by)

    def things(self) -> list[OccupancyGrid]:
        """What visits found out to be things that can move, each where it stands now. See `thing_at` for others."""
        return [known.grid for known in known_objects(self.field())]

    def thing_at(self, x: Tensor) -> OccupancyGrid | None:
        """The thing whose surface is at a world point (3,), cut out of the field as it is now, where it stands; None if
        nothing there stands by itself."""
        if not isinstance(x, Tensor) or x.shape != (3,):
            raise wrong("the place of a thing", x, "a world point, a (3,) tensor")
        return thing_at(self.field(), self.capture(), x)

    def move(self, thing: OccupancyGrid, new_from_old: Tensor) -> Visit:
        """Say that a thing is elsewhere now, and keep that as a visit without photos; `undo` takes it back.

        Nothing is learnt by it: the place that the thing leaves shows what an earlier visit knows of it, else nothing.

        Args:
            thing: one of `things`, or from `thing_at`.
            new_from_old: (4, 4), world: a rotation and a translation, from where it is to where it goes.

        Raises:
            InputError: the motion is no rigid one, or another process is writing; the workspace is as it was.
        """
        expect("the thing to move", thing, OccupancyGrid, "one of scene.things(), or scene.thing_at(a world point)")
        expect("the thing's motion, new_from_old,", new_from_old, Tensor, "a (4, 4) tensor")
        return move_by_hand(self._workspace, thing, new_from_old, Hearer())

    def render(
        self, view: Frame | Camera, world_from_cam: Tensor | None = None, *, visit: int | None = None
    ) -> Rendering:
        """What the scene looks like from where a photo was taken, or from a camera at a pose (4, 4), OpenCV axes, in
        the capture's world. Colours are those of a photo of mean exposure; leading shape (height, width).

        Raises:
            InputError: there is no such visit, or its files are damaged.
        """
        expect("the view to render", view, (Frame, Camera), "a Frame, or a Camera and its world_from_cam")
        camera, pose = (view.camera, view.world_from_cam) if isinstance(view, Frame) else (view, None)
        pose = pose if world_from_cam is None else world_from_cam
        if not isinstance(pose, Tensor) or pose.shape != (4, 4):
            raise wrong("the camera's pose, world_from_cam,", pose, "a (4, 4) tensor")
        return render_camera(self.field(visit), camera, pose.double())

    def undo(self) -> int:
        """Take the last visit back, as if its photos had never been given. Returns its number.

        Raises:
            InputError: there is none, or another process is writing.
        """
        return take_back(self._workspace)

    def __repr__(self) -> str:
        count = self._workspace.visits
        return f"<refield scene in {self.path}: {count} visit{'' if count == 1 else 's'}>"

    def _repr_html_(self) -> str:
        visits = "".join(
            f'<li><a href="{escape(v.html.resolve().as_uri())}">visit {v.number}</a>: {escape(v.summary)}</li>'
            for v in self.visits
        )
        told = f"<ol>{visits}</ol>" if visits else "<p>no visit yet</p>"
        return f"<p><b>{escape(str(self.path))}</b></p>{told}{self.capture()._repr_html_()}"

    def _number(self, visit: int | None) -> int:
        if visit is not None:
            expect("the number of a visit", visit, int, "a whole number, or None for the latest")
        return self._workspace.chosen_visit(visit)

    def _key(self, visit: int) -> tuple[object, ...]:
        """Of the files that a state is read from."""
        folders = [self.path / "field", *(self._workspace.visit(n) for n in changed_visits(self._workspace, visit))]
        paths = [folder / "field.json" for folder in folders]
        # one that is missing is told of by whoever reads it
        return tuple((p.stat().st_ino, p.stat().st_mtime_ns) if p.is_file() else None for p in paths)


def open(work: AnyPath) -> Scene:
    """A workspace that ``refield train`` or `refield.Workspace.building` made.

    Raises:
        InputError: ``work`` is none, or of a newer format.
    """
    return Scene(Workspace.open(as_path(work, "the workspace")))


def _frames(photos: AnyPath | Sequence[Frame]) -> Path | list[Frame]:
    give = "their folder, a transforms.json, or a list of frames with poses (refield.load_new_photos)"
    if isinstance(photos, str | os.PathLike):
        return Path(photos)
    if not isinstance(photos, list | tuple):
        raise wrong("what is given as new photos", photos, give)
    for i, photo in enumerate(photos):
        expect(f"new photo {i}", photo, Frame, give)
    return list(photos)
