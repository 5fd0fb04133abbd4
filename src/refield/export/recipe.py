"""A workspace's state as files of other programs, in a folder that names them all (``export.json``)."""

from __future__ import annotations

import contextlib
import importlib.util
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from refield.artefacts import LOCK, locked, need_space, part_folder, sync, sync_folder, writable
from refield.export.cameras import write_cameras
from refield.export.changes import name_of, write_changes
from refield.export.mesh import FACES, mesh_of, need_a_mesh, write_mesh
from refield.export.objects import points_in
from refield.export.seen import Progress, View, views_of
from refield.export.splats import discs_of, splats_of, write_splats
from refield.export.surface import POINTS, Points, Surface, surface_of
from refield.history import state
from refield.scene.capture import Capture, Frame
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.errors import InputError
from refield.scene.files import read_json, write_json
from refield.scene.ply import write_surface
from refield.scene.world import World
from refield.workspace import MARKER, Workspace, refuse_inside

What = Literal["points", "mesh", "splats", "cameras", "changes"]
EVERYTHING: tuple[What, ...] = ("points", "mesh", "splats", "cameras", "changes")
MANIFEST = "export.json"
_FORMAT = "refield export"
_NEEDED = {
    "mesh": {"skimage": "scikit-image", "fast_simplification": "fast-simplification"},
    "splats": {"gsply": "gsply"},
}
_SHOWN = ("points", "mesh", "splats")  # what is made of a field's surface
_FEWEST = 50  # points that are a thing of their own
_AXES = (
    "All positions and poses are in the world of the workspace's photos, never turned, shifted or scaled. "
    "PLY, SPZ and JSON hold its coordinates as they are. In .glb, whose y points up, everything hangs on the node "
    "upright_from_world, which turns the world's up to +y; below it are the world's coordinates. "
    "Cameras look along -z with +y up in transforms.json and .glb, along +z with +y down in the COLMAP model. "
    "Lengths are in the world's unit."
)

Counter = Callable[[str], AbstractContextManager[Progress]]
"""A progress bar for things of a name"""


@dataclass(frozen=True)
class ExportConfig:
    """What is written, and how finely."""

    what: tuple[What, ...] = EVERYTHING
    """which kinds of files"""
    objects: bool = False
    """write each object that changed at this visit by itself too"""
    points: int = POINTS
    """of the surface, at most; also the number of splats on it"""
    faces: int = FACES
    """of a mesh, at most"""


@dataclass(frozen=True)
class _Scene:
    """What is exported."""

    workspace: Workspace
    visit: int
    world: World
    frames: tuple[Frame, ...]
    """from whose places the surface is looked at"""
    how: ExportConfig


def export(
    workspace: Workspace,
    out: Path,
    how: ExportConfig = ExportConfig(),
    *,
    visit: int | None = None,
    overwrite: bool = False,
    on_stage: Callable[[str], None] = lambda name: None,
    counting: Counter | None = None,
) -> list[Path]:
    """Write the state after ``visit`` (the latest for None) into the folder ``out``; the files written.

    They appear together at the end, in place of those that an earlier export wrote under the same names. ``overwrite``
    also replaces others.

    Raises:
        InputError: there is no such visit; a package that writes the files is missing; ``out`` cannot be used.
    """
    visit = workspace.chosen_visit(visit)
    _need_packages(how.what)
    refuse_inside(out)
    if out.exists() and not out.is_dir():
        raise InputError(out, "is a file, not a folder", "choose another output folder")
    if (out / MARKER).exists():
        raise InputError(out, "is a workspace", "choose another output folder")
    if not how.what:
        raise InputError("--what", "names nothing", f"give some of {', '.join(get_args(What))}, or leave it out")
    if how.points < _FEWEST or how.faces < _FEWEST:
        raise InputError("--points, --faces", f"{min(how.points, how.faces)} is too few", f"give {_FEWEST} or more")
    changes = [workspace.change(n, masks=False) for n in range(1, visit + 1)]
    capture = workspace.capture()
    frames = (*capture.frames, *(f for change in changes for f in change.frames))
    scene = _Scene(workspace, visit, workspace.world(), frames, how)
    made = not out.exists()
    with writable(out):
        out.mkdir(parents=True, exist_ok=True)
    try:
        with locked(out):
            try:
                with part_folder(out) as part:
                    _write_all(scene, part, capture, changes, on_stage, counting or _uncounted)
                    return _put(part, out, visit, overwrite=overwrite, facts=_facts(scene))
            finally:
                (out / LOCK).unlink(missing_ok=True)
    finally:
        if made and not (out / MANIFEST).exists():
            with contextlib.suppress(OSError):
                out.rmdir()


def _need_packages(what: Iterable[What]) -> None:
    for kind in what:
        missing = [name for module, name in _NEEDED.get(kind, {}).items() if importlib.util.find_spec(module) is None]
        if missing:
            needs = (
                f"needs {' and '.join(missing)}, which are not installed"
                if missing[1:]
                else f"needs {missing[0]}, which is not installed"
            )
            raise InputError(f"--what {kind}", needs, "install it: pip install 'refield[export]'")


