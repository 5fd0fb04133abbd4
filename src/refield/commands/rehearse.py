"""``refield rehearse WORK``: known changes put into a workspace's own photos; what an update is worth there."""

from __future__ import annotations

import contextlib
import math
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.artefacts import writable
from refield.check.survey import survey_capture
from refield.commands.answer import Answer
from refield.commands.clock import Clock, duration
from refield.commands.options import PLAIN, Output
from refield.commands.train import Sources, train
from refield.commands.update import Update, update
from refield.evaluate import Report
from refield.field.fit import FitConfig, need_device
from refield.field.quality import OPEN, Quality
from refield.rehearse.compose import Scenery, compose, compose_several, divided, scenery_of
from refield.rehearse.plan import NoRoomError
from refield.rehearse.score import ChangeScore, score_change
from refield.scene.change_files import load_change
from refield.scene.errors import InputError
from refield.scene.files import read_json, write_json
from refield.scene.world import world_of
from refield.visits.make import take_back
from refield.visits.visit import Visit
from refield.workspace import Workspace, refuse_inside

REPORT = "rehearsals.json"
_MOST = 100


EXAMPLES = (
    "refield rehearse work",
    "refield rehearse work --seeds 0..6 --out rehearsals",
    "refield rehearse work --seeds 0 --changes 6",
)


