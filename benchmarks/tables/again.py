"""What re-training and the update are given to learn from, and how each way of re-training is run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import torch
from estimate import Scene
from torch import Tensor

from refield.baselines.curve import Curve, looks_until
from refield.baselines.finetune import finetune
from refield.baselines.material import material
from refield.baselines.retrain import retrain
from refield.baselines.told import carried_along, left_empty
from refield.evaluate import Report, evaluate
from refield.field.fit import FitConfig, fit_field
from refield.field.fit_nerfacto import REDUCED, fit_nerfacto
from refield.field.photos import Since
from refield.field.radiance import Field
from refield.scene.capture import Capture
from refield.scene.change import SceneChange
from refield.scene.images import frame_image
from refield.scene.load import load_capture
from refield.synthetic.cameras import square_camera
from refield.synthetic.write import shoot_state
from refield.update.config import UpdateConfig
from refield.update.train import update_field
from tables.asked import PATIENT
from tables.kept import Record

LONGER = 4  # times the usual steps
_LOOKS = 12  # points of the curve of the longer one
_ANEW = 7_000_003  # seed of the first photo's light paths: other noise than in the old photos
_SAME, _SPECKS = 0.02, 5  # of 1, by which a pixel has changed; pixels a side over which noise is averaged


def seen(folder: Path, field: Field) -> dict[str, float | None]:
    """Scores in dB of the photos in an evaluation's folder, and what part of their out-masks shows the object now."""
    report = evaluate(field, folder)
    return asdict(report.pooled) | {"bare": _bare(report)} | {"overlap": _overlap(report)}


def _seen_in_time(folder: Path) -> Callable[[Field], dict[str, float | None]]:
    """`seen`, and ``cpu``: seconds of processor time since now, without those that it takes to look."""
    began, looking = time.process_time(), 0.0

    def look(field: Field) -> dict[str, float | None]:
        nonlocal looking
        at = time.process_time()
        found = seen(folder, field) | {"cpu": at - began - looking}
        looking += time.process_time() - at
        return found

    return look


def seen_new(folder: Path, field: Field) -> dict[str, float | None]:
    """The same of the photos that taught."""
    found = evaluate(field, folder).pooled
    return {"new": found.psnr, "new_in": found.psnr_in, "new_out": found.psnr_out}


def _parts(report: Report) -> list[tuple[Tensor, Any, Any]]:
    """Of each view the squared error (H, W, 3) and the masks in and out."""
    return [((v.render - v.truth).square(), v.mask_in, v.mask_out) for v in report.views]


def _bare(report: Report) -> float:
    """PSNR, dB, where something was and the object is not now."""
    errors = torch.cat([error[was & ~now] for error, now, was in _parts(report)])
    return -10 * math.log10(max(float(errors.mean()), 1e-10))


def _overlap(report: Report) -> float:
    """Part of the out-masks that shows the object where it is now."""
    shown, of = (sum(int(m.sum()) for m in masks) for masks in zip(*((n & w, w) for _, n, w in _parts(report))))
    return shown / of


@dataclass(frozen=True)
class Case:
    """A world, its change and everything that re-training may be given."""

    scene: Scene
    seed: int
    """of the training"""
    change: SceneChange
    """the true one"""

    @property
    def capture(self) -> Capture:
        return self.scene.capture

    @property
    def anew(self) -> Capture:
        """All old photos taken again, of the new state."""
        return load_capture(self.scene.folder / "anew")

    def take_anew(self, spp: int) -> None:
        """Path-trace these photos, unless that was done before; ``spp``: light paths a pixel."""
        folder = self.scene.folder / "anew"
        if not (folder / "transforms.json").is_file():
            poses = [f.world_from_cam for f in self.capture.frames]
            camera = square_camera(self.capture.frames[0].camera.width)
            shoot_state(self.scene.world.after, folder, (camera, poses), (spp, _ANEW))

    @property
    def plain(self) -> Since:
        """What the paper's re-training has (§5.2)."""
        return material(self.capture, self.change)

    @property
    def half(self) -> Since:
        return replace(self.plain, share=0.5)

    @property
    def bare(self) -> Since:
        return replace(self.half, empty=left_empty(self.change))

    @property
    def carried(self) -> Since:
        return carried_along(self.capture, self.half, self.change)

    @property
    def all_of_it(self) -> Since:
        return replace(self.carried, empty=self.bare.empty)

    @property
    def without_shadows(self) -> Since:
        """Nothing of an old photo that has changed, shadows and light included, and all else of it."""
        pairs = zip(self.capture.frames, self.anew.frames, strict=True)
        return replace(self.half, valid={then.name: _unchanged(*map(frame_image, (then, now))) for then, now in pairs})


