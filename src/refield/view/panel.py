"""The controls beside the picture."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from refield.scene.change import SceneChange
from refield.view.scenery import Scenery
from refield.view.standing import Layer
from refield.view.told import told

if TYPE_CHECKING:
    from viser import GuiApi

Photos = Literal["none", "new", "marked", "all"]
_LAYERS: dict[str, Layer | Literal["splats"]] = {
    "sharp when still": "sharp",
    "splats only": "splats",
    "depth": "depth",
    "what changed": "changed",
}
_PHOTOS: dict[str, Photos] = {"of this visit": "new", "with masks": "marked", "all": "all", "none": "none"}
OnChange = Callable[[str], None]


class Panel:
    """Sliders, switches and words of one browser. ``on_change`` hears what was changed: "visit", "look", "layer",
    "marks" or "photos". ``folded``: they are all in a folder that is closed at first."""

    def __init__(self, gui: GuiApi, scenery: Scenery, on_change: OnChange, folded: bool = False) -> None:
        self.gui, self._scenery = gui, scenery
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label(scenery.workspace.path.resolve().name)
        self.home: AbstractContextManager[object] = nullcontext()
        """what all controls lie in"""
        if folded:
            self.home = gui.add_folder("What changed, and how to look at it", expand_by_default=False)
        with self.home:
            self._add(gui, scenery)
        for handle, what in (
            (self._visit, "visit"),
            (self._wipe, "look"),
            (self._layer, "layer"),
            (self._photos, "photos"),
            (self._marks, "marks"),
        ):
            handle.on_update(partial(_heard, on_change, what))

    def _add(self, gui: GuiApi, scenery: Scenery) -> None:
        self._told = gui.add_html("")
        self._visit: Any = gui.add_slider("Visit", 0, max(scenery.latest, 1), 1, scenery.latest, hint="0 is before any")
        self._visit.disabled = scenery.latest == 0
        self._wipe = gui.add_slider("Before", 0, 100, 1, 0, hint="how much of the picture shows the visit before, in %")
        self._layer = gui.add_dropdown("Picture", tuple(_LAYERS), hint="what is shown when the camera stands still")
        self._photos = gui.add_dropdown("Photos", tuple(_PHOTOS), hint="click on one to stand where it was taken")
        self._marks = gui.add_checkbox("Boxes and numbers", True)
        self._note = gui.add_html("")

    @property
    def visit(self) -> int:
        """The state that is asked for."""
        return int(self._visit.value)

    @visit.setter
    def visit(self, number: int) -> None:
        self._visit.value = number

    @property
    def wipe(self) -> float:
        """The part of the picture that is to show how it was before."""
        return float(self._wipe.value) / 100

    @property
    def layer(self) -> Layer | Literal["splats"]:
        """What is shown when the camera stands still."""
        return _LAYERS[self._layer.value]

    @property
    def photos(self) -> Photos:
        """Which photos are shown where they were taken."""
        return _PHOTOS[self._photos.value]

    @property
    def marks(self) -> bool:
        """Whether boxes and numbers are shown."""
        return bool(self._marks.value)

    def tell(self, visit: int, change: SceneChange | None) -> None:
        """What changed at the visit that is shown."""
        self._told.content = _small(told(visit, change, self._scenery.world))
        self._wipe.disabled = visit == 0

    def preparing(self, splats: bool) -> None:
        """Whether better splats are still being made."""
        self._note.content = _small("<p><small>Points for now; splats are being made.</small></p>") if splats else ""

    def visits_changed(self) -> None:
        """There are more visits, or fewer."""
        latest = self._scenery.latest
        if self.visit > latest:
            self._visit.value = latest
        self._visit.max = max(latest, 1)
        self._visit.disabled = latest == 0


def _heard(on_change: OnChange, what: str, event: Any) -> None:
    if event.client is not None:  # else it was set from here
        on_change(what)


def _small(content: str) -> str:
    """HTML with the panel's margins."""
    return f'<div style="padding:0 0.75em;font-size:0.875em;line-height:1.4">{content}</div>'
