"""``refield doctor``: whether refield can run here, and what it would run with."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import re
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table
from tyro.conf import OmitArgPrefixes, arg

from refield.commands.answer import Answer
from refield.commands.options import PLAIN, Output
from refield.scene.errors import InputError

EXAMPLES = ("refield doctor", "refield doctor --weights ~/weights/sam2", "refield doctor --json")
_NEEDED = ("torch", "numpy", "scipy", "numba", "cv2", "PIL", "safetensors", "pycolmap")
_EXTRAS = {
    "synth": "path-traced worlds: refield synth",
    "sam": "SAM, LightGlue, DINOv2 with weights from a folder: --estimate.models",
    "heic": "HEIC photos, as phones take them",
    "video": "films as MP4: refield render --out film.mp4",
    "export": "meshes and splats: refield export",
    "view": "the scene in the browser: refield view",
    "nerfstudio": "fields that nerfstudio has trained: refield import",
    "dev": "tests and checks of refield itself",
}


@dataclass(frozen=True)
class Doctor:
    """Tell what refield has to run with on this machine: packages, cores, memory, GPU, extras, compiled kernels.

    Ends with 0 if it can run here, else with 2.
    """

    weights: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """a folder with a model's weights, to be opened and named"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Doctor) -> Answer:
    faults: list[tuple[str, str]] = []
    document: dict[str, Any] = {
        "refield": {"version": importlib.metadata.version("refield"), "folder": Path(__file__).parent.parent},
        "python": {"version": platform.python_version(), "executable": sys.executable},
        "system": f"{platform.system()} {platform.machine()}",
        "packages": _packages(faults),
    }
    if not faults:
        document |= {"gpu": _gpu(), "kernels": _kernels(faults)}
    document |= {"cores": _cores(), "memory": _memory(), "disk": _disk(faults), "extras": _extras()}
    if options.weights is not None:
        document["weights"] = _weights(options.weights, faults)
    document |= {"can_run": not faults, "faults": [f"{what}; {remedy}" for what, remedy in faults]}
    if faults:
        what, remedy = (list(parts) for parts in zip(*faults))
        return Answer(document, [_table(document)], stop=InputError("doctor", "; ".join(what), "; ".join(remedy)))
    return Answer(document, [_table(document), "refield can run here"])


def _packages(faults: list[tuple[str, str]]) -> dict[str, str | None]:
    """Versions of what refield needs; None for what cannot be imported."""
    out: dict[str, str | None] = {}
    for name in _NEEDED:
        try:
            module = importlib.import_module(name)
            out[name] = str(getattr(module, "__version__", "?"))
        except Exception as error:  # whatever a broken installation makes of it
            out[name] = None
            faults.append((f"{name} cannot be imported ({_line(error)})", "pip install --force-reinstall refield"))
    return out


def _gpu() -> dict[str, Any]:
    import torch

    seen = torch.cuda.is_available()
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())] if seen else []
    return {"seen": seen, "names": names, "torch_built_for": torch.version.cuda or "the CPU alone"}


def _kernels(faults: list[tuple[str, str]]) -> dict[str, Any]:
    """Whether loops can be compiled, and what is kept of those that were; by the folders numba keeps them in."""
    import numba
    from numba.core.registry import CPUDispatcher

    importlib.import_module("refield.commands.update")  # and with it every module that has kernels
    began = time.perf_counter()
    try:
        compiles = numba.njit(_add)(1, 2) == 3
    except Exception as error:  # of llvmlite, or of the machine
        compiles = False
        faults.append((f"numba cannot compile ({_line(error)})", "pip install --force-reinstall numba llvmlite"))
    seconds = time.perf_counter() - began
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("refield.")]
    kernels = {k for m in modules for k in vars(m).values() if isinstance(k, CPUDispatcher)}
    folders = sorted({Path(k.stats.cache_path) for k in kernels if k.stats.cache_path})
    kept = [file for folder in folders for file in folder.glob("*.nbc")]
    return {
        "compile": compiles,
        "seconds_for_a_small_one": seconds,
        "kernels": len(kernels),
        "cached": len({file.name.partition(".py")[0] for file in kept}),
        "cache_bytes": sum(file.stat().st_size for file in kept),
        "cache_folders": folders,
        "cache_writable": all(os.access(_there(folder), os.W_OK) for folder in folders),
        "threads": numba.get_num_threads(),
    }


def _add(a: int, b: int) -> int:
    return a + b


def _there(path: Path) -> Path:
    """The folder, or the first above it that is there."""
    return next(p for p in (path, *path.resolve().parents) if p.exists())


