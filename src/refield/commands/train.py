"""``refield train DATA WORK``: photos with poses → a field in a new workspace."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from refield.commands.clock import Clock
from refield.field.fit import FitConfig, NonFiniteError, fit_field
from refield.field.memory import Memory, memory_of
from refield.scene.capture import Capture, centres
from refield.scene.errors import InputError
from refield.scene.load import load_capture
from refield.workspace import Workspace


@dataclass(frozen=True)
class Train:
    """Fit a field to photos with known camera poses, and keep both in a new workspace."""

    data: Annotated[Path, arg(metavar="DATA"), Positional]
    """a transforms.json or its folder, or a folder with a COLMAP model in sparse/0 and images/"""
    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace to make"""
    overwrite: bool = False
    """replace the workspace that is there, with its visits"""
    fit: FitConfig = field(default_factory=FitConfig)


def run(options: Train) -> None:
    clock = Clock()
    train(options.data, options.work, clock, options.fit, overwrite=options.overwrite)
    clock.console.print(f"The field is in {options.work} ({clock.total:.1f} s).", markup=False)


def train(data: Path, work: Path, clock: Clock, config: FitConfig, *, overwrite: bool, made_by: str = "train") -> float:
    """Load, fit, keep. Returns the PSNR on held-out pixels, dB (NaN where none is held out).

    Raises:
        InputError: as `load_capture` and `Workspace.building`, or the photos do not fit into memory.
    """
    Workspace.refuse_unless_free(work, overwrite=overwrite)
    clock.stage("load the capture")
    capture = load_capture(data, warn=clock.warn)
    needed = memory_of(capture, config)
    _check_memory(data, needed)
    _check_cameras(data, capture)
    with Workspace.building(work, overwrite=overwrite, made_by=made_by) as workspace:
        capture = workspace.keep_capture(capture)
        clock.stage(f"fit a field to {len(capture.train)} photos")
        clock.console.print(f"           memory: {needed}", markup=False)
        try:
            with clock.training("fit") as line:
                fitted = fit_field(capture, config, line)
        except NonFiniteError as error:
            if error.field is None or error.steps == 0:
                raise
            fitted = error.field
            clock.warn(f"{error}; the last good state is kept, look at it before you use it")
        clock.stage("keep the field")
        workspace.keep_field(fitted, line.psnr)
    clock.stop()
    return line.psnr


def _check_cameras(data: Path, capture: Capture) -> None:
    """Refuse photos that show nothing in depth."""
    at = centres(capture.frames)
    spread = float((at - at.mean(0)).norm(dim=-1).max())
    if len(at) < 3 or spread < 1e-9 * (1 + float(at.abs().max())):
        what = f"its {len(at)} photos were taken from {'one place' if len(at) >= 3 else 'too few places'}"
        raise InputError(data, what, "give photos from many sides, 50 or more")


def _check_memory(data: Path, needed: Memory) -> None:
    """Refuse what would not fit, with the number, before the machine starts to swap."""
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed.total > there / 2:
        what = f"its photos take {needed.photos / 1e9:.1f} GB of memory, of which there are {there / 1e9:.1f}"
        most = max((there / 2 - needed.total + needed.photos) / 1e9, 0.1)
        raise InputError(data, what, f"give --fit.photo-memory {most:.1f} or less, or scale the photos down")
