"""One method on one case: trained, timed, measured, with its renders kept. Every method gives one JSON record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from change_score import score
from torch import Tensor

from refield.baselines.curve import Curve, Point, looks_until
from refield.baselines.finetune import finetune
from refield.baselines.inpaint import Inpainter, inpaint
from refield.baselines.retrain import retrain
from refield.estimate.pose_change import RefineConfig
from refield.estimate.recipe import EstimateConfig, estimate_change
from refield.evaluate import EvaluateConfig, Report, evaluate, rescored
from refield.field.fit import FitConfig
from refield.field.radiance import Field, HashField
from refield.scene.capture import Frame
from refield.scene.change import SceneChange
from refield.scene.change_files import load_change, save_change
from refield.scene.errors import InputError
from refield.scene.images import write_image
from refield.scene.load import load_new_photos
from refield.update.config import UpdateConfig
from refield.update.supervision import SuperviseConfig
from refield.vision.perceptual import Perceptual
from tables.cases import BOTTOM, TOP, Case
from tables.kept import Kept, Record
from tables.watched import stage_seconds, updated

VIEWS = (1, 2, 3, 4, 8, 12, 16)
"""numbers of new photos (§12.2)"""
WHOLE, TRAINING = 20, 60
"""the longer re-training goes on for so many times our whole update, or our training alone, whichever is longer"""
_SPARE = 1.7  # late steps are quicker than those of a short training, which foretell the time
ALIGNMENTS = {"as rendered": EvaluateConfig(), "aligned": EvaluateConfig(align=True)}
UNREFINED = EstimateConfig(refine=RefineConfig(steps=(0, 0)))
"""the initial poses (§12.1)"""


@dataclass(frozen=True)
class Lab:
    """What all methods share."""

    kept: Kept
    fit: FitConfig
    update: UpdateConfig
    perceptual: Perceptual | None = None
    lama: Inpainter | None = None
    looks: int = 16
    """points of a curve"""
    warmed: set[str] = field(default_factory=set)

    def warm(self, case: Case) -> None:
        """Compile what is compiled before anything is timed in this process."""
        if self.warmed:
            return
        self.warmed.add(case.key)
        change = estimate_change(case.capture, case.field, case.frames)
        short = replace(self.fit, steps=20)
        updated(case.capture, case.field, change, replace(self.update, fit=replace(self.update.fit, steps=20)))
        evaluate(retrain(case.capture, change, short), case.evaluation)


def run_method(lab: Lab, case: Case, method: str) -> Record:
    """A method's result, from before or from now."""
    return lab.kept.once(case.key, method, lambda: METHODS[method](lab, case))


# --- what changed ---


def estimate(lab: Lab, case: Case) -> Record:
    lab.warm(case)
    return _estimated(lab, case, "estimate", case.frames, EstimateConfig())[0]


def estimate_unrefined(lab: Lab, case: Case) -> Record:
    lab.warm(case)
    return _estimated(lab, case, "estimate_unrefined", case.frames, UNREFINED)[0]


def _estimate_views(count: int) -> Callable[[Lab, Case], Record]:
    def run(lab: Lab, case: Case) -> Record:
        return _estimated(lab, case, f"estimate_{count}_views", case.views(count), EstimateConfig())[0]

    return run


def _estimated(
    lab: Lab, case: Case, method: str, frames: Sequence[Frame], config: EstimateConfig
) -> tuple[Record, SceneChange | None]:
    """The change, which is kept, and its record: refused, or what was found and the seconds of each stage."""
    marks: list[tuple[str, float]] = []
    try:
        change = estimate_change(
            case.capture, case.field, frames, config, on_stage=lambda s: marks.append((s, time.perf_counter()))
        )
    except InputError as error:
        return {"refused": str(error)}, None
    seconds = stage_seconds(marks, time.perf_counter())
    folder = _change_folder(lab, case, method)
    folder.mkdir(parents=True, exist_ok=True)
    save_change(folder, change)
    record: Record = {"seconds": seconds, "total": sum(seconds.values()), "why": change.why}
    record["objects"] = [{"kind": o.kind, "confidence": float(o.confidence), "note": o.note} for o in change.objects]
    if case.folder is None:
        found = score(change, case.scene.world, case.truth(change.frames))
        record["truth"] = asdict(found)
    return record, change


