"""update_field_paper(): the paper's update as Fig. 11 has it, for a field of NeRFacto's shape."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from refield.field.nerfacto import NerfactoField
from refield.field.radiance import Field
from refield.scene.capture import Capture
from refield.scene.change import SceneChange
from refield.scene.errors import InputError
from refield.update.paper.config import PaperUpdateConfig
from refield.update.paper.field import PaperField, begun, ready
from refield.update.paper.lessons import lessons
from refield.update.paper.training import OnProgress, PaperTraining

AS_PUBLISHED = PaperUpdateConfig()


def update_field_paper(
    capture: Capture,
    field: Field,
    change: SceneChange,
    config: PaperUpdateConfig = AS_PUBLISHED,
    on_stage: Callable[[str], None] | None = None,
    on_progress: OnProgress | None = None,
) -> PaperField:
    """The field of the changed scene; ``field`` itself is not touched.

    Args:
        capture: the old photos.
        field: fitted to them, of NeRFacto's shape, or one that this has updated before.
        change: what changed, and the new photos.
        on_stage: called with each stage's name as it begins.

    Raises:
        InputError: the field is of another kind, or there is no new photo.
        NonFiniteError: the loss or its gradient was not finite for 20 steps in a row.
    """
    checked = need_nerfacto(field, "the field to update")
    if not change.frames:
        what = "brings no new photos, which the paper's update learns from"
        raise InputError("the change", what, "give some, or leave --update.route out")
    say = on_stage or (lambda name: None)
    say("supervise")
    bank = lessons(capture.train, change, config)
    say("train")
    updated = begun(checked, change, (len(bank.frames), config.look), config.dilation, config.seed)
    run = PaperTraining(updated, bank, config, torch.Generator().manual_seed(config.seed))
    run.run(on_progress)
    say("show")
    done = ready(updated)
    done.why_stopped = run.why_stopped
    return done


def need_nerfacto(field: Field, where: str | Path) -> NerfactoField | PaperField:
    """The field, if the paper's update can take it.

    Raises:
        InputError: naming ``where``, what it is, and how to get one that it can.
    """
    if isinstance(field, NerfactoField | PaperField):
        return field
    if hasattr(field, "pretrained"):
        what = "has been updated by refield's own route, on which the paper's update cannot build"
        raise InputError(where, what, "take these visits back with refield undo, or leave --route out")
    what = f"is a {type(field).__name__}; the paper's update fine-tunes the proposal networks of a NerfactoField"
    raise InputError(where, what, "train one with: refield train DATA WORK --route paper-reduced (or paper)")
