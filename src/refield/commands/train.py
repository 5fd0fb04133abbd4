"""``refield train DATA WORK``: photos with poses → a field in a new workspace."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from refield.commands.clock import Clock
from refield.field.fit import FitConfig, fit_field
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
    _check_memory(data, capture)
    _check_cameras(data, capture)
    with Workspace.building(work, overwrite=overwrite, made_by=made_by) as workspace:
        capture = workspace.keep_capture(capture)
        clock.stage(f"fit a field to {len(capture.train)} photos")
        with clock.training("fit") as line:
            fitted = fit_field(capture, config, line)
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


def _check_memory(data: Path, capture: Capture) -> None:
    """Refuse what would not fit, with the number, before the machine starts to swap."""
    needed = 3 * sum(f.camera.width * f.camera.height for f in capture.frames)
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > there / 2:
        what = f"its photos take {needed / 1e9:.1f} GB of memory, of which there are {there / 1e9:.1f}"
        raise InputError(data, what, "scale the photos down, or give fewer")
