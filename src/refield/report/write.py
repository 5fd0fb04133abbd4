"""report.json and report.html, each put in place whole."""

from __future__ import annotations

from pathlib import Path

from refield.report.visit import VisitReport


def write_report(folder: Path | str, report: VisitReport) -> Path:
    """Write ``report.json`` and the self-contained ``report.html`` into an existing folder.

    Returns the page's path. Raises OSError if the folder cannot be written.
    """
    raise NotImplementedError
