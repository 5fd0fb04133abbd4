"""Photos alone: how well structure from motion finds their poses, and localization those of new ones.

    python benchmarks/own_photos.py --data DATA                   # real photographs: DATA/fox
    python benchmarks/own_photos.py --data DATA --whole           # DATA/fox_moved all the way: train, update, evaluate
    python benchmarks/own_photos.py --world FOLDER [FOLDER …]     # what `refield synth` wrote, poses withheld
    python benchmarks/own_photos.py --whole --world FOLDER …      # the same all the way

Prints one table per section, in Markdown, with date, machine and command. What takes long is kept in ``--work``.
"the scene" is the largest distance between two cameras.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import torch
from record import Row, markdown

from refield.cli import main as refield
from refield.estimate.localize import Known, localize, localize_photos
from refield.photos.capture import FromPhotos, capture_from_photos
from refield.photos.gather import gather
from refield.photos.sources import find_sources
from refield.scene.capture import Capture, Frame
from refield.scene.change import PlacedPhoto
from refield.scene.change_files import load_change
from refield.scene.images import read_image, write_image
from refield.scene.load import is_posed, load_capture
from refield.scene.pose import angle_between, transform
from refield.scene.similarity import Similarity, between, pose_errors
from refield.scene.transforms_json import load_transforms
from refield.scene.world import world_of
from refield.synthetic import sample_folder
from refield.workspace import Workspace

LEFT_OUT = 8


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with fox/ and fox_moved/ (real photographs)")
    parser.add_argument("--world", type=Path, nargs="*", default=[], help="folders that `refield synth` wrote")
    parser.add_argument("--whole", action="store_true", help="only train, update and evaluate fox_moved, or the worlds")
    parser.add_argument(
        "--work", type=Path, default=Path("build/own-photos"), help="where intermediate things are kept"
    )
    options = parser.parse_args()
    print(conditions())
    if options.data is not None and options.whole:
        _whole(options.data / "fox_moved", options.work)
    elif options.data is not None:
        found = _motion("fox", options.data / "fox" / "images", options.data / "fox", options.work / "fox")
        _localization(options.data / "fox" / "images", found, options.work)
        _rejected(options.data / "fox" / "images", found, options.work)
    for world in options.world:
        (_whole if options.whole else _world)(world, options.work / f"world-{world.name}")
    return 0


def conditions() -> str:
    """Date, machine and command, for the head of a table."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    cpu = next((line.split(":")[1].strip() for line in lines if "model name" in line), platform.processor())
    machine = f"{os.cpu_count()} cores ({cpu}), Python {platform.python_version()}"
    return f"{datetime.now(UTC):%Y-%m-%d}, {machine}; `python {' '.join(sys.argv)}`\n"


def _show(title: str, rows: list[Row]) -> None:
    print(f"### {title}\n\n{markdown(rows)}\n", flush=True)


def _paired(found: Sequence[Frame], true: Sequence[Frame]) -> tuple[list[Frame], list[Frame]]:
    """The frames of both that are the same photo, by file name."""
    by_name = {Path(f.name).name: f for f in true}
    here = [f for f in found if Path(f.name).name in by_name]
    return here, [by_name[Path(f.name).name] for f in here]


def _motion(title: str, photos: Path, given: Path, cache: Path) -> FromPhotos:
    """Structure from motion against the poses that came with the photos."""
    shutil.rmtree(cache, ignore_errors=True)
    began = time.perf_counter()
    found = capture_from_photos(photos, cache)
    seconds = time.perf_counter() - began
    here, there = _paired(found.capture.frames, load_capture(given).frames)
    away, turned = pose_errors(here, there, between(here, there))
    size = world_of(Capture(tuple(there))).size
    row: Row = {
        "photos": found.photos,
        "registered": len(found.capture.frames),
        "centres, % of the scene: median": 100 * float(away.median()) / size,
        "largest": 100 * float(away.max()) / size,
        "rotation, °: median": float(turned.median()),
        "largest ": float(turned.max()),
        "points": len(found.capture.points),
        "seconds": seconds,
    }
    _show(f"Structure from motion: {title}", [row])
    return found


def _subset(photos: Path, names: Sequence[str], to: Path) -> Path:
    shutil.rmtree(to, ignore_errors=True)
    to.mkdir(parents=True)
    for name in names:
        shutil.copyfile(photos / name, to / name)
    return to


