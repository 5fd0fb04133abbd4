"""Scenes through the commands as a user would run them, scored as the gauntlet scores them. Nothing is replaced."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("REFIELD_TEST_DATA", ROOT.parent / "shared" / "data"))
SMALL = ("--size", "96", "--spp", "32")
NAMED, RANDOM = (*SMALL, "--cameras", "40"), (*SMALL, "--photos", "40")

Row = dict[str, Any]


@pytest.fixture(scope="session")
def gauntlet() -> Callable[[str], Any]:
    """Imports a part of the gauntlet by name."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    return lambda name: importlib.import_module(f"gauntlet.{name}")


@pytest.fixture(scope="session")
def world(gauntlet, tmp_path_factory) -> Callable[..., Row]:
    """Path-traces a world, fits, updates, renders, evaluates: the scene's row."""

    def run(name: str, seed: int | None = None) -> Row:
        """A world by name, or with a seed the random one."""
        trials, folder = gauntlet("trials"), tmp_path_factory.mktemp(name)
        known = trials.random_worlds([seed], RANDOM) if seed is not None else trials.named_worlds([name], NAMED)
        return gauntlet("row").run_trial(known[0], folder)

    return run


@pytest.fixture(scope="session")
def photographs(gauntlet, tmp_path_factory) -> Callable[[str], Row]:
    """The same with a folder of the real photographs."""

    def run(name: str) -> Row:
        if not (DATA / name / "truth.json").is_file():
            pytest.skip(f"the real photographs are not here ({DATA / name}; REFIELD_TEST_DATA names another place)")
        trial = gauntlet("trials").Trial(name, "as is", None, str(DATA / name))
        return gauntlet("row").run_trial(trial, tmp_path_factory.mktemp(name))

    return run
