"""The engine on one NVIDIA GPU: are its kernels right, how fast are they, how fast do fits and views get good.

    python benchmarks/gpu.py [--out gpu.md] [--only fit kernels] [--budget 540]

Each section runs in a process of its own, so that one that fails or overruns takes no other along. What is known is
written to --out (Markdown) and beside it (JSON) after every section. Exit code 2 without a GPU.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SECTIONS = ("tests", "kernels", "fit", "nerfacto", "view", "update")
TESTS = "tests/field/test_gpu_kernels.py"
_LEAST = 15  # seconds that a section is worth starting with

Found = dict[str, Any]
"""A section's tables and what failed in it; see `record.Report`"""


def main() -> int:
    asked = options()
    if asked.dry_run:
        os.environ |= {"TRITON_INTERPRET": "1", "REFIELD_KERNELS": "reference"}
    import_path()
    import torch

    if asked.dry_run:
        torch.set_num_threads(1)
    elif not torch.cuda.is_available():
        message = f"needs an NVIDIA GPU, and torch {torch.__version__} sees none (--dry-run tries the script on a CPU)"
        print(f"benchmarks/gpu.py {message}", file=sys.stderr)
        return 2
    if asked.child:
        run_section(asked)
        return 0
    run_all(asked)
    return 0


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--out", type=Path, default=ROOT / "build" / "gpu.md", help="Markdown; JSON is written beside it")
    add("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="sections; earlier results are kept")
    add("--budget", type=float, default=570, help="seconds for everything")
    add("--repeats", type=int, default=5, help="warm fits and views of which the median is told")
    add("--capture", type=Path, help="folder with a transforms.json instead of the closed-form world")
    add("--world", default="table", help="of refield.synthetic.worlds")
    add("--size", type=int, default=1024, help="pixels a side")
    add("--cameras", type=int, default=200, help="photos, a tenth of them held out")
    add("--samples", type=int, default=1 << 20, help="of a kernel's call")
    add("--shapes", nargs="+", choices=("default", "large"), default=["default", "large"], help="of the field")
    add("--steps", type=int, help="of a fit, default: FitConfig's")
    add("--check-every", type=int, default=100, help="steps between looks at the held-out pixels")
    add("--nerfacto-seconds", type=float, default=120, help="for the NeRFacto shape")
    add("--nerfacto-steps", type=int, default=30_000)
    add("--work", type=Path, default=ROOT / "build" / "gpu-work", help="captures and fields are kept here")
    add("--dry-run", action="store_true", help="tiny, on a CPU, through Triton's interpreter: does the script work?")
    add("--child", choices=SECTIONS, help=argparse.SUPPRESS)
    add("--result", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.dry_run:
        asked.size, asked.cameras, asked.samples, asked.repeats, asked.steps = 16, 10, 64, 1, 5
        asked.check_every, asked.nerfacto_steps, asked.work = 4, 2, asked.work.with_name(asked.work.name + "-dry")
    return asked


def import_path() -> None:
    """The package and the files beside this one, installed or not, here and in child processes."""
    places = [str(ROOT / "src"), str(ROOT)]
    sys.path[:0] = places
    os.environ["PYTHONPATH"] = os.pathsep.join([*places, os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)


# --- all sections ----------------------------------------------------------------------------------------------------


def run_all(asked: argparse.Namespace) -> None:
    """One process a section; what is known so far is written after each."""
    until = time.monotonic() + asked.budget
    for folder in (asked.work, asked.out.parent):
        folder.mkdir(parents=True, exist_ok=True)
    facts = machine(asked)
    results = kept(asked.out.with_suffix(".json"), facts)
    for section in SECTIONS:
        if section not in asked.only:
            continue
        left = until - time.monotonic()
        if left < _LEAST:
            results[section] = {"tables": {}, "failed": ["no time was left (--budget)"]}
        else:
            print(f"[{section}] {left:.0f} s left", flush=True)
            results[section] = in_child(section, asked, left)
        write(asked.out, facts, results)
    print(asked.out.read_text())


def in_child(section: str, asked: argparse.Namespace, seconds: float) -> Found:
    """The section's own process, for so many seconds; whatever it has written counts."""
    result = asked.work / f"result-{section}.json"
    result.unlink(missing_ok=True)
    environment, cache = dict(os.environ), asked.work / "triton-cold"
    if section == "fit":  # its first fit of each shape compiles every kernel
        shutil.rmtree(cache, ignore_errors=True)
        environment["TRITON_CACHE_DIR"] = str(cache)
    again = [a for a in sys.argv[1:]]
    command = [sys.executable, str(Path(__file__).resolve()), *again]
    command += ["--child", section, "--result", str(result), "--budget", f"{seconds:.0f}"]
    why = None
    began = time.monotonic()
    try:
        done = subprocess.run(command, env=environment, timeout=seconds, cwd=Path.cwd())
        why = f"the process ended with code {done.returncode}" if done.returncode else None
    except subprocess.TimeoutExpired:
        why = f"stopped after {seconds:.0f} s"
    found: Found = json.loads(result.read_text()) if result.is_file() else {"tables": {}, "failed": []}
    found["seconds"] = time.monotonic() - began
    found["failed"] += [why] if why else []
    return found


def kept(path: Path, facts: dict[str, str]) -> dict[str, Found]:
    """What an earlier run wrote, if it was on such a machine."""
    try:
        earlier = json.loads(path.read_text())
        same = all(earlier["machine"].get(k) == facts[k] for k in ("GPU", "driver", "torch", "triton"))
        return dict(earlier["sections"]) if same else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def machine(asked: argparse.Namespace) -> dict[str, str]:
    """What the numbers were measured on."""
    import torch
    import triton

    gpu, driver = "none: through Triton's interpreter, numbers mean nothing", "–"
    if not asked.dry_run:
        at = torch.cuda.get_device_properties(0)
        gpu = f"{at.name}, {at.multi_processor_count} multiprocessors, {at.total_memory / 2**30:.0f} GiB"
        driver = said_by("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader").splitlines()[0]
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "machine": f"{os.cpu_count()} CPU cores, {platform.platform()}, Python {platform.python_version()}",
        "GPU": gpu,
        "driver": driver,
        "torch": torch.__version__,
        "triton": triton.__version__,
        "commit": said_by("git", "-C", str(ROOT), "describe", "--always", "--dirty"),
        "command": "python benchmarks/gpu.py " + " ".join(sys.argv[1:]),
    }


def said_by(*command: str) -> str:
    """The output of another program, or a dash."""
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=20).stdout.strip() or "–"
    except (OSError, subprocess.SubprocessError):
        return "–"


# --- the document ----------------------------------------------------------------------------------------------------


def write(out: Path, facts: dict[str, str], results: dict[str, Found]) -> None:
    from benchmarks.record import markdown

    record = {"machine": facts, "asked": asked_for(results), "sections": results}
    out.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n")
    parts = ["# On a GPU", markdown([{"": k, "measured on": v} for k, v in facts.items()])]
    failed = [f"- {section}: {line}" for section, found in results.items() for line in found["failed"]]
    if failed:
        parts += ["**Not everything worked:**", "\n".join(failed)]
    parts += ["## Asked for", markdown(record["asked"])]  # type: ignore[arg-type]
    for section in SECTIONS:
        for title, rows in results.get(section, {"tables": {}})["tables"].items():
            parts += [f"## {title}", markdown(rows)]
    out.write_text("\n\n".join(parts) + "\n")


def asked_for(results: dict[str, Found]) -> list[dict[str, Any]]:
    """The figures that were asked for, beside what was found."""

    def rows(section: str, table: str) -> list[dict[str, Any]]:
        return results.get(section, {}).get("tables", {}).get(table, [])

    fits, views = rows("fit", "Pre-training"), [r for r in rows("view", "A view") if r.get("M rays/s")]
    rates = [r["M samples/s"] for r in fits if r.get("M samples/s")]
    kernels = [r["M samples/s"] for r in rows("kernels", "Kernels") if r["kernel"] == "train_step"]
    updates = rows("update", "Update")
    trained = f"{max(rates):.4g} in fits" if rates else "–"
    trained += f", {max(kernels):.4g} in the step alone" if kernels else ""
    view = min((r["ms"] for r in views), default=None)
    return [
        {
            "what": "pre-training to the quality of 30 000 NeRFacto steps, s",
            "asked": "60, stretch 15",
            "found": against_nerfacto(fits, rows("nerfacto", "NeRFacto shape")),
        },
        {"what": "trained samples, M/s", "asked": "150", "found": trained},
        {"what": "a view, ms", "asked": "50 at 1024²", "found": view},
        {
            "what": "update training, s",
            "asked": "5, stretch 1.5",
            "found": updates[-1]["training s"] if updates else None,
        },
    ]


def against_nerfacto(fits: list[dict[str, Any]], nerfacto: list[dict[str, Any]]) -> str:
    """When each fit was as good as the NeRFacto shape at its end."""
    if not fits or not nerfacto:
        return "–"
    goal, said = nerfacto[-1]["PSNR at the end"], []
    for row in fits:
        curves = row.get("_curves") or [row["_curve"]]
        times = sorted(next((s for s, psnr in c if psnr >= goal), float("inf")) for c in curves)
        middle = times[len(times) // 2]
        said.append(f"{row['field']}, {row['run']}: " + (f"{middle:.3g}" if middle < float("inf") else "not reached"))
    return "; ".join(said) + f" (to the {goal:.2f} dB of {nerfacto[-1]['steps']} steps)"


# --- one section, in its own process ---------------------------------------------------------------------------------


def run_section(asked: argparse.Namespace) -> None:
    import torch

    from benchmarks.record import Report

    report = Report(asked.result, asked.budget)
    device = torch.device("cpu" if asked.dry_run else "cuda")
    with report.trial(asked.child):
        if asked.child == "tests":
            run_tests(report, asked)
        elif asked.child == "kernels":
            from benchmarks import gpu_kernels

            gpu_kernels.measure(report, shapes(asked, fitted=False), device, asked.samples)
        else:
            run_engine(report, asked, device)


def run_engine(report: Any, asked: argparse.Namespace, device: Any) -> None:
    """The sections that fit, render and update."""
    from benchmarks import gpu_fits
    from refield.field.fit import FitConfig
    from refield.field.fit_nerfacto import NerfactoFitConfig
    from refield.field.nerfacto import NerfactoConfig

    if asked.child == "update":
        sizes = [(16, 10)] if asked.dry_run else [(64, 20), (asked.size, asked.cameras)]
        return gpu_fits.update(report, asked.work, device, sizes)
    capture = the_capture(asked, device)
    if asked.child == "fit":
        steps, every = asked.steps or FitConfig.steps, asked.check_every
        configs = {
            name: FitConfig(steps=steps, check_every=every, field=field)
            for name, field in shapes(asked, fitted=True).items()
        }
        if asked.dry_run:
            configs = {k: FitConfig(asked.steps, None, 8, finest_auto=False, field=c.field) for k, c in configs.items()}
        gpu_fits.pretraining(report, capture, configs, device, (asked.repeats, asked.work))
    elif asked.child == "nerfacto":
        field = gpu_fits.tiny_nerfacto() if asked.dry_run else NerfactoConfig()
        seconds = min(asked.nerfacto_seconds, 0.8 * report.left)
        config = NerfactoFitConfig(asked.nerfacto_steps, seconds, 8 if asked.dry_run else 4096, field=field)
        gpu_fits.nerfacto(report, capture, config, device)
    else:
        fields = [p for p in (asked.work / f"field-{s}" for s in asked.shapes) if p.is_dir()]
        if not fields:
            raise FileNotFoundError("no field to look at: run the section 'fit' first")
        gpu_fits.view(report, capture, fields, device, asked.repeats)


def the_capture(asked: argparse.Namespace, device: Any) -> Any:
    """The photos of --capture, or of the closed-form world."""
    from benchmarks.closed_form import closed_form_capture
    from refield.scene.load import load_capture

    if asked.capture:
        return load_capture(asked.capture)
    folder = asked.work / f"{asked.world}-{asked.size}-{asked.cameras}"
    return closed_form_capture(folder, asked.world, asked.size, asked.cameras, device)


def shapes(asked: argparse.Namespace, fitted: bool) -> dict[str, Any]:
    """The fields' shapes by name; a fit chooses the finest level itself."""
    from benchmarks.gpu_fits import tiny_shape
    from refield.field.radiance import HashFieldConfig

    if asked.dry_run:
        return {"default": tiny_shape()}
    known = {
        "default": HashFieldConfig(finest=512 if fitted else 640),
        "large": HashFieldConfig(levels=16, finest=512 if fitted else 1810, log2_table=19, width=64),
    }
    return {name: known[name] for name in asked.shapes}


def run_tests(report: Any, asked: argparse.Namespace) -> None:
    """The kernels against their plain-torch twins, by pytest; each that fails is named."""
    from xml.etree import ElementTree

    said = asked.work / "tests.xml"
    said.unlink(missing_ok=True)
    # another machine's packages may warn, and its command line need not be there: neither is what is asked here
    command = [sys.executable, "-m", "pytest", TESTS, "--noconftest", "-o", "filterwarnings=default", "-q"]
    command += ["-p", "no:cacheprovider", "--tb=line", f"--junitxml={said}"]
    command += ["-k", "small_opacities"] if asked.dry_run else []
    subprocess.run(command, cwd=ROOT, timeout=max(report.left - 5, 1))
    suite = ElementTree.parse(said).getroot().find("testsuite")
    assert suite is not None
    counts = {k: int(suite.get(k, 0)) for k in ("tests", "failures", "errors", "skipped")}
    wrong = counts["failures"] + counts["errors"]
    row = {"kernels against their plain-torch twins": TESTS, "passed": counts["tests"] - wrong - counts["skipped"]}
    report.add("Correctness", row | {"failed": wrong, "skipped": counts["skipped"]})
    for case in suite.iter("testcase"):
        for trouble in (*case.iter("failure"), *case.iter("error")):
            lines = (trouble.get("message") or trouble.text or "").strip().splitlines()
            report.note(f"{case.get('name')}: {lines[0][:200] if lines else 'failed'}")


if __name__ == "__main__":
    sys.exit(main())
