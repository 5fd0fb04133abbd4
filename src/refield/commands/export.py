"""``refield export WORK --out DIR [--what …] [--visit N] [--objects]``: what other programs can open of it."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.export.recipe import ExportConfig, export
from refield.workspace import Workspace

EXAMPLES = ("refield export work --out for-others", "refield export work --out for-others --what splats --visit 0")


@dataclass(frozen=True)
class Export:
    """Write a workspace's state for other programs: points.ply, mesh.ply and .glb, splats.ply and .spz, cameras/
    (nerfstudio, COLMAP, glTF, with the photos), changes.json and .glb; all in the workspace's world."""

    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace"""
    out: Path
    """the folder for the files"""
    how: OmitArgPrefixes[ExportConfig] = field(default_factory=ExportConfig)
    visit: int | None = None
    """the state to write: 0 is before any visit; the latest by default"""
    overwrite: bool = False
    """replace files in ``out`` that refield did not write"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Export) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    workspace = Workspace.open(options.work)
    with clock.counters() as counters:
        files = export(
            workspace,
            options.out,
            options.how,
            visit=options.visit,
            overwrite=options.overwrite,
            on_stage=clock.stage,
            counting=lambda what: nullcontext(counters(what)),
        )
    clock.stop()
    document = {"workspace": options.work, "visit": workspace.chosen_visit(options.visit), "out": options.out}
    document |= {"files": files, "seconds_per_stage": clock.seconds, "warnings": clock.warnings}
    words = f"{len(files)} files in {options.out}, {clock.total:.1f} s"
    return Answer(document, [_table(options.out, files), words])


def _table(out: Path, files: list[Path]) -> Table:
    """Files with their sizes; photos and what lies beside them as one line each."""
    sizes: dict[str, int] = {}
    for path in files:
        parts = path.relative_to(out).parts
        name = "/".join((*parts[:2], "")) if parts[0] == "cameras" else "/".join(parts)
        sizes[name] = sizes.get(name, 0) + path.stat().st_size
    table = Table()
    table.add_column("file")
    table.add_column("size", justify="right")
    for name, size in sizes.items():
        table.add_row(name, f"{size / 1e6:.2f} MB" if size >= 5000 else f"{size} bytes")
    return table
