"""The browser of tests that need a real one; the fixture is `browser`."""

import runpy
from pathlib import Path

import pytest

CHROMIUM = runpy.run_path(str(Path(__file__).parent.parent / "benchmarks" / "chromium.py"))["CHROMIUM"]
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")
