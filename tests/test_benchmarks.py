"""What the benchmarks say where they cannot run."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.conftest import HERE

ROOT = Path(__file__).parent.parent


@pytest.mark.skipif(torch.cuda.is_available(), reason="it would run")
def test_gpu_script_says_without_a_gpu(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "benchmarks" / "gpu.py"), "--out", str(tmp_path / "gpu.md")]
    said = subprocess.run(command, env=HERE, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (said.returncode, said.stdout) == (2, "")
    assert said.stderr.count("\n") == 1 and "needs an NVIDIA GPU" in said.stderr and "--dry-run" in said.stderr
    assert not list(tmp_path.iterdir())
