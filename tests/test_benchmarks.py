"""The benchmark scripts run, or say why not."""

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


def test_engine_script_makes_its_table(tmp_path: Path) -> None:
    out = tmp_path / "engine.md"
    command = [sys.executable, str(ROOT / "benchmarks" / "engine.py"), "--quick", "--only", "cost", "--out", str(out)]
    subprocess.run(command, env=HERE, cwd=tmp_path, capture_output=True, check=True, timeout=300)
    row = next(line for line in out.read_text(encoding="utf-8").splitlines() if "20 of 32²" in line)
    ms, samples, _, stated, peak, psnr = (float(cell) for cell in row.split("|")[3:9])
    assert ms > 0 and samples > 1 and psnr > 5
    assert 0.2 * stated < peak < 20 * stated
