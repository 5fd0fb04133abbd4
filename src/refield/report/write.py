"""report.json and report.html, each put in place whole."""

from __future__ import annotations

from pathlib import Path

from refield.report.page import html_page
from refield.report.visit import VisitReport, visit_report_dict
from refield.scene.files import AnyPath, as_path, write_bytes, write_json


def write_report(folder: AnyPath, report: VisitReport) -> Path:
    """Write ``report.json`` and the self-contained ``report.html`` into a folder, made if it is missing.

    Returns the page's path. Raises OSError if the folder cannot be written.
    """
    folder = as_path(folder, "the report's folder")
    write_json(folder / "report.json", visit_report_dict(report))
    page = folder / "report.html"
    write_bytes(page, html_page(report).encode())
    return page