def _change_folder(lab: Lab, case: Case, method: str) -> Path:
    return lab.kept.folder / "changes" / case.key / method


def change_of(lab: Lab, case: Case, method: str = "estimate") -> SceneChange:
    """What an estimate found, estimated now if it was not before.

    Raises:
        InputError: the photos were refused, or nothing was found.
    """
    record = run_method(lab, case, method)
    if "refused" in record:
        raise InputError(f"{case.key}, {method}", f"the photos were refused ({record['refused']})", "see its record")
    change = load_change(_change_folder(lab, case, method), case.capture, photos=case.frames)
    if not change.objects:
        raise InputError(f"{case.key}, {method}", f"nothing was found ({change.why})", "see its record")
    return change


# --- how good it is ---


def measured(lab: Lab, case: Case, method: str, shown: Field, folder: Path | None = None) -> Record:
    """Scores with and without alignment; renders are kept."""
    reports = {
        name: evaluate(shown, folder or case.evaluation, config=config, perceptual=lab.perceptual)
        for name, config in ALIGNMENTS.items()
    }
    _keep_pictures(lab, case, method, [v.render for v in reports["as rendered"].views])
    return _scores(reports)


def _scores(reports: dict[str, Report]) -> Record:
    return {"scores": {name: asdict(r.pooled) for name, r in reports.items()}}


def _keep_pictures(lab: Lab, case: Case, method: str, pictures: Sequence[Tensor]) -> None:
    for i, picture in enumerate(pictures):
        write_image(lab.kept.pictures(case.key, method) / f"{i:04d}.png", picture)


def _scorer(lab: Lab, case: Case) -> Callable[[Field], dict[str, float | None]]:
    """Of curves: whole views and regions, without LPIPS."""

    def of(shown: Field) -> dict[str, float | None]:
        return asdict(evaluate(shown, case.evaluation).pooled)

    return of


def _plain(points: Sequence[Point]) -> list[Record]:
    return [asdict(p) for p in points]


# --- the update and its ablations ---


def old(lab: Lab, case: Case) -> Record:
    return measured(lab, case, "old", case.field)


def ours(lab: Lab, case: Case) -> Record:
    change = change_of(lab, case)
    lab.warm(case)
    return _updated(lab, case, "ours", change, lab.update, curve=True)


def no_adjacent(lab: Lab, case: Case) -> Record:
    """×OA: the helper only inside the object's own grid, and old photos teach nothing around it (Fig. 9b)."""
    return _updated(
        lab,
        case,
        "no_adjacent",
        change_of(lab, case),
        replace(
            lab.update,
            cut=replace(lab.update.cut, dilation=1.0),
            ground=replace(lab.update.ground, reach=1.0),
            supervise=_without_old(lab),
        ),
    )


def _without_old(lab: Lab) -> SuperviseConfig:
    return replace(lab.update.supervise, far=0.0)


def no_old(lab: Lab, case: Case) -> Record:
    """The helper where it usually is, taught by the new photos alone."""
    return _updated(lab, case, "no_old", change_of(lab, case), replace(lab.update, supervise=_without_old(lab)))


def no_refine(lab: Lab, case: Case) -> Record:
    """×PR: everything as before, from the initial poses (Fig. 9c)."""
    try:
        change = change_of(lab, case, "estimate_unrefined")
    except InputError as error:
        return {"refused": str(error)}
    return _updated(lab, case, "no_refine", change, lab.update)


def _true_views(count: int) -> Callable[[Lab, Case], Record]:
    """The update alone, from the true change and so many new photos (§12.2.2)."""

    def run(lab: Lab, case: Case) -> Record:
        return _updated(lab, case, f"true_{count}_views", case.truth(case.views(count)), lab.update)

    return run


def top_views(lab: Lab, case: Case) -> Record:
    """New photos from above, evaluated at the usual views and from below (Table 8)."""
    frames = load_new_photos(case.seen_from(TOP), case.capture)
    record, change = _estimated(lab, case, "top_views", frames, EstimateConfig())
    if change is None or not change.objects:
        return record
    new = updated(case.capture, case.field, change, lab.update)
    below = measured(lab, case, "top_views_below", new.field, case.seen_from(BOTTOM, turn=45))
    return record | measured(lab, case, "top_views", new.field) | {"below": below["scores"]}