def _localization(photos: Path, full: FromPhotos, work: Path) -> None:
    """Some photos left out of the reconstruction, placed in it, and compared with that of all photos."""
    names = [f.name for f in full.capture.frames]
    out = names[3 :: len(names) // LEFT_OUT][:LEFT_OUT]
    rest = capture_from_photos(_subset(photos, [n for n in names if n not in out], work / "rest"), work / "rest-cache")
    known = Known(rest.capture, rest.landmarks, rest.landmarks.globals_)
    here, there = _paired(rest.capture.frames, full.capture.frames)
    to_full = between(here, there)
    size = world_of(full.capture).size
    gathered = gather(_subset(photos, out, work / "new"), work / "new-cache", among=False)
    rows: list[Row] = []
    for photo in gathered.photos:
        began = time.perf_counter()
        (placed,) = localize([photo], known)
        rows.append(_row(placed, time.perf_counter() - began))
        if placed.frame is not None:
            away, turned = pose_errors(*_paired([placed.frame], full.capture.frames), to_full)
            rows[-1] |= {"centre, % of the scene": 100 * float(away) / size, "rotation, °": float(turned)}
    _show(f"Localization: {len(out)} photos left out of {len(names)}, against the reconstruction of all", rows)


def _row(placed: PlacedPhoto, seconds: float) -> Row:
    p = placed.placement
    told = {"inliers": p.inliers, "matches": p.matches, "error, px": p.error} if p is not None else {}
    return {"photo": placed.name, "status": placed.status, **told, "seconds": seconds}


def _spoilt() -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    dark, line = np.zeros((1, 1, 3), np.uint8), np.zeros((41, 41), np.float32)
    line[20] = 1 / 41
    return {
        "black": lambda image: np.broadcast_to(dark, image.shape).copy(),
        "blurred (σ 8 px)": lambda image: cv2.GaussianBlur(image, (0, 0), 8),
        "moved (41 px)": lambda image: cv2.filter2D(image, -1, line),
    }


def _rejected(photos: Path, full: FromPhotos, work: Path) -> None:
    """Photos that cannot be placed: all of them must be rejected."""
    known = Known(full.capture, full.landmarks, full.landmarks.globals_)
    folder = work / "spoilt"
    shutil.rmtree(folder, ignore_errors=True)
    pick = [f.name for f in full.capture.frames][:: max(len(full.capture.frames) // 6, 1)]
    for what, spoil in _spoilt().items():
        for i, name in enumerate(pick):
            image = spoil(read_image(photos / name).numpy())
            # one pixel of a black photo differs, so that it is not the same picture as the one before it
            image[0, 0] = i
            write_image(folder / what / f"{i}.png", torch.from_numpy(image))
    for i, path in enumerate(sorted((sample_folder() / "before" / "images").iterdir())[:12]):
        image = cv2.resize(read_image(path).numpy(), (960, 960), interpolation=cv2.INTER_CUBIC)
        write_image(folder / "of another scene" / f"{i}.png", torch.from_numpy(image))
    rows: list[Row] = []
    for kind in sorted(folder.iterdir()):
        placed = localize_photos(kind, known, work / "spoilt-cache" / kind.name)
        rejected = [p for p in placed if p.frame is None]
        row: Row = {"photos": kind.name, "rejected": f"{len(rejected)} of {len(placed)}"}
        rows.append(row | {"for example": rejected[0].why if rejected else "–"})
    _show("Photos that cannot be placed", rows)


def _world(world: Path, work: Path) -> None:
    """A world of `refield synth` with all poses withheld: the old photos reconstructed, the new ones placed."""
    found = _motion(world.name, world / "before" / "images", world / "before", work)
    known = Known(found.capture, found.landmarks, found.landmarks.globals_)
    to_true = between(*_paired(found.capture.frames, load_capture(world / "before").frames))
    size = world_of(load_capture(world / "before")).size
    rows: list[Row] = []
    for part in ("after", "eval"):
        true = load_transforms(world / part).frames
        began = time.perf_counter()
        placed = localize_photos(world / part / "images", known, work / part)
        seconds = (time.perf_counter() - began) / len(placed)
        for photo in placed:
            rows.append({"of": part, **_row(photo, seconds)})
            if photo.frame is not None:
                away, turned = pose_errors(*_paired([photo.frame], true), to_true)
                rows[-1] |= {"centre, % of the scene": 100 * float(away) / size, "rotation, °": float(turned)}
    _show(f"Localization: new photos of {world.name}", rows)


def _whole(data: Path, work: Path) -> None:
    """Train, update and measure by the command line, from photos alone and with their given poses."""
    posed = {"before": data / "before", "after": data / "after", "eval": data / "eval"}
    bare = {"before": data / "before" / "images", "after": data / "after" / "images", "eval": _unposed(data, work)}
    rows: list[Row] = []
    for title, parts in (("given", posed), ("withheld", bare)):
        rows += [{"poses": title} | row for row in _all_the_way(parts, data, work / f"whole-{title}")]
    _show(f"{data.name} the whole way: train, update, evaluate", rows)


def _unposed(data: Path, work: Path) -> Path:
    """The evaluation photos and their masks, without poses."""
    out = work / "eval-without-poses"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(data / "eval", out, ignore=shutil.ignore_patterns("transforms.json"))
    return out


def _all_the_way(parts: dict[str, Path], data: Path, place: Path) -> list[Row]:
    shutil.rmtree(place, ignore_errors=True)
    told: Row = {}
    scores = place.with_suffix(".json")
    for command in (
        ["train", parts["before"], place],
        ["update", place, parts["after"]],
        ["evaluate", place, parts["eval"], "--out", scores],
    ):
        began = time.perf_counter()
        code = refield([str(c) for c in command])
        told[f"{command[0]}, s"] = time.perf_counter() - began
        if code != 0:
            return [told | {"exit code": code}]
    found = json.loads(scores.read_text())
    for name in ("psnr_in", "psnr_out", "psnr_untouched"):
        told[name] = found["pooled"][name]
        told[f"{name} before"] = found["pooled_before"][name]
    workspace = Workspace.open(place)
    capture, true = workspace.capture(), load_capture(data / "before")
    change = workspace.change(1)
    told |= {"old photos": len(capture.frames), "new photos": len(change.frames), "objects": len(change.objects)}
    known = _to_true(capture, true, parts["before"])
    if known is None:
        return [told]
    rows: list[Row] = []
    for o in change.objects:
        row: Row = {"kind": o.kind, "confidence": float(o.confidence)}
        row["centre, true units"] = ", ".join(f"{v:.2f}" for v in known.point(o.grid.tight_aabb().mean(0).double()))
        if o.new_from_old is not None:
            row |= _against_truth(known.motion(o.new_from_old), data)
        rows.append(told | row)
    return rows or [told]


def _to_true(capture: Capture, true: Capture, given: Path) -> Similarity | None:
    """From the workspace's world to the true one; None if it is not known which photo is which."""
    frames = list(true.frames)
    if not is_posed(given):  # the workspace numbers photos in the order in which they were taken in
        order = [s.path.name for s in find_sources(given)]
        frames.sort(key=lambda f: order.index(Path(f.name).name))
    if len(capture.frames) != len(frames):
        return None
    known = between(capture.frames, frames)
    away, _ = pose_errors(capture.frames, frames, known)
    return known if float(away.median()) < 0.02 * world_of(true).size else None


def _against_truth(motion: torch.Tensor, data: Path) -> Row:
    """A pose change in the true world beside the nearest true one."""
    found = [_off(motion, *true) for true in _true_motions(data)]
    return min(found, key=lambda row: float(row["off, % of its size"])) if found else {}


def _off(motion: torch.Tensor, expected: torch.Tensor, centre: torch.Tensor, wide: float) -> Row:
    away = float((transform(motion, centre) - transform(expected, centre)).norm())
    return {
        "off, units": away,
        "off, % of its size": 100 * away / wide,
        "off, °": float(angle_between(motion, expected)),
    }


def _true_motions(data: Path) -> list[tuple[torch.Tensor, torch.Tensor, float]]:
    """Of each object that moved: the true T, its old centre, its largest extent."""
    if (data / "truth").is_dir():
        moved = [o for o in load_change(data / "truth").objects if o.new_from_old is not None]
        boxes = [o.grid.tight_aabb().double() for o in moved]
        return [(o.new_from_old, b.mean(0), float((b[1] - b[0]).max())) for o, b in zip(moved, boxes)]
    return [
        (
            torch.tensor(t["T"], dtype=torch.float64),
            torch.tensor(t["centre"], dtype=torch.float64),
            2 * max(t["half_size"]),
        )
        for t in json.loads((data / "truth.json").read_text())
    ]


if __name__ == "__main__":
    raise SystemExit(main())
