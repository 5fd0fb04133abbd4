"""Moving a thing by hand: chosen among those that visits know, or picked in the scene; dragged; kept as a visit."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from refield.export.objects import on_object
from refield.history import known_objects
from refield.report.words import size, up_of
from refield.scene.boxes import upright_box
from refield.scene.change import ObjectChange, OccupancyGrid
from refield.scene.errors import InputError
from refield.scene.pose import invert
from refield.view.draw import draw_splats
from refield.view.marks import IS, edges
from refield.view.panel import Panel
from refield.view.scenery import Scenery
from refield.visits.by_hand import move_by_hand
from refield.visits.make import take_back
from refield.visits.picking import surface_at, thing_at
from refield.visits.telling import Hearer

if TYPE_CHECKING:
    from viser import ClientHandle, SceneClickEvent

GIZMO = "/moved"
_NONE = "choose one"
_AS_BEFORE = "Where it stood is shown what was there before it came."
_EMPTY = "Where it stood is an empty place now: what was under it or behind it no photo has shown."


@dataclass(frozen=True)
class Held:
    """A thing that somebody is moving."""

    grid: OccupancyGrid
    """where it stands"""
    world_from_box: Tensor
    """(4, 4) float64: its box there; the gizmo's pose before any drag"""


class Mover:
    """The controls of one browser. ``on_saved`` hears the number of the latest visit when one was made, or
    taken back."""

    def __init__(self, client: ClientHandle, scenery: Scenery, panel: Panel, on_saved: Callable[[int], None]) -> None:
        self._client, self._scenery, self._panel, self._on_saved = client, scenery, panel, on_saved
        self._known: dict[str, OccupancyGrid] = {}
        self._held: Held | None = None
        self._gizmo: Any = None
        self._busy = threading.Lock()
        gui = client.gui
        with panel.home, gui.add_folder("Move a thing by hand", expand_by_default=False):
            self._things: Any = gui.add_dropdown("Thing", (_NONE,), hint="things that visits found out")
            self._pick = gui.add_button("Pick one in the scene", hint="then click on it")
            self._save = gui.add_button("Save as a visit", disabled=True)
            self._back = gui.add_button("Put it back", disabled=True)
            self._undo = gui.add_button("Take the last visit back", visible=False)
            self._said = gui.add_html("")
        self._things.on_update(lambda event: None if event.client is None else self._chosen())
        self._pick.on_click(lambda _: self._listen())
        self._save.on_click(lambda _: self._alone(self._keep, "Saving …"))
        self._back.on_click(lambda _: self.let_go())
        self._undo.on_click(lambda _: self._alone(self._take_back, "Taking it back …"))

    @property
    def held(self) -> Held | None:
        """What is being moved."""
        return self._held

    @property
    def reach(self) -> float:
        """How long the gizmo's arrows are, units of the stage."""
        return 0.0 if self._gizmo is None else float(self._gizmo.scale)

    @property
    def moved_by(self) -> float:
        """How far it was dragged, world units."""
        if self._held is None or self._gizmo is None:
            return 0.0
        there = self._scenery.stage.world_points(self._gizmo.position)
        return float((there - self._held.world_from_box[:3, 3]).norm())

    def offer(self, visit: int) -> None:
        """Things can be moved in the latest state alone."""
        self.let_go()
        latest = visit == self._scenery.latest
        self._known = self._find() if latest else {}
        self._things.options = (_NONE, *self._known)
        self._things.disabled = not self._known
        self._pick.disabled = not latest
        last = self._scenery.changes[-1] if self._scenery.changes else None
        self._undo.visible = latest and last is not None and last.by_hand
        if not latest:
            self._say("Go to the latest visit to move things.")

    def visits_changed(self) -> None:
        """There are other visits than before."""
        self.let_go()

    def let_go(self) -> None:
        """Nothing is being moved."""
        self._held = None
        self._client.scene.remove_by_name(GIZMO)
        self._gizmo = None
        self._save.disabled = self._back.disabled = True
        if self._things.value != _NONE:
            self._things.value = _NONE
        self._say("")

    def hold(self, grid: OccupancyGrid) -> None:
        """Show a thing with handles to drag it by."""
        stage, scene = self._scenery.stage, self._client.scene
        box = upright_box(grid, up_of(self._scenery.world))
        self._held = Held(grid, box.world_from_box)
        half = stage.scale * torch.tensor(box.size, dtype=torch.float64) / 2
        reach = 1.3 * float(half.max())
        self._gizmo = scene.add_transform_controls(
            GIZMO, scale=reach, depth_test=False, **stage.pose(box.world_from_box)
        )
        corners, still = edges(stage.points(box.corners)), stage.seen_from(box.world_from_box)
        scene.add_line_segments(f"{GIZMO}/box", corners, IS, thickness=2.5, thickness_units="screen", **still)
        self._draw_copy(box.world_from_box)
        self._save.disabled = self._back.disabled = False
        told = size(ObjectChange("added", grid), self._scenery.world)
        self._say(f"A thing of {told}. Drag it by the arrows and arcs, then save.")

    def _draw_copy(self, world_from_box: Tensor) -> None:
        """The thing's own splats, which go along with the gizmo."""
        assert self._held is not None
        splats = self._scenery.splats(self._scenery.latest)
        if splats is None:
            return
        own = splats[on_object(splats.means, self._held.grid)]
        if len(own):
            stage = self._scenery.stage
            draw_splats(self._client.scene, stage, own, f"{GIZMO}/copy", **stage.seen_from(world_from_box))

    def _find(self) -> dict[str, OccupancyGrid]:
        with self._scenery.turns.first():
            known = known_objects(self._scenery.field(self._scenery.latest))
        return {
            f"{i}: {size(ObjectChange('added', k.grid), self._scenery.world)}": k.grid for i, k in enumerate(known, 1)
        }

    def _chosen(self) -> None:
        grid = self._known.get(self._things.value)
        if grid is None:
            self.let_go()
        else:
            self.hold(grid)

    def _listen(self) -> None:
        """The next click on the scene says which thing is meant."""
        scene = self._client.scene
        self.let_go()
        self._say("Click on a thing in the scene.")
        scene.remove_click_callback()

        @scene.on_click()
        def _(event: SceneClickEvent) -> None:
            scene.remove_click_callback()
            self._alone(lambda: self._pick_at(event), "Looking what it is …")

    def _pick_at(self, event: SceneClickEvent) -> None:
        stage = self._scenery.stage
        origin = stage.world_points(event.ray_origin)
        direction = torch.nn.functional.normalize(torch.tensor(event.ray_direction, dtype=torch.float64), dim=0)
        with self._scenery.turns.first():
            now = self._scenery.field(self._scenery.latest)
            at = surface_at(now, origin, direction)
            known = next((g for g in self._known.values() if at is not None and _holds(g, at)), None)
            grid = known or (None if at is None else thing_at(now, self._scenery.capture, at))
        if grid is None:
            self._say("Nothing there stands by itself: click on a thing that stands on the ground, not on the ground.")
        else:
            self.hold(grid)

    def _keep(self) -> None:
        held, gizmo = self._held, self._gizmo
        if held is None or gizmo is None:
            return
        there = self._scenery.stage.world_pose(gizmo.wxyz, gizmo.position)
        with self._scenery.turns.first():
            visit = move_by_hand(
                self._scenery.workspace, held.grid, there @ invert(held.world_from_box), Hearer(warn=self._scenery.warn)
            )
        # of a thing that a visit brought there it is known what was there before it
        known = any(held.grid is grid for grid in self._known.values())
        self._on_saved(visit.number)
        left = _AS_BEFORE if known else _EMPTY
        self._say(f"Kept as visit {visit.number}. {left}")

    def _take_back(self) -> None:
        with self._scenery.turns.first():
            number = take_back(self._scenery.workspace)
        self._on_saved(number - 1)
        self._say(f"Visit {number} is taken back.")

    def _alone(self, work: Callable[[], None], told: str) -> None:
        """Do something that takes a moment, one at a time; what is wrong is told in the panel."""
        if not self._busy.acquire(blocking=False):
            return
        try:
            self._say(told)
            work()
        except InputError as error:
            self._say(str(error))
        finally:
            self._busy.release()

    def _say(self, text: str) -> None:
        self._said.content = f'<div style="padding:0 0.75em;font-size:0.8em">{escape(text)}</div>'


def _holds(grid: OccupancyGrid, x: Tensor) -> bool:
    return bool(grid.dilated(1.1).contains(x[None])[0])
