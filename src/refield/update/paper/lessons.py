"""Which pixels teach the paper's update: the new photos whole, the old ones by three masks (§10.1.3, Fig. 12)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from refield.field.pixels import PixelBank
from refield.scene.capture import Frame
from refield.scene.change import SceneChange
from refield.update.paper.config import PaperUpdateConfig
from refield.update.supervision import Places, places_of, united
from refield.vision.pixels import dilate


def lessons(old: Sequence[Frame], change: SceneChange, config: PaperUpdateConfig) -> PixelBank:
    """All pixels that teach, of old photos and of new ones, in one bank: a batch is drawn from it evenly.

    An old photo in which a mask is unsure, or that shows nothing near what changed, is left out whole.

    Raises:
        ValueError: no photo is left.
    """
    places = places_of(change)
    masks = [masked(places, i, frame, config) for i, frame in enumerate(old)]
    taught = [(f, m) for f, m in zip(old, masks) if m is not None and m.any()]
    return PixelBank(
        [*(f for f, _ in taught), *change.frames], masks=[*(m for _, m in taught), *(None for _ in change.frames)]
    )


def masked(places: Places, index: int, frame: Frame, config: PaperUpdateConfig) -> Tensor | None:
    """Pixels of an old training photo that teach, (H, W) bool; None if a mask of it is unsure.

    The move-in mask, the move-out mask grown for the shadow, and the far-field mask are left out. What arrived from
    nowhere, which the paper does not have, lets pixels around its new place teach.
    """
    out, now = (united(p, index, frame) for p in (places.was, places.now))
    arrived = united(tuple(p for p in places.now if p.arrived_only), index, frame)
    if out is None or now is None or arrived is None:
        return None
    width = frame.camera.width
    near = dilate(out | arrived, math.ceil(config.far * width))
    return torch.from_numpy(near & ~dilate(out, math.ceil(config.shadow * width)) & ~now)