@dataclass(frozen=True)
class Rehearse:
    """Put known objects and changes into a workspace's own photos, train and update on them, and tell how well it went.

    The workspace stays as it is. Each rehearsal takes about as long as a training and its updates.
    """

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace whose photos are used"""
    seeds: str = "0..2"
    """which rehearsals: a number, or from..to; with one change each, seed 0 moves an object, 1 adds one, 2 removes one,
    3 changes several, 4 turns one, 5 tips one over, 6 changes nothing, and so on round and round"""
    out: Path | None = None
    """an empty folder for the photos, workspaces and numbers of the rehearsals; without it only the table is told"""
    changes: int = 1
    """with more than one, each rehearsal puts three objects into the photos, trains once, and so many times changes one
    to three of them, and now and then adds one; each update is taken back before the next"""
    placed: bool = True
    """the new photos come with their poses; --no-placed has them placed by what they show, as photos of your own are"""
    quality: Quality = "draft"
    """of the rehearsed fits, as `refield train` has it"""
    fit: FitConfig = field(default=OPEN, metadata={"usual": False})
    output: OmitArgPrefixes[Output] = PLAIN


@dataclass(frozen=True)
class Rehearsed:
    """What came of a rehearsal, or of one of its changes."""

    seed: int
    facts: dict[str, Any]
    psnr: float
    """of the field fitted to the photos before, on held-out pixels, dB"""
    change: ChangeScore | None
    """None: the update was refused"""
    evaluation: Report | None
    refused: str
    seconds: float
    """the first of several changes takes the composing and the training as well"""
    number: int | None = None
    """of its change, from 0, where a rehearsal has several"""

    def to_dict(self) -> dict[str, Any]:
        return {
            "seed": self.seed,
            "number": self.number,
            "facts": self.facts,
            "held_out_psnr": self.psnr if math.isfinite(self.psnr) else None,
            "change": None if self.change is None else self.change.to_dict(),
            "evaluation": None if self.evaluation is None else self.evaluation.to_dict(),
            "refused": self.refused,
            "seconds": self.seconds,
        }


def run(options: Rehearse) -> Answer:
    if not 1 <= options.changes <= _MOST:
        raise InputError("--changes", f"is {options.changes}", f"give 1 to {_MOST}")
    seeds, clock = seeds_of(options.seeds), Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    if options.out is not None:
        _refuse_unless_free(options.work, options.out)
    need_device(options.fit.device)
    scenery, size = prepared(options.work, clock, (options.fit, options.quality), (len(seeds), options.changes))
    done: list[Rehearsed] = []
    stop: BaseException | None = None
    try:
        with _folder(options.out) as folder:
            _rehearse_all(scenery, size, folder, seeds, clock, options, done)
    except BaseException as error:
        stop = error  # what is done has taken long, and is told whatever comes
    clock.stop()
    document = {"workspace": options.work, "warnings": clock.warnings, **_record(done, size)}
    return Answer(document, [table(done, size)] if done else [], stop=stop)


def _rehearse_all(
    scenery: Scenery,
    size: float,
    folder: Path,
    seeds: Sequence[int],
    clock: Clock,
    options: Rehearse,
    done: list[Rehearsed],
) -> None:
    """Append to ``done``; a rehearsal that there is no room for is left out.

    Raises:
        NoRoomError: there was none for any.
    """
    for k, seed in enumerate(seeds, 1):
        place, before = folder / f"{seed:03d}", len(done)
        try:
            for one in rehearsed(scenery, place, seed, clock, options):
                done.append(one)
                if options.out is not None:
                    write_json(options.out / REPORT, _record(done, size))
        except BaseException as error:
            if len(done) == before:  # of which nothing is told
                shutil.rmtree(place, ignore_errors=True)
            if not isinstance(error, NoRoomError) or (k == len(seeds) and not done):
                raise
            clock.warn(f"rehearsal {seed} is left out: {error}")
            continue
        left = (len(seeds) - k) * sum(r.seconds for r in done) / len({r.seed for r in done})
        if left:
            clock.console.print(f"           {k} of {len(seeds)} rehearsed, about {duration(left)} left")


def prepared(
    work: Path, clock: Clock, asked: tuple[FitConfig, Quality], counts: tuple[int, int]
) -> tuple[Scenery, float]:
    """A workspace as a scenery, and how large its world is; tells how long the rehearsals will take.

    Args:
        counts: how many there are, and how many changes each has.

    Raises:
        InputError: it is no workspace, or has too few photos.
    """
    workspace = opened(work)
    capture = workspace.capture()
    divided(capture)
    seconds = sum(survey_capture(capture, asked).seconds.values())
    updates = "one update" if counts[1] == 1 else f"{counts[1]} updates"
    each = f"each about one training (some {duration(seconds)} on this machine) and {updates}"
    clock.console.print(f"{counts[0]} rehearsals, {each}; Ctrl-C leaves nothing half done", markup=False)
    clock.stage("find out how far off things are")
    with clock.counting("views") as tell:
        return scenery_of(workspace.field(), capture, tell), world_of(capture).size


def opened(work: Path) -> Workspace:
    """The workspace whose photos things are put into.

    Raises:
        InputError: it is none; a capture without a field lacks depth.
    """
    try:
        return Workspace.open(work)
    except InputError as error:
        if not work.exists():
            raise
        what = "is no workspace: how far off things are in its photos is not known"
        raise InputError(work, what, f"train it first: refield train {work} WORK, then give WORK") from error


def rehearsed(scenery: Scenery, folder: Path, seed: int, clock: Clock, options: Rehearse) -> Iterator[Rehearsed]:
    """Composite, fit, update and score a rehearsal in ``folder``, by what the commands call; one after the other of its
    changes."""
    began = clock.total
    clock.stage(f"rehearsal {seed}: put objects into the photos")
    data, work, several = folder / "data", folder / "work", options.changes > 1
    with writable(folder), clock.counting("photos") as tell:
        if several:
            places = compose_several(scenery, data, seed, options.changes, tell)
        else:
            compose(scenery, data, seed, tell)
            places = [data]
    psnr = train(Sources(data / "before", work), clock, options.fit, overwrite=False, quality=options.quality)
    for number, place in enumerate(places):
        if several:
            clock.stage(f"rehearsal {seed}: change {number}, of {options.changes} from 0")
        workspace = Workspace.open(work)
        if workspace.visits:
            take_back(workspace)
        visit, refused = _updated(place, work, clock, options.placed)
        yield Rehearsed(
            seed,
            read_json(place / "truth" / "world.json"),
            psnr,
            None if visit is None else score_change(visit.change, load_change(place / "truth", masks=False)),
            None if visit is None else _numbers(visit.evaluation),
            refused,
            clock.total - began,
            number if several else None,
        )
        began = clock.total


def _updated(place: Path, work: Path, clock: Clock, placed: bool) -> tuple[Visit | None, str]:
    """The update of a workspace by the new photos of a change; None and why, if it was refused."""
    photos = place / "after" if placed else place / "after" / "images"
    try:
        return update(Update(work, photos, evaluation=place / "eval"), clock), ""
    except InputError as error:
        clock.warn(f"the update was refused: {error}")
        return None, str(error)
    finally:
        clock.stop()


def _numbers(report: Report | None) -> Report | None:
    """An evaluation without its pictures, which are large: there may be many."""
    if report is None:
        return None
    none = torch.empty(0)
    views = (replace(v, truth=none, render=none, render_before=None, mask_in=None, mask_out=None) for v in report.views)
    return replace(report, views=tuple(views))


def seeds_of(text: str) -> list[int]:
    """``7``, or ``from..to``, both of them too.

    Raises:
        InputError: it is neither, or names none or too many.
    """
    found = re.fullmatch(r"(\d{1,9})(?:\.\.(\d{1,9}))?", text.strip())
    if found is None:
        raise InputError("--seeds", f"{text!r} is no number and no from..to", "give 3, or 0..2")
    seeds = list(range(int(found[1]), int(found[2] or found[1]) + 1))
    if not seeds:
        raise InputError("--seeds", f"{text!r} ends before it begins", f"give {found[2]}..{found[1]}")
    if len(seeds) > _MOST:
        raise InputError("--seeds", f"names {len(seeds)} rehearsals", f"give {_MOST} at most")
    return seeds


def table(done: Sequence[Rehearsed], size: float) -> Table:
    """One row a rehearsal, or a change where they have several."""
    out = Table(title="what to expect here (in brackets: the field before the update)")
    for column in ("seed", "happened", "found", "shift off", "of scene", "turn off", "PSNR-in", "-out", "untouched"):
        out.add_column(column, justify="left" if column in ("happened", "found") else "right")
    for r in done:
        shifts = [o for o in r.change.objects if o.shift_error is not None] if r.change else []
        worst = max((o.shift_error or 0.0 for o in shifts), default=None)
        turn = max((o.turn_error_deg or 0.0 for o in shifts), default=None)
        out.add_row(
            str(r.seed) if r.number is None else f"{r.seed}.{r.number}", _happened(r), _found(r),
            "-" if worst is None else f"{worst:.3g}",
            "-" if worst is None or size <= 0 else f"{100 * worst / size:.2f} %",
            "-" if turn is None else f"{turn:.1f}°",
            *(_decibels(r.evaluation, region) for region in ("psnr_in", "psnr_out", "psnr_untouched")),
        )  # fmt: skip
    right = sum(r.change is not None and r.change.all_right for r in done)
    what = "rehearsals" if all(r.number is None for r in done) else "changes"
    out.caption = f"{right} of {len(done)} {what} with every change told rightly and none besides"
    return out


def _happened(r: Rehearsed) -> str:
    happening, changes = r.facts["happening"], r.facts["changes"]
    if r.number is not None:
        return ", ".join(changes)
    return happening if changes in ([], [happening]) else f"{happening} ({', '.join(changes)})"


def _found(r: Rehearsed) -> str:
    if r.change is None:
        return "refused"
    told = [o.found or "not found" for o in r.change.objects] + [f"{kind} besides" for kind in r.change.extra]
    return ", ".join(told) or "nothing"


def _decibels(report: Report | None, region: str) -> str:
    if report is None:
        return "-"
    scores = [getattr(s, region) for s in (report.pooled, report.pooled_before) if s is not None]
    shown = ["-" if v is None else f"{v:.1f}" for v in scores]
    return shown[0] if len(shown) == 1 else f"{shown[0]} ({shown[1]})"


def _record(done: Sequence[Rehearsed], size: float) -> dict[str, Any]:
    return {"scene_size": size, "rehearsals": [r.to_dict() for r in done]}


def _refuse_unless_free(work: Path, out: Path) -> None:
    """Raises InputError: ``out`` is not empty, or lies in the workspace or in what another one keeps."""
    refuse_inside(out)
    if out.resolve().is_relative_to(work.resolve()):
        raise InputError(out, "lies in the workspace, which stays as it is", "choose a folder outside of it")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(out, "is not an empty folder", "choose another output folder")


@contextlib.contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    """``out``; without it a folder that vanishes."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="refield-") as scratch:
            yield Path(scratch)
        return
    with writable(out):
        out.mkdir(parents=True, exist_ok=True)
    yield out
