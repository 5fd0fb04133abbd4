"""What a scene is and where its photos come from: random and named worlds, and real photographs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from gauntlet.chain import Chain
from refield.photos.sources import find_sources
from refield.scene.change import SceneChange
from refield.scene.change_files import save_change
from refield.scene.load import is_posed

NEW = 4
"""photos of a real sequence that are given as new, and as many to evaluate by; none of them is fitted to"""
REAL_SETS = {"fox": "fox", "fox without poses": "fox/images", "room": "room", "monument": "monument", "plush": "plush"}
"""Name → folder of the data whose photos show one state only."""

Source = Literal["random", "named", "nothing changed", "as is", "rehearsal"]


@dataclass(frozen=True)
class Trial:
    """One scene. All of it is JSON."""

    name: str
    """names its folder too"""
    source: Source
    seed: int | None = None
    """of a random world or change; of others it is the default"""
    data: str = ""
    """the world's name, or the folder of real photographs"""
    synth: tuple[str, ...] = ()
    """further options of ``refield synth``"""
    train: tuple[str, ...] = ()
    """and of ``refield train``"""

    @property
    def key(self) -> str:
        return self.name.replace(" ", "-").replace("/", "-")

    @property
    def real(self) -> bool:
        return self.source not in ("random", "named")

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> Trial:
        record: dict[str, Any] = json.loads(text)
        return Trial(**record | {name: tuple(record[name]) for name in ("synth", "train")})


def chosen(
    seeds: Sequence[int], worlds: Sequence[str], data: Path | None, synth: tuple[str, ...] = ()
) -> tuple[list[Trial], list[str]]:
    """The trials, and a line for each set of real photographs that is not there.

    ``seeds`` are of random worlds or, with the folder ``data`` of real photographs, of changes in these.
    """
    if data is None:
        return named_worlds(worlds, synth) + random_worlds(seeds, synth), []
    real, skipped = real_trials(data)
    return named_worlds(worlds, synth) + real + rehearsals(data, seeds, synth), skipped


def random_worlds(seeds: Sequence[int], synth: tuple[str, ...] = ()) -> list[Trial]:
    return [Trial(f"{seed:04d}", "random", seed, "random", synth) for seed in seeds]


def named_worlds(names: Sequence[str], synth: tuple[str, ...] = ()) -> list[Trial]:
    return [Trial(name, "named", None, name, synth) for name in names]


def real_trials(data: Path) -> tuple[list[Trial], list[str]]:
    """Those whose photos are there, and a line for each set that is not."""
    out, skipped = [], []
    for name, folder in REAL_SETS.items():
        if (data / folder).is_dir():
            out.append(Trial(f"{name}, nothing changed", "nothing changed", None, str(data / folder)))
        else:
            skipped.append(f"{name}: {data / folder} is not there")
    moved = data / "fox_moved"
    if (moved / "truth.json").is_file():
        out.append(Trial("fox_moved", "as is", None, str(moved)))
    else:
        skipped.append(f"fox_moved: {moved} is not there")
    return out, skipped


def rehearsals(data: Path, seeds: Sequence[int], synth: tuple[str, ...] = ()) -> list[Trial]:
    """Objects composited into each set of real photographs, a trial per seed."""
    there = {name: data / folder for name, folder in REAL_SETS.items() if (data / folder).is_dir()}
    return [
        Trial(f"{name}, rehearsal {seed}", "rehearsal", seed, str(folder), synth)
        for name, folder in there.items()
        for seed in seeds
    ]


def make(trial: Trial, chain: Chain) -> Path | None:
    """The folder with before/, after/, eval/ and, where something is known of it, truth/; None if it failed."""
    out = chain.folder / "data"
    if trial.source in ("random", "named"):
        made = chain.run("synth", "synth", trial.data, out, *_seed(trial), *trial.synth)
    elif trial.source == "rehearsal":
        made = _rehearse(trial, chain, out)
    elif trial.source == "as is":
        return Path(trial.data)
    else:
        split(Path(trial.data), out)
        (out / "truth").mkdir()
        save_change(out / "truth", SceneChange(why="photos of one visit"))
        made = True
    return out if made else None


def _seed(trial: Trial) -> tuple[str, ...]:
    return () if trial.seed is None else ("--seed", str(trial.seed))


def _rehearse(trial: Trial, chain: Chain, out: Path) -> bool:
    """Fit the photographs as they are, and composite a change into them there."""
    base = chain.folder / "base"
    fitted = chain.run("train base", "train", trial.data, base, *trial.train)
    return fitted and chain.run("synth", "synth", "random", out, "--into", base, *_seed(trial), *trial.synth)


def split(photos: Path, out: Path) -> None:
    """A sequence in which nothing changed: photos spread evenly over it are new, others for evaluation.

    Copies, since what is named in a transforms.json may not lie outside of its folder.
    """
    if is_posed(photos):
        record = json.loads((photos / "transforms.json").read_text(encoding="utf-8"))
        frames = sorted(record["frames"], key=lambda f: f["file_path"])
        for part, chosen in zip(("before", "after", "eval"), _parts(len(frames))):
            some = [frames[i] for i in chosen]
            for frame in some:
                _copy(photos / frame["file_path"], out / part / frame["file_path"])
            text = json.dumps(record | {"frames": some})
            (out / part / "transforms.json").write_text(text, encoding="utf-8")
        return
    paths = sorted(s.path for s in find_sources(photos))
    for part, chosen in zip(("before", "after", "eval"), _parts(len(paths))):
        for i in chosen:
            _copy(paths[i], out / part / paths[i].name)


def _parts(count: int) -> tuple[list[int], list[int], list[int]]:
    """Which of so many photos are old, new and for evaluation: the latter two in the middle of equal stretches."""
    middles = [int((k + 0.5) * count / (2 * NEW)) for k in range(2 * NEW)]
    return [i for i in range(count) if i not in middles], middles[0::2], middles[1::2]


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
