"""Looking past an object that may be gone: what the old field shows behind it, and whether the photo agrees.

This is what tells "something left" from "something came and hides what was there": behind what left, the photo shows
what other old views know to be there. It also clears the change masks of what is explained, so that the hull of the
newcomers is carved by newcomers only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from refield.estimate.detect import Changed, DetectConfig, Mask, blur_sigma, difference
from refield.estimate.hull import HullConfig, tolerance
from refield.estimate.lattice import Body, grown
from refield.estimate.look import Array, Hidden, View, see
from refield.estimate.memory import Memory
from refield.estimate.objects import Old
from refield.field.radiance import Field
from refield.vision import pixels

FEWEST_ASKED = 12
"""pixels from which a part of them says whether an object is gone"""


@dataclass(frozen=True)
class Past:
    """A new view of the old field with some objects taken out."""

    changed: Changed
    rgb: Array
    """(H, W, 3) the field's colours without the objects"""
    depth: Array
    """(H, W) median depth without the objects; inf where nothing is left"""
    was: Mask
    """pixels at which an object was taken out"""
    known: Mask
    """pixels at which what is behind was seen by some old photo (everywhere outside ``was``)"""
    difference: Array
    """(H, W) Lab difference of the photo and ``rgb``"""
    covered: Mask
    """pixels at which an object that was placed stands in front"""
    beyond: Array
    """as ``depth``, without the objects that were placed since"""
    telling: Mask
    """pixels that would show that what was taken out is gone: they look otherwise without it, as far as anyone knows"""
    sigma: float
    """pixels by which the photo is blurred where its colours are compared"""

    @property
    def view(self) -> View:
        return self.changed.view

    @cached_property
    def asked(self) -> Mask:
        """Pixels that speak of bodies: not of what no old photo saw, nor of light alone on what stayed."""
        return ~self.changed.new & ~(self.changed.light & ~self.was)

    @cached_property
    def lab(self) -> Array:
        """(H, W, 3) the photo's colours as they are compared."""
        return pixels.to_lab(pixels.blur(self.view.photo, self.sigma))

    @cached_property
    def around(self) -> Array:
        """(H, W) where nobody knows what is behind: Lab difference of the photo and whichever of the unchanged pixels
        around is most alike; inf elsewhere."""
        unchanged = ~(self.was | self.covered | self.changed.mask | self.changed.new)
        return _around(self.lab, self.was & ~self.known, unchanged)

    @cached_property
    def explained(self) -> Mask:
        """Changed pixels that show what was behind."""
        alike = (self.difference < self.changed.threshold).astype(np.uint8)
        return self.changed.mask & self.known & cv2.medianBlur(alike, 5).astype(bool)

    @cached_property
    def open(self) -> Mask:
        """Changed pixels that something new must explain."""
        left = self.changed.mask & self.known & ~self.explained
        return pixels.dilate(pixels.erode(left, 1), 1) & left  # what is left at outlines is no wider than this


def look_past(
    field: Field,
    changed: Sequence[Changed],
    memory: Memory,
    olds: Sequence[Old],
    configs: tuple[DetectConfig, HullConfig],
) -> list[Past]:
    """Render the new views without ``olds``; only rays that meet one are traced again."""
    return [_look_past(field, c, memory, olds, configs) for c in changed]


def _look_past(
    field: Field,
    c: Changed,
    memory: Memory,
    olds: Sequence[Old],
    configs: tuple[DetectConfig, HullConfig],
) -> Past:
    (config, carving), view = configs, c.view
    was = np.zeros(view.shape, bool)
    for old in olds:
        was |= pixels.dilate(silhouette(view, old), 2)
    rgb, depth = view.rgb.copy(), view.depth.copy()
    index = np.flatnonzero(was.ravel())
    if len(index):
        seen = see(field, view.rays[torch.from_numpy(index)], Hidden(tuple(old.haze for old in olds)))
        rgb.reshape(-1, 3)[index] = seen.rgb.clamp(0, 1).numpy()
        depth.reshape(-1)[index] = seen.depth.numpy()
    hit = np.abs(np.where(np.isfinite(depth), depth, 0) - np.where(np.isfinite(view.depth), view.depth, 0))
    gone = was & (hit > tolerance(view, np.where(np.isfinite(view.depth), view.depth, 0), carving))
    gone = pixels.close(gone, 3)
    guess = was & ((memory.times_seen(view, depth, was) == 0) | _beneath(view, depth, olds, was))
    known = ~pixels.dilate(pixels.close(guess, 3), 1)
    telling = ~known | (difference(replace(view, photo=view.rgb), rgb, config) > c.threshold)
    diff = difference(view, rgb, config)
    sigma = blur_sigma(view, config)
    return Past(c, rgb, depth, gone, known, diff, np.zeros(view.shape, bool), depth, telling, sigma)


