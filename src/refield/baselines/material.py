"""What re-training and fine-tuning learn from (§5.2): old photos where they still hold, and the new ones in full."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from refield.field.photos import Since
from refield.scene.capture import Capture, Frame
from refield.scene.change import SceneChange
from refield.update.supervision import Places, SuperviseConfig, places_of, united
from refield.vision.pixels import dilate

SHADOW = SuperviseConfig.shadow
"""Reach of the objects' shadows in image widths, as in the update (§10.1.3)"""


def material(capture: Capture, change: SceneChange, shadow: float = SHADOW) -> Since:
    """The paper's re-training data (§5.2) for ``fit_field(capture, since=...)``.

    Old photos lose the pixels that may show what changed: where objects were, with their shadow, and where they are
    now. An old photo with an unsure mask is left out whole. The new photos teach with all their pixels; a ray is drawn
    from all pixels alike, old and new, as the paper does not say otherwise. ``shadow`` is in image widths.
    """
    if not change.objects:
        return Since(change.frames)
    places = places_of(change)
    valid = {f.name: still_holds(places, i, f, shadow) for i, f in enumerate(capture.train)}
    # the estimate has no masks of photos that nobody trains on: their objects are projected from the grids
    valid |= {f.name: still_holds(places, None, f, shadow) for f in capture.held_out}
    return Since(change.frames, valid)


def still_holds(places: Places, index: int | None, frame: Frame, shadow: float = SHADOW) -> Tensor:
    """Pixels of an old photo that show what did not change, (H, W) bool; none of them if a mask of it is unsure.

    ``index`` is the photo's among the training photos, None for another.
    """
    was, now = (united(p, index, frame) for p in (places.was, places.now))
    if was is None or now is None:
        return torch.zeros(frame.camera.height, frame.camera.width, dtype=torch.bool)
    blocked = dilate(was, math.ceil(shadow * frame.camera.width)) | dilate(now, 1)
    return torch.from_numpy(~blocked)
