"""What is measured on: synthetic worlds as `estimate.py` makes and keeps them, or a folder in the workspace format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from estimate import Bench, Scene, sixteen, spread

from refield.field.radiance import HashField
from refield.scene.capture import Capture, Frame
from refield.scene.change import SceneChange
from refield.scene.errors import InputError
from refield.scene.load import load_new_photos
from refield.synthetic.cameras import ring, square_camera
from refield.synthetic.write import shoot_state, write_masks
from refield.workspace import Workspace

TOP, BOTTOM = 64.0, 15.0
"""degrees of elevation: new photos from above, evaluation from below (Table 8)"""


@dataclass(frozen=True)
class Case:
    """Old photos, the field fitted to them, new photos, and photos to evaluate by. Loaded when asked for."""

    key: str
    """names the results"""
    name: str
    seed: int
    bench: Bench
    folder: Path | None = None
    """holds ``work/``, ``after/`` and ``eval/``; None: a synthetic world"""

    @cached_property
    def scene(self) -> Scene:
        """Raises InputError if the case is no synthetic world."""
        if self.folder is not None:
            raise InputError(self.folder, "its true change is not known", "give a synthetic world for this table")
        return self.bench.scene(self.name, self.seed)

    @cached_property
    def capture(self) -> Capture:
        return self.scene.capture if self.folder is None else Workspace.open(self.folder / "work").capture()

    @cached_property
    def field(self) -> HashField:
        return self.scene.field if self.folder is None else Workspace.open(self.folder / "work").field()

    @property
    def _data(self) -> Path:
        return self.scene.folder / "data" if self.folder is None else self.folder

    @property
    def evaluation(self) -> Path:
        return self._data / "eval"

    @cached_property
    def frames(self) -> list[Frame]:
        """The new photos."""
        return load_new_photos(self._data / "after", self.capture)

    def views(self, count: int) -> Sequence[Frame]:
        """So many new photos from all round."""
        return spread(sixteen(self.bench, self.scene), count)

    def seen_from(self, elevation: float, turn: float = 0.0) -> Path:
        """Four photos of the new state from another height, with masks."""
        folder = self.scene.folder / f"after_{elevation:.0f}"
        if not (folder / "depth").is_dir():
            poses = ring(self.scene.world.target, 4, elevation, turn)
            capture = shoot_state(self.scene.world.after, folder, (square_camera(self.bench.size), poses))
            write_masks(self.scene.world, folder, capture)
        return folder

    def truth(self, frames: Sequence[Frame]) -> SceneChange:
        return self.scene.truth(frames)


def worlds(bench: Bench, names: Sequence[str], seeds: int) -> list[Case]:
    return [Case(f"{n}_{s}_{bench.size}", n, s, bench) for n in names for s in range(seeds)]


def folders(bench: Bench, paths: Sequence[Path]) -> list[Case]:
    """Raises InputError naming what a folder lacks, or two of one name."""
    names = [p.resolve().name for p in paths]
    for path in paths:
        if names.count(path.resolve().name) > 1:
            raise InputError(path, "another folder has the same name, which its results go by", "rename one")
        for part in ("work", "after", "eval"):
            if not (path / part).is_dir():
                raise InputError(path / part, "there is no such folder", "give a folder with work/, after/ and eval/")
    return [Case(p.resolve().name, p.resolve().name, 0, bench, p) for p in paths]
