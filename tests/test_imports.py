"""Imports go down only, and nothing on a row imports its neighbours (read with ast, nothing is run)."""

import ast
from pathlib import Path

import pytest

import refield

SOURCE = Path(refield.__file__).parent
MAY_IMPORT = {
    "scene": set(),
    "vision": set(),
    "field": {"scene"},
    "synthetic": {"scene", "field"},
    "photos": {"scene", "vision"},  # beside field: what is found here, estimate places new photos by
    "artefacts": {"scene"},
    "workspace": {"scene", "field", "artefacts"},
    "estimate": {"scene", "field", "vision", "photos"},
    "update": {"scene", "field", "vision", "artefacts"},
    "evaluate": {"scene", "field", "vision"},
    "report": {"scene", "field", "vision"},
    "baselines": {"scene", "field", "vision", "update"},  # learns from what the update's supervision leaves
    "rehearse": {"scene", "field", "synthetic"},
    "check": {"scene", "field", "vision", "photos"},
    "nerfstudio": {"scene", "field"},
    "history": {"scene", "field", "update", "workspace", "artefacts"},
    "visits": {
        "scene",
        "field",
        "vision",
        "photos",
        "estimate",
        "update",
        "evaluate",
        "report",
        "workspace",
        "history",
    },
    "export": {"scene", "field", "artefacts", "workspace", "history"},
    "view": {
        "scene",
        "field",
        "estimate",
        "visits",
        "report",
        "export",
        "artefacts",
        "workspace",
        "history",
    },
    "cli": {"scene", "commands"},
    "commands": None,  # joins everything
    "__init__": None,
    "__main__": None,
}
HEAVY = {"torch", "numpy", "scipy", "numba", "cv2", "pycolmap", "mitsuba", "PIL"}
LATE = {  # extras: never when a module is loaded
    "mitsuba",
    "drjit",
    "transformers",
    "av",
    "gsply",
    "skimage",
    "fast_simplification",
    "yaml",
    "viser",
    "websockets",
}


def rooms():
    return sorted({p.stem if p.is_file() else p.name for p in SOURCE.iterdir() if p.name != "__pycache__"})


def files(room):
    return [SOURCE / f"{room}.py"] if (SOURCE / f"{room}.py").is_file() else sorted((SOURCE / room).rglob("*.py"))


def imported(path, *, top_level=False):
    """Full names of the modules imported by a file."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield f"{node.module}"
            if node.module == "refield":
                yield from (f"refield.{alias.name}" for alias in node.names)


def test_every_room_has_its_place():
    assert set(rooms()) <= MAY_IMPORT.keys() | {"py"}


@pytest.mark.parametrize("room", [r for r, allowed in MAY_IMPORT.items() if allowed is not None])
def test_imports_go_down(room):
    wrong = []
    for path in files(room):
        for name in imported(path):
            parts = name.split(".")
            ours = parts[0] == "refield" and len(parts) > 1 and not parts[1].startswith("__")
            if ours and parts[1] not in MAY_IMPORT[room] | {room}:
                wrong.append(f"{path.relative_to(SOURCE)} imports {name}")
    assert not wrong


def test_heavy_optional_modules_are_imported_late():
    found = {
        f"{p.name}: {n}" for p in SOURCE.rglob("*.py") for n in imported(p, top_level=True) if n.split(".")[0] in LATE
    }
    assert not found


def test_the_door_is_light():
    """`import refield` and `refield --help` load nothing heavy."""
    for path in (
        SOURCE / "__init__.py",
        SOURCE / "cli.py",
        SOURCE / "scene" / "errors.py",
        SOURCE / "scene" / "__init__.py",
    ):
        assert not {n.split(".")[0] for n in imported(path, top_level=True)} & (HEAVY | {"tyro", "rich"})


def test_rooms_are_named_for_what_they_hold():
    banned = {"utils", "common", "core", "base", "helpers", "misc"}
    assert not [p for p in SOURCE.rglob("*.py") if p.stem in banned]


def test_no_pickle():
    banned = {"pickle", "dill", "joblib", "shelve", "marshal"}
    assert not [(p, n) for p in SOURCE.rglob("*.py") for n in imported(p) if n.split(".")[0] in banned]