def _around(lab: Array, unknown: Mask, unchanged: Mask) -> Array:
    """(H, W) how far colours (H, W, 3) are from those of the unchanged pixels that are nearest to what is unknown, as
    many as that has, by the one most alike; inf where it is known.

    What a thing stood on goes on around it: nobody saw it there, and yet a photo may look like it.
    """
    out = np.full(unknown.shape, np.inf, np.float32)
    if not unknown.any() or not unchanged.any():
        return out
    nearest = np.argsort(ndimage.distance_transform_edt(~unknown)[unchanged], kind="stable")[: unknown.sum()]
    out[unknown] = cKDTree(lab[unchanged][nearest]).query(lab[unknown])[0]
    return out


def _beneath(view: View, depth: Array, olds: Sequence[Old], where: Mask) -> Mask:
    """Those of the pixels whose surface at ``depth`` touches one of the objects: nobody ever saw what they stood on."""
    asked = where & np.isfinite(depth)
    points = view.centre + view.directions[asked] * depth[asked][:, None]
    out = np.zeros(view.shape, bool)
    for old in olds:
        out[asked] |= old.lattice.holds(grown(old.voxels, 4), points)
    return out


def silhouette(view: View, old: Old | Body) -> Mask:
    """Pixels that show the object where the old field has it in front."""
    near = old.lattice.grid(old.voxels.astype(np.float32))
    points = torch.from_numpy(np.nan_to_num(view.surface, posinf=1e9, neginf=-1e9))
    step = torch.from_numpy(view.directions) * old.lattice.cell
    on = near.contains(points) | near.contains(points + step) | near.contains(points + 2 * step)
    return pixels.close(on.numpy(), 3)


def background_seen(past: Sequence[Past], old: Old) -> bool:
    """Whether old photos saw enough of what is behind an object for `gone_score` to go by that."""
    return _asked(past, old)[1]


def _asked(past: Sequence[Past], old: Old) -> tuple[list[Mask], bool]:
    """The pixels (H, W) of each photo that are asked whether an object is gone; whether their background was seen."""
    shown = [silhouette(p.view, old) & p.was & p.telling & ~p.covered for p in past]
    known = [s & p.known for s, p in zip(shown, past)]
    seen = sum(int(k.sum()) for k in known) >= FEWEST_ASKED
    return known if seen else [s & ~k for s, k in zip(shown, known)], seen


def gone_score(past: Sequence[Past], old: Old) -> tuple[float, int]:
    """How much better the photos agree with what is behind than with the object: (part of the pixels asked, pixels).

    Only pixels are asked that show the object in the old field, whose background is known and looks otherwise, and
    before which no object that was placed stands. Where there are next to none, as of what lies flat, those are asked
    whose background nobody knows: whether they look like what is around.
    """
    here, seen = _asked(past, old)
    if seen:
        alike = [p.difference < 0.7 * p.changed.difference for p in past]
    else:
        alike = [p.around < p.changed.threshold for p in past]
    asked = sum(int(h.sum()) for h in here)
    better = sum(int((h & a & p.changed.mask).sum()) for h, a, p in zip(here, alike, past))
    return (better / asked if asked else 0.0), asked


def changed_share(past: Sequence[Past], old: Old) -> float:
    """Part of the pixels that show the object in the old field, and would show that it is gone, which changed, over all
    new views; 0 if too few do.

    Args:
        past: the photos past this object alone.
    """
    shown, touched = 0, 0
    for p in past:
        here = silhouette(p.view, old) & p.telling
        shown += int(here.sum())
        touched += int((here & p.changed.certain).sum())
    return touched / shown if touched >= FEWEST_ASKED else 0.0
