"""What was settled, as plain data: the objects' grids, poses and masks, and why it was concluded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from refield.estimate import past, segment
from refield.estimate.arrive import fresh, shadow_of
from refield.estimate.confidence import confidence
from refield.estimate.detect import Changed, Errors, Mask
from refield.estimate.ground import Ground
from refield.estimate.lattice import Body
from refield.estimate.layers import Sight, layers_at
from refield.estimate.likelihood import Settled
from refield.estimate.look import Array, full_size
from refield.estimate.objects import Old
from refield.estimate.pose_change import PoseChange
from refield.field.radiance import Field
from refield.scene.capture import Frame
from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, SceneChange
from refield.scene.pose import adjoint, angle_between, rigid, transform
from refield.vision import pixels

_NOTABLE = 0.002  # of a photo's pixels; smaller spots that nothing explains are not spoken of
_MUCH = 0.25  # of the changed pixels; less that nothing explains is the ragged edge of what something does
_LARGE = 0.02  # of a photo's pixels
_BY_ONE = "; one photo does not tell how far away it is, nor whether it came from where that photo does not look"
_MASK_RAYS = 300_000  # for the outlines of one object in all new photos; larger photos' masks are scaled up


@dataclass(frozen=True)
class Told:
    """What a conclusion is drawn from, besides what was settled."""

    ground: Ground
    frames: Sequence[Frame]
    """the old training photos"""
    changed: Sequence[Changed]
    photos: tuple[PlacedPhoto, ...]
    """all of the new ones; ``changed`` and the settled views go with those that are used"""
    errors: Errors
    """what the field gets wrong where nothing changed"""


def concluded(scene: Told, settled: Settled) -> SceneChange:
    """The estimate's answer: what is believed, why, and what is not understood."""
    olds, frames = settled.olds, scene.frames
    changes = [_moved(frames, settled, k) for k in settled.moved]
    for k, share in settled.removed.items():
        note = f"{100 * share:.0f} % of its pixels {_instead(settled, k)}"
        note += "; or it moved, and shows a side that no old photo saw" if settled.arrived else ""
        masks, sure = _masks_of(frames, olds[k]), confidence("removed", settled.led[k], bool(settled.arrived))
        changes.append(ObjectChange("removed", olds[k].shape, masks=masks, confidence=sure, note=note))
    once = len(settled.views) == 1
    for body, lead in zip(settled.arrived, settled.came):
        grid, share = _newcomer(body), fresh(settled.views, body)
        note = f"it hides what was there in {100 * share:.0f} % of its pixels, and nothing that left looks like it"
        note += _BY_ONE if once else ""
        masks, sure = segment.masks_in(frames, grid), confidence("added", lead, bool(settled.removed) or once)
        changes.append(ObjectChange("added", grid, masks_in=masks, confidence=sure, note=note))
    left = _unexplained(scene, settled)
    reasons = [f"1 {c.kind}{_by(c)}, {100 * c.confidence:.0f} % sure: {c.note}" for c in changes]
    reasons += [_said_of(scene, left)] if left else []
    if not reasons:
        reasons = ["some pixels differ, but no object that moved, left or arrived explains them better than before"]
    ins, outs = _pixel_masks(scene.ground.field, scene.changed, settled) if changes else ((), ())
    unexplained = tuple(full_size(m, c.view.frame) for m, c in zip(left, scene.changed))
    return SceneChange(tuple(changes), scene.photos, "; ".join(reasons), ins, outs, unexplained)


def disagreeing(
    changed: Sequence[Changed], photos: tuple[PlacedPhoto, ...], errors: Errors, least: float = 0.0
) -> SceneChange:
    """The answer where the photos' changes meet nowhere in space, or only where they fill less than the part ``least``
    of every photo; told if they are more than the odd spot, and more than the field's ``errors`` are in photos that
    show no change."""
    why = "the pixels that differ agree on no place that more than one photo shows"
    why += f", and that fills {100 * least:.2g} % of any" if least else ""
    shares = [float(c.certain.mean()) for c in changed]
    most = int(np.argmax(shares))
    if shares[most] < _LARGE:
        return SceneChange((), photos, why)
    if not errors.unusual(shares):
        alone = f"{100 * shares[most]:.0f} % of {changed[most].view.frame.name} differ, which nothing confirms"
        return SceneChange((), photos, f"{why}; {alone}")
    share = 100 * float(np.mean(shares))
    why += f"; {share:.0f} % of the photos' pixels are not understood: do the photos show one and the same state?"
    return SceneChange((), photos, why, unexplained=tuple(full_size(c.certain, c.view.frame) for c in changed))


def _moved(frames: Sequence[Frame], settled: Settled, k: int) -> ObjectChange:
    old, change, twins = settled.olds[k], settled.moved[k], settled.twins.get(k, ())
    centre = transform(change.new_from_old, torch.from_numpy(old.centre).double())
    about = adjoint(rigid(torch.eye(3, dtype=torch.float64), centre))
    moved = ObjectChange(
        "moved",
        old.shape,
        change.new_from_old,
        _masks_of(frames, old),
        segment.masks_in(frames, old.shape.moved(change.new_from_old)),
        confidence=confidence("moved", settled.led[k], False),
        covariance=about @ change.covariance @ about.T,
        alternatives=tuple(twin.new_from_old for twin in twins),
    )
    return replace(moved, note=_why_moved(change) + _or(change, twins))


