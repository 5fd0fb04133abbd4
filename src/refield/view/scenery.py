"""All that browsers are shown of a workspace, made once for all of them: states, splats, changes, photos."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from refield.export.splats import Splats
from refield.field.radiance import Field
from refield.history import state
from refield.scene.capture import Capture, Frame
from refield.scene.change import SceneChange
from refield.scene.errors import InputError
from refield.scene.left_out import Warn
from refield.scene.world import World
from refield.view.cast import Cloud, cloud_of, glimpse_of, keep_splats, kept_splats, name_of_state, splats_for
from refield.view.stage import Stage
from refield.view.turns import Turns
from refield.workspace import Workspace

Made = TypeVar("Made")
_FIELDS, _CLOUDS = 3, 4  # kept in memory


class _Ended(Exception):
    """Nobody wants it any longer."""


@dataclass
class Scenery:
    """A workspace as it is shown. Whatever asks a field takes turns; call `field` and `glimpse` within one."""

    workspace: Workspace
    most: int
    """splats of a state"""
    warn: Warn
    turns: Turns = field(default_factory=Turns)
    on_splats: list[Callable[[int], None]] = field(default_factory=list)
    """hear of a state whose splats are ready"""
    capture: Capture = field(init=False)
    world: World = field(init=False)
    stage: Stage = field(init=False)
    changes: list[SceneChange] = field(init=False)
    """of each visit, without masks"""
    _fields: dict[str, Field] = field(default_factory=dict)
    _glimpses: dict[str, Cloud] = field(default_factory=dict)
    _splats: dict[str, Splats] = field(default_factory=dict)
    _clouds: dict[str, Cloud] = field(default_factory=dict)
    _wanted: list[int] = field(default_factory=list)
    _stir: threading.Condition = field(default_factory=threading.Condition)
    _thread: threading.Thread | None = None
    _ended: bool = False

    def __post_init__(self) -> None:
        self.capture, self.world = self.workspace.capture(), self.workspace.world()
        self.stage = Stage.around(self.capture.frames)
        self.refresh()

    @property
    def latest(self) -> int:
        """The number of the last visit."""
        return len(self.changes)

    def refresh(self) -> bool:
        """Look what visits there are; whether they are others than before."""
        names = [self._name(n) for n in range(self.workspace.visits + 1)]
        if names == getattr(self, "_names", None):
            return False
        self.changes = [self.workspace.change(n, masks=False) for n in range(1, len(names))]
        self._names = names
        return True

    def frames(self, visit: int) -> tuple[Frame, ...]:
        """Photos from whose places a state is looked at."""
        return (*self.capture.frames, *(f for change in self.changes[:visit] for f in change.frames))

    def marked(self, visit: int) -> SceneChange:
        """What changed at a visit, with the masks of its photos.

        Raises:
            InputError: a file is damaged.
        """
        return self.workspace.change(visit, old_masks=False)

    def field(self, visit: int) -> Field:
        """The field after a visit.

        Raises:
            InputError: there is no such visit, or no longer; or its files are damaged.
        """
        names = self._names
        if visit >= len(names):
            raise InputError(self.workspace.path, f"there is no visit {visit} any longer", "choose another")
        return _kept(self._fields, names[visit], _FIELDS, lambda: state(self.workspace, visit))

    def glimpse(self, visit: int) -> Cloud:
        """Points of a state, for as long as it has no splats."""
        make = lambda: glimpse_of(self.field(visit), self.frames(visit))  # noqa: E731
        return _kept(self._glimpses, self._names[visit], _CLOUDS, make)

    def cloud(self, visit: int) -> Cloud | None:
        """The points of a state's splats, if these are ready; else as `splats`."""
        splats = self.splats(visit)
        if splats is None:
            return None
        return _kept(self._clouds, self._names[visit], _CLOUDS, lambda: cloud_of(splats))

    def splats(self, visit: int) -> Splats | None:
        """A state's splats, if they are ready; else they are made, and `on_splats` hears of it."""
        name = self._names[visit]
        if (known := self._known_splats(name)) is not None:
            return _kept(self._splats, name, _CLOUDS, lambda: known)
        with self._stir:
            if visit not in self._wanted:
                self._wanted.append(visit)
            self._stir.notify_all()
        return None

    def start(self) -> None:
        """Begin to make what is asked for."""
        self._thread = threading.Thread(target=self._work, name="refield splats")
        self._thread.start()

    def end(self) -> None:
        """Stop for good; what is half made is left."""
        with self._stir:
            self._ended = True
            self._stir.notify_all()
        if self._thread is not None:
            self._thread.join()

    def make_splats(self, visit: int) -> Splats:
        """The splats of a state, ready or made now, and kept.

        Raises:
            InputError: the field cannot be read.
        """
        name = self._names[visit]
        known = self._known_splats(name)
        if known is None:
            with self.turns.later():
                shown = self.field(visit)
                known = splats_for(shown, self.frames(visit), self.most, self._progress)
            keep_splats(self.workspace, name, known, self._names)
        return _kept(self._splats, name, _CLOUDS, lambda: known)

    def _progress(self, done: int, total: int) -> None:
        if self._ended:
            raise _Ended
        self.turns.give_way()

    def _known_splats(self, name: str) -> Splats | None:
        return self._splats.get(name) or kept_splats(self.workspace, name)

    def _work(self) -> None:
        while True:
            with self._stir:
                self._stir.wait_for(lambda: self._ended or self._wanted)
                if self._ended:
                    return
                visit = self._wanted[-1]  # who asked last is looking now
            try:
                if visit <= self.latest:
                    self.make_splats(visit)
            except _Ended:
                return
            except InputError as error:  # such as a workspace that was removed
                self.warn(str(error))
            with self._stir:
                self._wanted = [n for n in self._wanted if n != visit]
            for hear in list(self.on_splats):
                hear(visit)

    def _name(self, visit: int) -> str:
        return name_of_state(self.workspace, visit, self.most)


def _kept(kept: dict[str, Made], key: str, most: int, make: Callable[[], Made]) -> Made:
    """Of what is kept the newest few."""
    found = kept.pop(key, None)
    kept[key] = make() if found is None else found
    while len(kept) > most:
        del kept[next(iter(kept))]
    return kept[key]
