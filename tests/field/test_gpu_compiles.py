"""GPU kernels of a fit compile for Hopper: Triton's interpreter, in which they are tested, compiles nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SHAPES = [(10, 32), (13, 64)]  # levels and width of the smallest and of a large field


def compiled(levels: int, width: int) -> None:
    """Compile what has products of matrices in it; in a process of its own, where kernels are not interpreted."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from refield.field.kernels.gpu import marching, networks

    density = networks.density_shape(levels, width)
    whole = density | {"K": 15, "KP": 16, "PRECISION": "tf32"}
    kernels = {
        networks._forward: whole | {"KEEP": True} | networks._FORWARD,
        networks._backward: whole | networks._BACKWARD,
        networks._density_alone: density | networks._FORWARD,
        marching._count_visible: density | {"FINE": False} | marching._SEEING,
    }
    numbers = {"tables": "*i64", "levels": "*i32", "grid": "*u8", "fine": "*u8", "counts": "*i64", "n": "i32"}
    numbers |= {"size": "i32", "side": "i32"} | dict.fromkeys(("radius", "near", "far", "step", "stop"), "fp32")
    for kernel, asked in kernels.items():
        how = {name: asked.pop(name) for name in ("num_warps", "num_stages") if name in asked}
        signature = {n: "constexpr" if n in asked else numbers.get(n, "*fp32") for n in kernel.arg_names}
        source = ASTSource(fn=kernel, signature=signature, constexprs=asked)
        done = triton.compile(source, target=GPUTarget("cuda", 90, 32), options=how)
        assert done.metadata.shared <= 227 << 10, kernel  # bytes that a program may have
        # with 8 warps for blocks of 64 rows, products that follow on each other came out wrong on an H100, unsteadily
        assert asked["BLOCK"] >= 16 * how["num_warps"], kernel


@pytest.mark.parametrize("shape", SHAPES)
def test_kernels_compile_for_a_gpu(shape: tuple[int, int], tmp_path: Path) -> None:
    pytest.importorskip("triton")
    code = f"from tests.field.test_gpu_compiles import compiled; compiled{shape}"
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env=environment,
        cwd=Path(__file__).parents[2],
        capture_output=True,
        timeout=300,
        text=True,
    )
    assert run.returncode == 0, run.stderr[-3000:]
