"""What was settled, as plain data: the objects' grids, poses and masks, and why it was concluded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from refield.estimate import past, segment
from refield.estimate.associate import Settled, shadow_of
from refield.estimate.detect import Changed, Mask
from refield.estimate.hull import Hull
from refield.estimate.lattice import Lattice, Voxels
from refield.estimate.objects import Old
from refield.estimate.pose_change import PoseChange
from refield.scene.capture import Frame
from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, SceneChange
from refield.scene.pose import adjoint, angle_between, rigid, transform
from refield.vision import pixels


def concluded(
    frames: Sequence[Frame],
    changed: Sequence[Changed],
    photos: tuple[PlacedPhoto, ...],
    settled: Settled,
    carved: Hull,
) -> SceneChange:
    """``frames`` are the old training photos; ``changed`` and ``settled.views`` go with the used new photos."""
    olds = settled.olds
    changes, reasons = [], []
    for k, change in settled.moved.items():
        changes.append(_moved(frames, olds[k], change))
        reasons.append(_why_moved(olds[k], change))
    for k, share in settled.removed.items():
        masks = segment.masks_out(frames, olds[k])
        changes.append(ObjectChange("removed", olds[k].grid, masks=masks, confidence=share))
        reasons.append(f"1 removed: {100 * share:.0f} % of its pixels show what is behind it")
    for part in settled.arrived:
        grid = _newcomer(carved.lattice, part)
        changes.append(ObjectChange("added", grid, masks_in=segment.masks_in(frames, grid)))
        reasons.append("1 added: it hides what was there, and nothing that left looks like it")
    if not changes:
        why = "some pixels differ, but no object that moved, left or arrived explains them better than the old field"
        return SceneChange((), photos, why)
    return SceneChange(tuple(changes), photos, "; ".join(reasons), *_pixel_masks(changed, settled, carved.lattice))


def _moved(frames: Sequence[Frame], old: Old, change: PoseChange) -> ObjectChange:
    centre = transform(change.new_from_old, torch.from_numpy(old.centre).double())
    about = adjoint(rigid(torch.eye(3, dtype=torch.float64), centre))
    return ObjectChange(
        "moved",
        old.grid,
        change.new_from_old,
        segment.masks_out(frames, old),
        segment.masks_in(frames, old.grid.moved(change.new_from_old)),
        confidence=change.explained,
        covariance=about @ change.covariance @ about.T,
        note=change.note,
    )


def _why_moved(old: Old, change: PoseChange) -> str:
    centre = torch.from_numpy(old.centre).double()
    shift = float((transform(change.new_from_old, centre) - centre).norm())
    turn = float(angle_between(change.new_from_old, torch.eye(4, dtype=torch.float64)))
    return (
        f"1 moved by {shift:.3g} and turned by {turn:.0f} degrees: {100 * change.explained:.0f} % of its pixels show it"
        f" at its new place, {100 * change.before:.0f} % what was there before"
    )


def _newcomer(lattice: Lattice, part: Voxels) -> OccupancyGrid:
    return lattice.grid(ndimage.gaussian_filter(ndimage.binary_fill_holes(part).astype(np.float32), 0.7))


def _pixel_masks(
    changed: Sequence[Changed], settled: Settled, lattice: Lattice
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Per new photo at its full size: changed pixels that show what is there now, and where something used to be."""
    ins, outs = [], []
    for c, seen in zip(changed, settled.views):
        came = seen.covered.copy()
        for part in settled.arrived:
            came |= shadow_of(c.view, lattice, part)
        gone = np.zeros(c.view.shape, bool)
        for k in (*settled.moved, *settled.removed):
            gone |= past.silhouette(c.view, settled.olds[k])
        ins.append(_full_size(c.mask & came, c))
        outs.append(_full_size(pixels.dilate(gone, 1), c))
    return tuple(ins), tuple(outs)


def _full_size(mask: Mask, c: Changed) -> Tensor:
    size = np.array([c.view.frame.camera.height, c.view.frame.camera.width])
    return torch.from_numpy(ndimage.zoom(mask.astype(np.uint8), size / c.view.shape, order=0) > 0)
