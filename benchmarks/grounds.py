"""Estimate and update on ground that is not flat, and with fewer new photos, beside the flat ground of other tables.

    python benchmarks/grounds.py                                # cube and sphere, three grounds, 4, 2 and 1 new photos
    python benchmarks/grounds.py --worlds cube --only true_1    # a part

Fields and photos are made and kept as `estimate.py` does (``--work``). Each result is kept in ``--out`` once it is
there: run again, the script goes on with what is missing, and prints the tables.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import get_args

import torch
from change_score import score
from estimate import Bench, Scene, spread
from record import Row, markdown
from tables.asked import PATIENT, bench_of, parser
from tables.kept import Kept, Record
from torch import Tensor

from refield.baselines.retrain import retrain
from refield.estimate.recipe import estimate_change
from refield.evaluate import Report, ViewReport, evaluate
from refield.field.fit import FitConfig
from refield.field.radiance import Field
from refield.scene.capture import Frame, Rays, camera_rays
from refield.scene.change import SceneChange
from refield.synthetic.grounds import Ground
from refield.synthetic.visibility import first_hits, view_hits
from refield.update.config import UpdateConfig
from refield.update.ground import GroundConfig
from refield.update.train import update_field

DEFAULT = UpdateConfig(fit=PATIENT)
NO_PLANES = replace(DEFAULT, ground=GroundConfig(footholds=False, textured=False))
_SAME = 0.01  # metres; a photo shows a point if nothing is so far before it
MEASURES = {
    "psnr_in": "in", "psnr_out": "out", "seen": "out, bare and seen", "hidden": "out, bare and hidden",
    "psnr_untouched": "untouched", "before": "untouched before",
}  # fmt: skip
"""dB: name -> heading. Bare: where the object was and is not now; hidden: no new photo shows it"""


def main() -> None:
    options = _options()
    bench = bench_of(options)
    kept = Kept(options.out)
    worlds = [w if g == "flat" else f"{w}-{g}" for w in options.worlds for g in options.grounds]
    for name in options.only:
        for world in worlds:
            kept.once(f"{world}_{options.size}", name, partial(_run, bench, world, name))
    print(markdown(_table(kept, options, worlds)))


def _options() -> argparse.Namespace:
    asked = parser(__doc__, ["cube", "sphere"], list(METHODS), "build/grounds")
    asked.add_argument("--grounds", nargs="+", choices=get_args(Ground), default=list(get_args(Ground)))
    return asked.parse_args()


def _run(bench: Bench, world: str, name: str) -> Record:
    scene = bench.scene(world)
    count, method = METHODS[name]
    frames = spread(scene.new, count)
    began = time.process_time()
    field, more = method(scene, frames)
    seconds = time.process_time() - began
    report = evaluate(field, scene.folder / "data" / "eval", old=scene.field)
    scores = asdict(report.pooled) | _bare(report, scene, frames)
    assert report.pooled_before is not None
    return more | {"scores": scores | {"before": report.pooled_before.psnr_untouched}, "cpu": seconds}


# --- what is measured ---


def _true(config: UpdateConfig, scene: Scene, frames: Sequence[Frame]) -> tuple[Field, Record]:
    """The update by the true change."""
    return _shown(scene, scene.truth(frames), config), {}


def _whole(scene: Scene, frames: Sequence[Frame]) -> tuple[Field, Record]:
    """The update by the estimated change."""
    change = estimate_change(scene.capture, scene.field, frames)
    found = score(change, scene.world, scene.truth(change.frames))
    return _shown(scene, change, DEFAULT), {"truth": asdict(found)}


def _shown(scene: Scene, change: SceneChange, config: UpdateConfig) -> Field:
    field = update_field(scene.capture, scene.field, change, config)
    assert isinstance(field, Field)
    return field


def _retrained(scene: Scene, frames: Sequence[Frame]) -> tuple[Field, Record]:
    return retrain(scene.capture, scene.truth(frames), FitConfig(directions=False)), {}


METHODS: dict[str, tuple[int, Callable[[Scene, Sequence[Frame]], tuple[Field, Record]]]] = {
    "whole_4": (4, _whole),
    "true_4": (4, partial(_true, DEFAULT)),
    "true_4_no_planes": (4, partial(_true, NO_PLANES)),
    "true_2": (2, partial(_true, DEFAULT)),
    "true_1": (1, partial(_true, DEFAULT)),
    "retrained_4": (4, _retrained),
}
"""name -> how many new photos, and what is done with them"""
TITLES = {
    "whole_4": "estimate and update, 4 photos",
    "true_4": "update by the true change, 4 photos",
    "true_4_no_planes": "the same without planes (`ground.footholds`, `ground.textured` off)",
    "true_2": "the same, 2 photos",
    "true_1": "the same, 1 photo",
    "retrained_4": "re-trained, colours without directions",
}

# --- how good it is where ---


def _bare(report: Report, scene: Scene, frames: Sequence[Frame]) -> dict[str, float | None]:
    """PSNR of the bare pixels, those that a new photo shows and the others, and which part of all bare ones these
    are."""
    errors: list[Tensor] = []
    seen: list[Tensor] = []
    for view in report.views:
        assert view.mask_in is not None and view.mask_out is not None
        bare = view.mask_out & ~view.mask_in
        errors.append((view.render - view.truth).square().mean(-1)[bare])
        seen.append(_seen(scene, view, frames)[bare])
    error, shown = torch.cat(errors), torch.cat(seen)
    part = float((~shown).float().mean())
    return {"seen": _psnr(error[shown]), "hidden": _psnr(error[~shown]), "part hidden": part}


def _psnr(error: Tensor) -> float | None:
    return -10 * math.log10(max(float(error.mean()), 1e-10)) if len(error) else None


def _seen(scene: Scene, view: ViewReport, frames: Sequence[Frame]) -> Tensor:
    """Pixels of a view whose surface one of the photos shows, (H, W) bool."""
    frame = view.frame
    assert frame is not None
    depth = view_hits(scene.world.after, frame.camera, frame.world_from_cam).depth
    rays = camera_rays(frame.camera, frame.world_from_cam)
    x = rays.origins + rays.directions * depth.reshape(-1, 1).nan_to_num(posinf=0.0)
    shown = torch.zeros(len(x), dtype=torch.bool)
    for photo in frames:
        pose = photo.world_from_cam.float()
        inside = photo.camera.shows(*photo.camera.project((x - pose[:3, 3]) @ pose[:3, :3]))
        away = (x - pose[:3, 3]).norm(dim=-1)
        to = Rays(pose[:3, 3].expand(x.shape).contiguous(), (x - pose[:3, 3]) / away[:, None])
        shown |= inside & (first_hits(scene.world.after, to).depth > away - _SAME)
    return shown.reshape(depth.shape) & depth.isfinite()


def _table(kept: Kept, options: argparse.Namespace, worlds: Sequence[str]) -> list[Row]:
    rows: list[Row] = []
    for world in worlds:
        for name in options.only:
            record = kept.get(f"{world}_{options.size}", name)
            if record is None:
                continue
            row: Row = {"world": world, "": TITLES[name]}
            row |= {title: record["scores"][key] for key, title in MEASURES.items()}
            row["hidden, %"] = 100 * record["scores"]["part hidden"]
            truth = record.get("truth")
            first = truth["objects"][0] if truth else {"distance": None, "angle": None}
            row["cm"] = None if first["distance"] is None else 100 * first["distance"]
            row |= {"degrees": first["angle"], "false": truth and truth["false_alarms"], "s": record["cpu"]}
            rows.append(row)
    return rows


if __name__ == "__main__":
    main()
