"""One browser: which state it is shown, how, and what happens when somebody moves the camera or a slider."""

from __future__ import annotations

import math
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from refield.scene.camera import Camera
from refield.scene.capture import Frame
from refield.scene.change import SceneChange
from refield.scene.errors import InputError
from refield.view.cast import Cloud
from refield.view.draw import POINTS, STATE, draw_points, draw_splats
from refield.view.marks import CAMERAS, MARKS, draw_marks, draw_shot, frustum_size, pictured, shots_of
from refield.view.mover import Mover
from refield.view.pace import DETAILS, Detail, Pace
from refield.view.panel import Panel
from refield.view.scenery import Scenery
from refield.view.stage import first_look
from refield.view.standing import Looking, Picture, StandingView

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle

_QUALITY = 92  # of our own pictures, as JPEG
_NARROW = 600  # pixels: controls would cover half of a picture that is no wider
_EMPTY = 160.0  # units of the stage, about as far as viser's depths reach: where nothing is


class Session:
    """What one browser is shown. Callbacks come from several threads."""

    def __init__(self, client: ClientHandle, scenery: Scenery) -> None:
        self.client, self.scenery = client, scenery
        self._lock = threading.RLock()
        self._visit = scenery.latest
        self._pace = Pace()
        rest = lambda: self._pace.rest  # noqa: E731
        self._standing = StandingView(self._state, self._show_picture, scenery.turns, self._rested, rest)
        self._due = True  # the state that is shown has yet to be drawn
        self._sharp, self._closed = False, False
        self._photos: str | None = None
        self.panel = Panel(client.gui, scenery, self._changed, folded=client.camera.image_width < _NARROW)
        self.mover = Mover(client, scenery, self.panel, self._saved)

    def open(self) -> None:
        """Show the latest state."""
        scenery, camera = self.scenery, self.client.camera
        aspect = camera.image_width / max(camera.image_height, 1)
        look = first_look(scenery.stage, scenery.capture.frames, scenery.world, aspect)
        with self.client.atomic():
            camera.up_direction, camera.fov = look.up, look.fov
            camera.position, camera.look_at = look.position, look.look_at
        self.show(self.scenery.latest)
        self._standing.start()
        self.client.camera.on_update(self._moved)
        self._look()

    def close(self) -> None:
        """The browser is gone."""
        self._closed = True
        self._standing.end()

    def refresh(self) -> None:
        """The workspace has other visits than before."""
        self.panel.visits_changed()
        self.mover.visits_changed()
        self.show(min(self._visit, self.scenery.latest))

    def show(self, visit: int) -> None:
        """Another state: its splats, else its points until they are ready; what changed; photos."""
        with self._lock:
            self._visit, self._due = visit, True
            if not self._sharp:
                self._draw_state()
            self.panel.preparing(self.scenery.splats(visit) is None)
            self._draw_marks()
            self._photos = None
            self._draw_photos()
            self.panel.tell(visit, self._change)
            self.mover.offer(visit)
        self._look()

    def splats_ready(self, visit: int) -> None:
        """The splats of a state can be shown now."""
        with self._lock:
            if visit == self._visit and not self._closed:
                self._draw_state()

    @property
    def finest(self) -> bool:
        """Whether the standing view is shown as sharp as it gets."""
        return self._sharp and self._standing.finest

    @property
    def _change(self) -> SceneChange | None:
        return self.scenery.changes[self._visit - 1] if self._visit > 0 else None

    def _state(self, visit: int) -> Any:
        return self.scenery.field(visit)

    @property
    def _detail(self) -> Detail:
        """What is drawn of the state while the view moves; who asks for splats gets them, however long they take."""
        return DETAILS[-1] if self.panel.layer == "splats" else self._pace.detail

    def _draw_state(self) -> None:
        self._due = False
        detail, stage = self._detail, self.scenery.stage
        splats, cloud = self.scenery.splats(self._visit), self.scenery.cloud(self._visit)
        with self.client.atomic():
            if splats is not None and detail.kind == "splats":
                draw_splats(self.client.scene, stage, splats)
                self.client.scene.remove_by_name(POINTS)
            else:
                draw_points(self.client.scene, stage, (cloud or self._glimpse()).thinned(detail.part))
                self.client.scene.remove_by_name(STATE)
            self._hide_state(self._sharp)
        self.panel.preparing(splats is None)

    def _glimpse(self) -> Cloud:
        with self.scenery.turns.first():
            return self.scenery.glimpse(self._visit)

    def _draw_marks(self) -> None:
        scene = self.client.scene
        scene.remove_by_name(MARKS)
        if self._change is not None and self.panel.marks:
            scene.add_frame(MARKS, show_axes=False)
            draw_marks(scene, self.scenery.stage, self._change, self.scenery.world)

    def _draw_photos(self) -> None:
        """Frusta at once, their photos one by one."""
        wanted = f"{self._visit} {self.panel.photos}"
        if wanted == self._photos:
            return
        self._photos = wanted
        scene, stage = self.client.scene, self.scenery.stage
        scene.remove_by_name(CAMERAS)
        old = self.scenery.capture.frames if self.panel.photos == "all" else ()
        new = self._change if self.panel.photos != "none" else None
        if new is not None and self.panel.photos == "marked":
            new = self.scenery.marked(self._visit)
        shots = shots_of(old, new)
        if not shots:
            return
        scene.add_frame(CAMERAS, show_axes=False)
        size = frustum_size(stage, [s.frame for s in shots])
        for shot in shots:
            draw_shot(scene, stage, shot, size, self._stand_at)
        threading.Thread(target=self._fill_photos, args=(shots, size, wanted), daemon=True).start()

    def _fill_photos(self, shots: list[Any], size: float, wanted: str) -> None:
        for shot in reversed(shots):  # the new ones first
            try:
                filled = pictured(shot)
            except InputError as error:
                self.scenery.warn(str(error))
                continue
            with self._lock:
                if self._photos != wanted:
                    return
                draw_shot(self.client.scene, self.scenery.stage, filled, size, self._stand_at)

    def _stand_at(self, frame: Frame) -> None:
        """Look as a photo was taken."""
        stage, camera = self.scenery.stage, self.client.camera
        pose = frame.world_from_cam
        far = (stage.world_points(camera.look_at) - pose[:3, 3]) @ pose[:3, 2]
        ahead = pose[:3, 3] + pose[:3, 2] * max(float(far), 0.25 / stage.scale)
        with self.client.atomic():
            camera.up_direction = tuple((-pose[:3, 1]).tolist())
            camera.position = stage.points(pose[:3, 3])
            camera.look_at = stage.points(ahead)
            camera.fov = 2 * math.atan(frame.camera.height / 2 / frame.camera.fy)

    def _changed(self, what: str) -> None:
        """Somebody used the panel."""
        if what == "visit":
            self.show(self.panel.visit)
            return
        with self._lock:
            if what == "marks":
                self._draw_marks()
            elif what == "photos":
                self._draw_photos()
            elif what == "layer":
                self._draw_state()
        self._look()

    def _saved(self, visit: int) -> None:
        """A move by hand became a visit, or was taken back: all browsers hear of it by the server's next look."""
        if self.scenery.refresh():
            self.refresh()
        self.panel.visit = visit
        self.show(visit)

    def _moved(self, camera: CameraHandle) -> None:
        self._unsharpen()
        with self._lock:
            if self._pace.picture(camera.update_timestamp) and not self._closed:
                self._draw_state()
        self._look()

    def _look(self) -> None:
        """Ask for the standing view."""
        if self.panel.layer == "splats":
            self._unsharpen()
            self._standing.look(None)
            return
        camera = self.client.camera
        width, height = camera.image_width, camera.image_height
        if not (width and height):
            return
        focal = height / 2 / math.tan(camera.fov / 2)
        lens = Camera(width, height, focal, focal, width / 2, height / 2)
        pose = self.scenery.stage.world_pose(camera.wxyz, camera.position)
        before = self._visit - 1 if self._visit > 0 else None
        self._standing.look(Looking(lens, pose, self._visit, before, self.panel.layer, self.panel.wipe))

    def _show_picture(self, picture: Picture) -> None:
        if self._closed:
            return
        depth = np.nan_to_num(picture.depth * self.scenery.stage.scale, posinf=_EMPTY).clip(0, _EMPTY)
        with self._lock, self.client.atomic():
            self.client.scene.set_background_image(picture.rgb, format="jpeg", jpeg_quality=_QUALITY, depth=depth)
            self._sharp = True
            self._hide_state(True)

    def _rested(self) -> None:
        """Our own picture is there: time to draw the state behind it, for when the camera moves."""
        with self._lock:
            self._due |= self._pace.rests(time.time())
            if self._due and not self._closed:
                self._draw_state()

    def _unsharpen(self) -> None:
        with self._lock:
            if self._sharp:
                self._sharp = False
                self._pace.set_out()
                if self._due:
                    self._draw_state()
                with self.client.atomic():
                    self._hide_state(False)
                    self.client.scene.set_background_image(None)

    def _hide_state(self, hidden: bool) -> None:
        for name in (STATE, POINTS):
            node = self.client.scene.get_handle_by_name(name)
            if node is not None:
                node.visible = not hidden
