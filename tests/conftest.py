"""What several test files share: a workspace trained for a moment, once per run."""

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command sets it, before anything imports numpy

import numba
import pytest
import torch

from refield.cli import main
from tests.browser import CHROMIUM
from tests.captures import write_capture
from tests.photos.reconstructed import reconstructed as reconstructed

TINY_FIT = ["--fit.steps", "60", "--fit.samples", "2048", "--fit.field.levels", "2"]
TINY_FIT += ["--fit.field.log2-table", "8", "--fit.field.width", "8"]


HERE = {**os.environ, "PYTHONPATH": os.pathsep.join(str(Path(p).resolve()) for p in sys.path)}
"""The environment of a process that imports what this one imports."""

if "PYTEST_XDIST_WORKER" in os.environ:  # there is one for each core: their threads would wait for each other
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    HERE |= {name: "1" for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}


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
