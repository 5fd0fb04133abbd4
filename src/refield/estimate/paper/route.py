"""estimate_change_paper(): the paper's steps in order (§4.2), with a segmenter and a matcher of one's choice."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from refield.estimate import look
from refield.estimate.look import View, full_size
from refield.estimate.models import Models
from refield.estimate.paper.associate import Thing, associate
from refield.estimate.paper.config import PaperConfig
from refield.estimate.paper.detect import ViewMasks, detect
from refield.estimate.paper.settle import Outcome, Scene, outcome, settle
from refield.field.radiance import Field
from refield.scene.capture import Capture, Frame
from refield.scene.change import PlacedPhoto, SceneChange
from refield.scene.errors import InputError

OnStage = Callable[[str], None]
_WEIGHTLESS, _AS_PUBLISHED = Models(), PaperConfig()


def estimate_change_paper(
    capture: Capture,
    field: Field,
    frames: Sequence[Frame],
    models: Models = _WEIGHTLESS,
    config: PaperConfig = _AS_PUBLISHED,
    on_stage: OnStage | None = None,
) -> SceneChange:
    """What moved, left or arrived between the capture that ``field`` was fitted to and a few new photos (§4.2).

    An object's confidence is the segmenter's mean over its masks on the new photos, for one that was segmented times
    the part of the old photos on which the segmenter was sure, and for one that moved times the part of the best pair's
    matched features that agree on its pose.

    Args:
        frames: the new photos, with poses in the capture's world.
        models: the default ones need no weights.
        on_stage: called with each step's name as it begins.

    Raises:
        InputError: there is no new photo, or most of the pixels changed: the photos show another scene.
    """
    if not frames:
        raise InputError("new photos", "there are none", "give at least two, with poses in the world of the capture")
    say = on_stage or (lambda name: None)
    photos = tuple(PlacedPhoto(f.name, "used", frame=f) for f in frames)
    say("detect")
    views = [look.view_of(field, f, config.max_pixels) for f in frames]
    survey = [look.view_of(field, f, config.max_pixels) for f in look.spread_out(capture.frames, config.survey)]
    scene = Scene(capture.train, field, models, config, survey)
    seen = detect(views, survey, models.segmenter, config.detect)
    _refuse_another_scene(seen, config.most_changed)
    partners = associate(seen, config.alike)
    if not partners:
        return SceneChange((), photos, "nothing differs by more than the field's own errors on the old photos")
    say("pose")
    settled = [s for p in partners for s in settle(scene, p)]
    say("segment")
    return _concluded([outcome(scene, s) for s in settled], photos, views)


def _refuse_another_scene(seen: Sequence[ViewMasks], most: float) -> None:
    share = sum(float(m.mean()) for v in seen for m in (*v.move_in, *v.move_out)) / len(seen)
    if share > most:
        what = f"{100 * min(share, 1):.0f} % of the pixels changed; is this the same scene?"
        raise InputError("new photos", what, "give photos of the scene that was trained, with poses in its world")


def _concluded(outcomes: Sequence[Outcome], photos: tuple[PlacedPhoto, ...], views: Sequence[View]) -> SceneChange:
    why = "; ".join(o.why for o in outcomes)
    changes = tuple(o.change for o in outcomes if o.change is not None)
    if not changes:
        return SceneChange((), photos, why)
    sure = [o.settled for o in outcomes if o.change is not None]
    return SceneChange(
        changes, photos, why, _union([s.came for s in sure], views), _union([s.gone for s in sure], views)
    )


def _union(things: Sequence[Thing | None], views: Sequence[View]) -> tuple[Tensor, ...]:
    """Per new photo at its full size, (H, W) bool: the pixels of all things."""
    out = [torch.zeros(v.frame.camera.height, v.frame.camera.width, dtype=torch.bool) for v in views]
    for s in (s for t in things if t is not None for s in t.sightings):
        i = next(k for k, v in enumerate(views) if v is s.pair.view)
        out[i] |= full_size(s.mask, s.pair.view.frame)
    return tuple(out)