def _instead(settled: Settled, k: int) -> str:
    """What the pixels of an object that left show."""
    if past.background_seen(settled.views, settled.olds[k]):
        return "show what is behind it"
    return "look like what is around it, since no old photo shows what is behind"


def _or(change: PoseChange, twins: Sequence[PoseChange]) -> str:
    """What is to be said of poses that the photos show as well."""
    turns = [angle_between(twin.new_from_old[:3, :3], change.new_from_old[:3, :3]) for twin in twins]
    degrees = " or ".join(f"{float(turn):.0f}" for turn in turns)
    return f"; turned by {degrees} degrees more it would look the same" if turns else ""


def _masks_of(frames: Sequence[Frame], old: Old) -> tuple[Tensor | None, ...]:
    """Where the object was, on every old photo; a remembered one is projected, as its new place is."""
    return segment.masks_in(frames, old.shape) if old.remembered else segment.masks_out(frames, old)


def _why_moved(change: PoseChange) -> str:
    return (
        f"{100 * change.explained:.0f} % of its pixels show it at its new place, {100 * change.before:.0f} % what was"
        " there before"
    ) + (f"; {change.note}" if change.note else "")


def _by(o: ObjectChange) -> str:
    if o.shift is None:
        return ""
    return f" by {float(o.shift.norm()):.4g} and turned by {o.turn_deg:.0f} degrees"


def _unexplained(scene: Told, settled: Settled) -> list[Mask]:
    """Per photo, the changed pixels that nothing accounts for; nothing at all if they are few, beside the others or
    beside what the field gets wrong in photos that show no change."""
    out = []
    for c, p in zip(scene.changed, settled.views):
        told = pixels.dilate(p.covered, 3) | p.explained | ~p.known
        for old in settled.gone:
            told |= pixels.dilate(past.silhouette(c.view, old), 3)
        for body in settled.arrived:
            told |= pixels.dilate(shadow_of(c.view, body), 3)
        left = c.certain & ~told
        left = pixels.dilate(pixels.erode(left, 1), 1) & left
        out.append(pixels.keep_components(left, max(12, _NOTABLE * left.size)))
    unclear, changed = (sum(int(m.sum()) for m in masks) for masks in (out, [c.certain for c in scene.changed]))
    unusual = scene.errors.unusual([float(m.mean()) for m in out])
    return out if unclear > _MUCH * changed and unusual else []


def _said_of(scene: Told, left: Sequence[Mask]) -> str:
    share = sum(int(m.sum()) for m in left) / max(sum(int(c.certain.sum()) for c in scene.changed), 1)
    points = np.concatenate([c.view.surface[m & np.isfinite(c.view.depth)] for c, m in zip(scene.changed, left)])
    where = ""
    if len(points):
        low, high = (", ".join(f"{v:.3g}" for v in np.quantile(points, q, axis=0)) for q in (0.05, 0.95))
        where = f" before what lies between ({low}) and ({high})"
    return (
        f"{100 * share:.0f} % of the changed pixels{where} are not understood: something that bends, flows or shines,"
        " or light that changed"
    )


def _newcomer(body: Body) -> OccupancyGrid:
    solid = ndimage.binary_fill_holes(body.voxels).astype(np.float32)
    return body.lattice.grid(ndimage.gaussian_filter(solid, 0.7))


def _pixel_masks(
    field: Field, changed: Sequence[Changed], settled: Settled
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Per new photo at its full size: what shows that arrived or moved, and where something used to be."""
    ins, outs = [], []
    for c in changed:
        new = np.zeros(c.view.shape, bool)
        for body in settled.arrived:
            new |= shadow_of(c.view, body)
        ins.append(full_size(c.mask & new, c.view.frame))
        outs.append(torch.zeros_like(ins[-1]))
    for k in (*settled.moved, *settled.removed):
        places = [(outs, torch.eye(4, dtype=torch.float64))]
        places += [(ins, settled.moved[k].new_from_old)] if k in settled.moved else []
        for masks, new_from_old in places:
            for i, shown in _shown_in(Sight(field, settled.olds[k], settled.views, settled.gone), new_from_old).items():
                masks[i] = masks[i] | shown
    return tuple(ins), tuple(outs)


def _shown_in(sight: Sight, new_from_old: Tensor) -> dict[int, Tensor]:
    """The moved object's outline in each photo that shows it, by the photo's index, (H, W) bool."""
    ready = layers_at(sight, new_from_old, _MASK_RAYS)
    out = {}
    for crop, opacity in zip(ready.crops, ready.cover(new_from_old)):
        x0, y0, x1, y1 = crop.box
        full: Array = np.zeros((crop.camera.height, crop.camera.width), np.float32)
        full[y0:y1, x0:x1] = opacity.reshape(crop.shape).numpy()
        camera = sight.past[crop.photo_index].view.frame.camera
        if (camera.width, camera.height) != (crop.camera.width, crop.camera.height):
            full = cv2.resize(full, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        out[crop.photo_index] = torch.from_numpy(full > 0.5)
    return out