def _write_all(
    scene: _Scene,
    part: Path,
    capture: Capture,
    changes: Sequence[SceneChange],
    on_stage: Callable[[str], None],
    counting: Counter,
) -> None:
    what = scene.how.what
    if "cameras" in what:
        on_stage("cameras")
        sets = {"capture": capture}
        sets |= {f"visit_{n}": Capture(c.frames, held_out_every=0) for n, c in enumerate(changes, start=1) if c.objects}
        need_space(part, sum(f.path.stat().st_size for s in sets.values() for f in s.frames))
        for name, photos in sets.items():
            write_cameras(part / "cameras" / name, photos, scene.world)
    change = changes[-1] if changes else SceneChange()
    if "changes" in what:
        on_stage("changes")
        write_changes(part, change, scene.world, scene.visit)
    if not set(_SHOWN) & set(what):
        return
    views, surface = _looked(scene, scene.visit, on_stage, counting)
    _write_shown(scene, part, surface, views, on_stage)
    if scene.how.objects and change.objects:
        _write_objects(scene, part, change, surface.points, on_stage, counting)


def _looked(
    scene: _Scene, visit: int, on_stage: Callable[[str], None], counting: Counter
) -> tuple[list[View], Surface]:
    """The state after a visit as its photos' cameras see it."""
    on_stage(f"load the field as of visit {visit}")
    field = state(scene.workspace, visit)
    on_stage(f"look at it from {len(scene.frames)} photos' places")
    with counting("views") as counted:
        views = views_of(field, scene.frames, counted)
    on_stage("surface")
    return views, surface_of(field, views, scene.how.points)


def _write_shown(
    scene: _Scene, part: Path, surface: Surface, views: Sequence[View], on_stage: Callable[[str], None]
) -> None:
    if len(surface.points) < _FEWEST:
        what = "shows no surface that its photos' views agree on"
        raise InputError(scene.workspace.path, what, "train it longer, or export only --what cameras changes")
    if "points" in scene.how.what:
        on_stage("points")
        _write_points(part / "points.ply", surface.points)
    if "splats" in scene.how.what:
        on_stage("splats")
        write_splats(part, "splats", splats_of(surface, views))
    if "mesh" in scene.how.what:
        on_stage("mesh")
        mesh = need_a_mesh(mesh_of(surface.points, scene.how.faces), scene.workspace.path)
        write_mesh(part, "mesh", mesh, scene.world, {"visit": scene.visit})


def _write_objects(
    scene: _Scene,
    part: Path,
    change: SceneChange,
    now: Points,
    on_stage: Callable[[str], None],
    counting: Counter,
) -> None:
    """Each object where it is after the visit; one that left, where it was before."""
    before = now
    if any(o.kind == "removed" for o in change.objects):
        before = _looked(scene, scene.visit - 1, on_stage, counting)[1].points
    on_stage(f"{len(change.objects)} objects by themselves")
    for index, o in enumerate(change.objects, start=1):
        _write_object(scene, part / "objects", name_of(scene.visit, index), o, before if o.kind == "removed" else now)


def _write_object(scene: _Scene, folder: Path, name: str, o: ObjectChange, points: Points) -> None:
    points = points_in(points, o.grid_now or o.grid)
    if len(points) < _FEWEST:  # hardly seen: there is no thing to show
        return
    folder.mkdir(exist_ok=True)
    if "points" in scene.how.what:
        _write_points(folder / f"{name}_points.ply", points)
    if "splats" in scene.how.what:
        write_splats(folder, f"{name}_splats", discs_of(points))
    if "mesh" in scene.how.what and (mesh := mesh_of(points, scene.how.faces)) is not None:
        write_mesh(folder, f"{name}_mesh", mesh, scene.world, {"object": name, "kind": o.kind})


def _write_points(path: Path, points: Points) -> None:
    write_surface(
        path, points.xyz, normals=points.normal, rgb=points.rgb, comments=["refield points, world coordinates"]
    )


def _facts(scene: _Scene) -> dict[str, Any]:
    world = scene.world
    size = world.size if math.isfinite(world.size) else None
    return {"axes": _AXES, "up": list(world.up), "metres_per_unit": world.metres_per_unit, "size": size}


def _put(part: Path, out: Path, visit: int, *, overwrite: bool, facts: dict[str, Any]) -> list[Path]:
    """Bring every file of ``part`` to its place in ``out`` and note it there; what has other names stays."""
    names = sorted(p.relative_to(part).as_posix() for p in part.rglob("*") if p.is_file())
    known = _known(out)
    foreign = [name for name in names if (out / name).exists() and name not in known]
    if (out / MANIFEST).exists() and not _is_manifest(out / MANIFEST):
        foreign.append(MANIFEST)
    if foreign and not overwrite:
        what = f"holds files that refield export did not write ({', '.join(foreign[:3])})"
        raise InputError(out, what, "choose another output folder, or pass --overwrite")
    sync(part)
    listed = {name: facts for name, facts in known.items() if (out / name).is_file()}
    listed |= {name: {"visit": visit, "bytes": (part / name).stat().st_size} for name in names}
    # first, so that what is there of an export that was stopped now is known as ours
    manifest = {"format": _FORMAT, "version": 1, **facts, "files": dict(sorted(listed.items()))}
    with writable(out):
        write_json(out / MANIFEST, manifest)
        for name in names:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).replace(out / name)
    sync_folder(out)
    return [out / name for name in names]


def _known(out: Path) -> dict[str, Any]:
    """The files that earlier exports wrote into a folder."""
    if not _is_manifest(out / MANIFEST):
        return {}
    files = read_json(out / MANIFEST).get("files")
    return files if isinstance(files, dict) else {}


def _is_manifest(path: Path) -> bool:
    """Whether an export wrote this file."""
    try:
        return read_json(path).get("format") == _FORMAT
    except InputError:
        return False


class _Uncounted(AbstractContextManager[Progress]):
    def __enter__(self) -> Progress:
        return lambda done, total: None

    def __exit__(self, *what: object) -> None:
        return None


def _uncounted(what: str) -> AbstractContextManager[Progress]:
    return _Uncounted()
