"""Pictures for the page: data URIs, change masks laid over a photo, the before/after sheet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from refield.report.visit import Comparison


def write_contact_sheet(path: Path | str, views: Sequence[Comparison], height: int = 240) -> Path:
    """One row per view, before · photo · after, as a PNG; a picture that is missing leaves its place out."""
    raise NotImplementedError
