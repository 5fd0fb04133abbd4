"""What several test files share: a workspace trained for a moment, once per run."""

import os
import sys
from pathlib import Path

import pytest

from refield.cli import main
from refield.field.sampling import RESOLUTION
from tests.browser import CHROMIUM
from tests.captures import write_capture
from tests.photos.reconstructed import reconstructed as reconstructed

TINY_FIT = ["--fit.steps", "60", "--fit.samples", "2048", "--fit.field.levels", "2"]
TINY_FIT += ["--fit.field.log2-table", "8", "--fit.field.width", "8"]


HERE = {**os.environ, "PYTHONPATH": os.pathsep.join(str(Path(p).resolve()) for p in sys.path)}
"""The environment of a process that imports what this one imports."""


@pytest.fixture(scope="session", autouse=True)
def coarse_cells():
    """Fits of a moment look into 64³ cells in place of 128³: making these and looking them through is most of what they
    take. What is begun as a process of its own, and `tests/chain`, has the usual cells."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("refield.field.placing.RESOLUTION", 64)
        yield


@pytest.fixture(scope="module")
def usual_cells():
    """For a file whose tests heed what the cells hold, or tenths of a dB: it names this before all its fixtures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("refield.field.placing.RESOLUTION", RESOLUTION)
        yield


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """``data/`` (a capture), ``new/`` (four posed photos of the same scene) and ``work/`` (trained on it).

    To be copied before anything is written.
    """
    folder = tmp_path_factory.mktemp("tiny")
    write_capture(folder / "data", 12)
    write_capture(folder / "new", 4, turn=0.2)
    assert main(["train", str(folder / "data"), str(folder / "work"), *TINY_FIT]) == 0
    return folder


@pytest.fixture(scope="module")
def browser():
    """Chromium, headless."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM)
        yield chromium
        chromium.close()