def _cores() -> dict[str, Any]:
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    limits = {name: os.environ[name] for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS") if name in os.environ}
    return {"machine": os.cpu_count(), "for_this_process": allowed, "limited_by": limits}


def _memory() -> dict[str, int | None]:
    """Bytes; what is free is known on Linux alone."""
    out: dict[str, int | None] = {"total": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), "free": None}
    if (table := Path("/proc/meminfo")).is_file():
        found = re.search(r"MemAvailable:\s+(\d+) kB", table.read_text())
        out["free"] = int(found[1]) * 1024 if found else None
    return out


def _disk(faults: list[tuple[str, str]]) -> dict[str, Any]:
    """Where workspaces are made if nothing else is said, and where intermediate files go."""
    scratch = Path(tempfile.gettempdir())
    if not os.access(scratch, os.W_OK):
        faults.append((f"{scratch} cannot be written", "set TMPDIR to a folder that can"))
    return {"here": Path.cwd(), "free": shutil.disk_usage(Path.cwd()).free, "scratch": scratch}


def _extras() -> list[dict[str, Any]]:
    """Each extra that this installation names, and which of its packages are there."""
    out: dict[str, dict[str, str | None]] = {}
    for requirement in importlib.metadata.requires("refield") or ():
        if found := re.fullmatch(r"([\w.-]+).*;.*extra == ['\"]([\w-]+)['\"].*", requirement):
            out.setdefault(found[2], {})[found[1]] = _version(found[1])
    return [
        {"name": name, "for": _EXTRAS.get(name, ""), "packages": packages, "complete": all(packages.values())}
        for name, packages in out.items()
    ]


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _weights(folder: Path, faults: list[tuple[str, str]]) -> dict[str, Any]:
    """Which model's weights these are, once they have been opened."""
    from refield.scene.files import read_json
    from refield.vision.weights import CLASSES, WeightsError, open_model

    try:
        kind = str(read_json(folder / "config.json").get("model_type"))
        fits = [name for name, accepted in CLASSES.items() if kind in accepted]
        classes = {k: v for accepted in CLASSES.values() for k, v in accepted.items()}
        model = open_model(folder, classes)
    except (InputError, WeightsError) as error:
        faults.append((f"{error.where if isinstance(error, InputError) else error.folder}: {error.what}", error.remedy))
        return {"folder": folder, "model": None}
    return {"folder": folder, "model": fits[0], "parameters": sum(p.numel() for p in model.parameters())}


def _table(told: dict[str, Any]) -> Table:
    out = Table("", "", show_header=False)
    out.add_row("refield", f"{told['refield']['version']}, {told['refield']['folder']}")
    out.add_row("Python", f"{told['python']['version']}, {told['python']['executable']}, {told['system']}")
    packages = [f"{name} {version or 'MISSING'}" for name, version in told["packages"].items()]
    out.add_row("packages", ", ".join(packages))
    out.add_row("cores", _cores_told(told["cores"]))
    memory = told["memory"]
    free = "" if memory["free"] is None else f", {memory['free'] / 1e9:.1f} GB free"
    out.add_row("memory", f"{memory['total'] / 1e9:.1f} GB{free}")
    out.add_row("disk", f"{told['disk']['free'] / 1e9:.1f} GB free in {told['disk']['here']}")
    if "gpu" in told:
        gpu = told["gpu"]
        seen = ", ".join(gpu["names"]) or "none seen; not needed"
        out.add_row("GPU", f"{seen} (torch is built for {gpu['torch_built_for']})")
        out.add_row("compiled kernels", _kernels_told(told["kernels"]))
    for extra in told["extras"]:
        lacking = [name for name, there in extra["packages"].items() if there is None]
        state = f"lacks {', '.join(lacking)}: pip install 'refield\\[{extra['name']}]'" if lacking else "there"
        out.add_row(f"extra {extra['name']}", f"{state}; {extra['for']}" if extra["for"] else state)
    if "weights" in told:
        weights = told["weights"]
        opened = f"{weights['model']}, {weights['parameters'] / 1e6:.1f} million" if weights["model"] else "not usable"
        out.add_row("weights", f"{weights['folder']}: {opened}")
    return out


def _cores_told(cores: dict[str, Any]) -> str:
    limits = "".join(f", {name}={value}" for name, value in cores["limited_by"].items())
    return f"{cores['for_this_process']} of {cores['machine']} for this process{limits}"


def _kernels_told(kernels: dict[str, Any]) -> str:
    kept = f"{kernels['cached']} kept, {kernels['cache_bytes'] / 1e6:.0f} MB"
    if not kernels["cached"]:
        kept = "none kept yet: the first fit and the first update compile them, a minute or two"
    kept += "" if kernels["cache_writable"] else "; their folder cannot be written: set NUMBA_CACHE_DIR to one that can"
    return f"{kept}; threads: {kernels['threads']}"


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__
