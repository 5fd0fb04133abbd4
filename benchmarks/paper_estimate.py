"""The paper's estimate without weights, step by step: poses from SIFT by true masks, and all of it by GrabCut.

    python benchmarks/paper_estimate.py                              # four worlds at 512²
    python benchmarks/paper_estimate.py --worlds cube --seeds 2      # one, two seeds
    python benchmarks/paper_estimate.py --only poses                 # the pose step alone

``poses`` is given the true masks of the new photos, in place of SAM's, and tells what each step makes of them: the pair
with the most inliers (§9.2), the features of all pairs, 500 steps of Adam through the field (§9.3). ``whole`` is given
nothing. Errors are at the object's centre. Photos and fields are made once, as `estimate.py` makes them (``--work``),
and rows are kept in ``--out``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import torch
from change_score import score
from estimate import PAPER, Bench, Scene
from record import Row, markdown

from refield.estimate.look import view_of
from refield.estimate.paper.associate import Sighting, Thing
from refield.estimate.paper.config import PaperConfig
from refield.estimate.paper.detect import paired
from refield.estimate.paper.pose import matched_pose
from refield.estimate.paper.route import estimate_change_paper
from refield.estimate.paper.settle import refined_pose
from refield.evaluate import pose_error
from refield.scene.errors import InputError
from refield.synthetic.worlds import WORLDS
from refield.vision.matcher import SiftMatcher
from refield.vision.segmenter import GrabCutSegmenter

CONFIG = PaperConfig()


def poses(scene: Scene) -> Row:
    """The pose step (§4.2.3) of a world in which one object moved."""
    truth = scene.truth(scene.new)
    views = [view_of(scene.field, f, CONFIG.max_pixels) for f in scene.new]
    pairs = [paired(v, GrabCutSegmenter(), CONFIG.detect) for v in views]
    gone, came = (
        Thing(tuple(Sighting(p, m.numpy(), 1.0, np.ones(1)) for p, m in zip(pairs, masks)))
        for masks in (truth.masks_out, truth.masks_in)
    )
    one = matched_pose(gone, came, SiftMatcher(), replace(CONFIG.pose, pairs="best"))
    began = time.perf_counter()
    found = matched_pose(gone, came, SiftMatcher(), CONFIG.pose)
    row: Row = {"best pair: cm, degrees": "–" if one is None else _errors(scene, one.new_from_old)}
    if found is None:
        return row | {"found": "no"}
    matched = time.perf_counter()
    better = refined_pose(scene.field, found, came, CONFIG)
    return row | {
        "all pairs: cm, degrees": _errors(scene, found.new_from_old),
        "inliers": f"{found.inliers} of {sum(len(m.uv) for m in found.matches)}",
        "found": "yes",
        "refined: cm, degrees": _errors(scene, better.new_from_old),
        "steps": better.steps,
        "s, matching": matched - began,
        "s, Adam": time.perf_counter() - matched,
    }


def _errors(scene: Scene, new_from_old: torch.Tensor) -> str:
    (change,) = scene.world.changes
    assert change.new_from_old is not None and change.old is not None
    distance, angle = pose_error(new_from_old, change.new_from_old, change.old.world_from_item[:3, 3])
    return f"{100 * distance:.3f}, {angle:.2f}"


def whole(scene: Scene) -> Row:
    """All steps, by GrabCut, histograms of its colours, and SIFT."""
    marks: list[tuple[str, float]] = []
    try:
        change = estimate_change_paper(
            scene.capture, scene.field, scene.new, config=CONFIG, on_stage=lambda s: marks.append((s, time.time()))
        )
    except InputError as error:
        return {"said": str(error)}
    marks.append(("", time.time()))
    result = score(change, scene.world, scene.truth(change.frames))
    row: Row = {"mask in": result.mask_in, "mask out": result.mask_out}
    for k, f in enumerate(result.objects):
        mark = "" if k == 0 else f" {k + 1}"
        row |= {f"true{mark}": f.kind, f"said{mark}": f.said or "–", f"3-D IoU{mark}": f.iou}
        row |= {f"cm{mark}": None if f.distance is None else 100 * f.distance, f"degrees{mark}": f.angle}
    row |= {"false alarms": result.false_alarms, "_why": change.why}
    return row | {f"s, {name}": b - a for (name, a), (_, b) in itertools.pairwise(marks)}


SECTIONS = {"poses": poses, "whole": whole}


def _rows(bench: Bench, section: str, worlds: Sequence[str], path: Path) -> list[Row]:
    kept: dict[str, Row] = json.loads(path.read_text()) if path.is_file() else {}
    for name, seed in itertools.product(worlds, range(bench.seeds)):
        key = f"{name} {seed}, {bench.size}²"
        if key not in kept:
            scene = bench.scene(name, seed)
            about: Row = {"world": name, "seed": seed, "old photos": len(scene.capture.frames)}
            kept[key] = about | SECTIONS[section](scene)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(kept, indent=1))  # each takes minutes
    return [kept[f"{n} {s}, {bench.size}²"] for n, s in itertools.product(worlds, range(bench.seeds))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--worlds", nargs="+", choices=sorted(WORLDS), default=list(PAPER))
    parser.add_argument("--seeds", type=int, default=1, help="of each world")
    parser.add_argument("--size", type=int, default=512, help="pixels a side")
    parser.add_argument("--cameras", type=int, default=50, help="old photos of a world")
    parser.add_argument("--spp", type=int, default=64, help="light paths a pixel of worlds that are made now")
    parser.add_argument("--work", type=Path, default=Path("build/estimate-work"))
    parser.add_argument("--out", type=Path, default=Path("build/paper-estimate"))
    options = parser.parse_args()
    print(f"{date.today()}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    bench = Bench(options.work, options.out, options.size, options.cameras, options.seeds, options.spp)
    for section in options.only:
        rows = _rows(bench, section, options.worlds, options.out / f"{section}.json")
        print(f"\n### {section}\n\n{markdown(rows)}\n", flush=True)


if __name__ == "__main__":
    main()
