"""One visit of a workspace, as it is kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from refield.evaluate import Report
from refield.report import PAGE, summary
from refield.scene.change import SceneChange
from refield.scene.files import read_json
from refield.workspace import Workspace

SHEET = "before-after.png"


@dataclass(frozen=True, repr=False)
class Visit:
    """What one update found and made."""

    number: int
    """from 1"""
    folder: Path
    change: SceneChange
    """what changed; of a visit that was looked up, without masks"""
    evaluation: Report | None = field(default=None, compare=False)
    """of a visit that was just made, if photos to measure by were given"""

    @property
    def html(self) -> Path:
        """The report's page."""
        return self.folder / PAGE

    @property
    def sheet(self) -> Path:
        """The evaluation's views before and after; there is none without an evaluation or a change."""
        return self.folder / SHEET

    @cached_property
    def report(self) -> Mapping[str, Any]:
        """The report's numbers, see docs/conventions.md; empty if it is gone.

        Raises:
            InputError: it is damaged.
        """
        path = self.folder / "report.json"
        return read_json(path) if path.is_file() else {}

    @property
    def summary(self) -> str:
        """What changed, in one sentence."""
        return summary(self.change)

    def __repr__(self) -> str:
        return f"<visit {self.number}: {self.summary}>"

    def _repr_html_(self) -> str:
        link = f'<a href="{escape(self.html.resolve().as_uri())}">report</a>'
        return f"<p><b>Visit {self.number}</b> · {link}</p>{self.change._repr_html_()}"


def kept_visits(workspace: Workspace) -> tuple[Visit, ...]:
    """All of a workspace's visits, the first one first.

    Raises:
        InputError: one is damaged.
    """
    numbers = range(1, workspace.visits + 1)
    return tuple(Visit(n, workspace.visit(n), workspace.change(n, masks=False)) for n in numbers)