def _unchanged(then: Tensor, now: Tensor) -> Tensor:
    """Pixels that two photos (H, W, 3) uint8 from one place show alike, (H, W) bool."""
    off = cv2.blur((then.float() - now.float()).numpy() / 255, (_SPECKS, _SPECKS))
    return torch.from_numpy(np.abs(off).max(-1) < _SAME)


def _again(case: Case, since: Since, directions: bool = False, steps: int = 1) -> tuple[Field, Record]:
    """Re-trained from random weights."""
    fit = FitConfig(directions=directions, seed=case.seed)
    if steps == 1:
        return retrain(case.capture, case.change, fit, since=since), {}
    fit = replace(fit, steps=steps * fit.steps)
    curve = Curve(_seen_in_time(case.scene.folder / "data" / "eval"), looks_until(fit.steps, _LOOKS))
    field = retrain(case.capture, case.change, fit, curve, since)
    return field, {"curve": [asdict(p) for p in curve.points]}


def _onward(case: Case, since: Since, directions: bool = True) -> tuple[Field, Record]:
    """The old field trained on."""
    fit = FitConfig(directions=directions, seed=case.seed)
    return finetune(case.capture, case.scene.field, case.change, fit, since=since), {}


def _nerfacto(case: Case, since: Since) -> tuple[Field, Record]:
    return cast(Field, fit_nerfacto(case.capture, replace(REDUCED, seed=case.seed), since=since).field), {}


def _anew(case: Case) -> tuple[Field, Record]:
    new = Since(tuple(case.change.frames))
    return fit_field(case.anew, FitConfig(seed=case.seed), since=new), {}


def _update(case: Case) -> tuple[Field, Record]:
    field = update_field(
        case.capture, case.scene.field, case.change, replace(UpdateConfig(fit=PATIENT), seed=case.seed)
    )
    return cast(Field, field), {}


ROWS: dict[str, tuple[str, Callable[[Case], tuple[Field, Record]]]] = {
    "old": ("before the update", lambda c: (c.scene.field, {})),
    "update": ("**our update**", _update),
    "retrained": ("re-trained, as in Table 3", lambda c: _again(c, c.plain, directions=True)),
    "plain": ("(a) colours without directions", lambda c: _again(c, c.plain)),
    "half": ("(b) half of the rays from the new photos", lambda c: _again(c, c.half, directions=True)),
    "both": ("(a) and (b)", lambda c: _again(c, c.half)),
    "nerfacto": ("(c) NeRFacto, reduced", lambda c: _nerfacto(c, c.plain)),
    "nerfacto_half": ("(c) and (b)", lambda c: _nerfacto(c, c.half)),
    "without_shadows": ("(f) (a), (b), old pixels by true differences", lambda c: _again(c, c.without_shadows)),
    "empty": ("(f) (a), (b), what left is empty", lambda c: _again(c, c.bare)),
    "carried": ("(f) (a), (b), old photos carried along", lambda c: _again(c, c.carried)),
    "told": ("(f) (a), (b), both of these", lambda c: _again(c, c.all_of_it)),
    "nerfacto_carried": ("(f) (c), (b), old photos carried along", lambda c: _nerfacto(c, c.carried)),
    "finetuned": ("the old field trained on", lambda c: _onward(c, c.plain)),
    "finetuned_half": ("the same, (a) and (b)", lambda c: _onward(c, c.half, directions=False)),
    "finetuned_told": ("the same, all that is told", lambda c: _onward(c, c.all_of_it, directions=False)),
    "longer": (f"(f) (a), (b), carried along, {LONGER} times the steps", lambda c: _again(c, c.carried, steps=LONGER)),
    "anew": ("all photos taken anew", _anew),
}  # fmt: skip
"""key -> title, and how it is made"""
ANEW = ("without_shadows", "anew")
"""rows that need all old photos taken again"""
