"""report.json and report.html, each put in place whole; links between the pages of neighbouring visits."""

from __future__ import annotations

import contextlib
from pathlib import Path

from refield.report.page import GENERATOR, NEXT, html_page, visit_link
from refield.report.visit import VisitReport, visit_report_dict
from refield.scene.files import AnyPath, as_path, write_bytes, write_json

PAGE = "report.html"
"""a visit's page in its folder"""
_HEAD = 4096  # bytes of a page in which it says what made it


def write_report(folder: AnyPath, report: VisitReport) -> Path:
    """Write ``report.json`` and the self-contained ``report.html`` into a folder, made if it is missing.

    Returns the page's path. Raises OSError if the folder cannot be written.
    """
    folder = as_path(folder, "the report's folder")
    write_json(folder / "report.json", visit_report_dict(report))
    page = folder / PAGE
    write_bytes(page, html_page(report).encode())
    return page


def link_next(page: Path, number: int | None) -> None:
    """Let a visit's page link to the next visit, or, for None, no longer. A page that is missing, cannot be
    written or has no place for it stays as it is: the visit itself is whole without."""
    begin, end = (mark.encode() for mark in NEXT)
    with contextlib.suppress(OSError):
        text = page.read_bytes() if page.is_file() else b""
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        if found and closed:
            link = b"" if number is None else visit_link(number, "Next").encode()
            write_bytes(page, before + begin + link + end + after)


def is_our_page(path: Path) -> bool:
    """Whether a file is a page that refield wrote, and may be replaced."""
    try:
        with path.open("rb") as file:
            return GENERATOR.encode() in file.read(_HEAD)
    except OSError:
        return False