def usual_views_below(lab: Lab, case: Case) -> Record:
    """The usual update evaluated from below, to tell what is due to the new photos' height."""
    new = updated(case.capture, case.field, change_of(lab, case), lab.update)
    return measured(lab, case, "usual_views_below", new.field, case.seen_from(BOTTOM, turn=45))


def _updated(
    lab: Lab, case: Case, method: str, change: SceneChange, config: UpdateConfig, curve: bool = False
) -> Record:
    found = updated(case.capture, case.field, change, config, _scorer(lab, case) if curve else None)
    record: Record = {"seconds": found.seconds, "train": sum(found.seconds.values())}
    record |= {"why": found.field.why_stopped, "curve": _plain(found.curve)}
    return record | measured(lab, case, method, found.field)


# --- the baselines ---


def retrained(lab: Lab, case: Case) -> Record:
    return _trained(lab, case, "retrained", lambda change, curve: retrain(case.capture, change, lab.fit, curve))


def retrained_long(lab: Lab, case: Case) -> Record:
    """Re-training for `WHOLE` times our update, with a schedule to match: can more time make up for it?"""
    first, ours, usual = (run_method(lab, case, m) for m in ("estimate", "ours", "retrained"))
    seconds = max(WHOLE * (first["total"] + ours["train"]), TRAINING * ours["seconds"]["train"])
    steps = math.ceil(_SPARE * seconds * usual["steps"] / usual["train"])
    config = replace(lab.fit, steps=max(steps, 1))
    return _trained(
        lab, case, "retrained_long", lambda change, curve: retrain(case.capture, change, config, curve), config.steps
    )


def finetuned(lab: Lab, case: Case) -> Record:
    return _trained(
        lab, case, "finetuned", lambda change, curve: finetune(case.capture, case.field, change, lab.fit, curve)
    )


def _trained(
    lab: Lab,
    case: Case,
    method: str,
    train: Callable[[SceneChange, Curve], HashField],
    steps: int | None = None,
) -> Record:
    """``steps``: that the training will take; the usual number by default."""
    change = change_of(lab, case)
    lab.warm(case)
    curve = Curve(_scorer(lab, case), looks_until(steps or lab.fit.steps, lab.looks))
    new = train(change, curve)
    last = curve.points[-1]
    record: Record = {"train": last.seconds, "steps": last.step, "curve": _plain(curve.points)}
    return record | measured(lab, case, method, new)


def inpainted(lab: Lab, case: Case) -> Record:
    """The old field's renders with the move-out mask painted over."""
    return _painted(lab, case, "inpainted", None, from_photo=False)


def inpainted_photo(lab: Lab, case: Case) -> Record:
    """The evaluation photos with the mask painted over, as the paper does: their surroundings are the truth."""
    return _painted(lab, case, "inpainted_photo", None, from_photo=True)


def lama_photo(lab: Lab, case: Case) -> Record:
    return _painted(lab, case, "lama_photo", lab.lama, from_photo=True)


def _painted(lab: Lab, case: Case, method: str, painter: Inpainter | None, from_photo: bool) -> Record:
    began, reports = time.perf_counter(), {}
    for name, config in ALIGNMENTS.items():
        shown = evaluate(case.field, case.evaluation, config=config)
        pictures = []
        for view in shown.views:
            source = view.truth if from_photo else view.render
            # a render's object reaches beyond its true mask by some pixels
            margin = 0 if from_photo else math.ceil(0.015 * source.shape[1])
            mask = view.mask_out
            pictures.append(source if mask is None else inpaint(source, mask, painter, margin))
        reports[name] = rescored(shown, pictures, config, lab.perceptual)
    _keep_pictures(lab, case, method, [v.render for v in reports["as rendered"].views])
    return _scores(reports) | {"seconds": {"all": time.perf_counter() - began}}


METHODS: dict[str, Callable[[Lab, Case], Record]] = {
    f.__name__: f
    for f in (
        estimate, estimate_unrefined, old, ours, no_adjacent, no_old, no_refine, top_views, usual_views_below,
        retrained, retrained_long, finetuned, inpainted, inpainted_photo, lama_photo,
    )
}  # fmt: skip
METHODS |= {f"estimate_{n}_views": _estimate_views(n) for n in VIEWS}
METHODS |= {f"true_{n}_views": _true_views(n) for n in VIEWS}
