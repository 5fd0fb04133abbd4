"""``refield synth WORLD OUT``: path-trace a world that is known exactly, with masks and the true change."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.artefacts import writable
from refield.commands.clock import Clock
from refield.scene.errors import InputError
from refield.synthetic.write import SynthConfig, write_world


@dataclass(frozen=True)
class Synth:
    """Photograph a known world before and after a change (needs Mitsuba: pip install 'refield[synth]')."""

    world: Annotated[str, arg(metavar="WORLD"), Positional]
    """the world's name; an unknown one lists them all"""
    out: Annotated[Path, arg(metavar="OUT"), Positional]
    """the folder for before/, after/, eval/ and truth/"""
    overwrite: bool = False
    """write into a folder that is not empty"""
    config: OmitArgPrefixes[SynthConfig] = field(default_factory=SynthConfig)


def run(options: Synth) -> None:
    clock = Clock()
    _refuse_unless_free(options.out, overwrite=options.overwrite)
    clock.stage(f"path-trace {options.world}")
    with writable(options.out), clock.counting("photos") as count:
        write_world(
            options.world,
            options.out,
            **asdict(options.config),
            on_progress=count,
        )
    clock.stop()
    print(f"{options.world} is in {options.out} ({clock.total:.0f} s)")


def _refuse_unless_free(out: Path, *, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise InputError(out, "is a file, not a folder", "choose another output folder")
    if out.exists() and any(out.iterdir()) and not overwrite:
        raise InputError(out, "is not empty", "choose an empty folder, or pass --overwrite to write into it")
