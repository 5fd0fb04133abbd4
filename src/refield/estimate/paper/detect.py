"""Which pixels of the new photos changed, and whether something came there or left (§4.2.2, §10.2.2).

Render and photo of each view are aligned, blurred and compared by a segmenter's features; what differs is boxed, and
the segmenter is asked on both pictures. It is surer of an object than of the ground where one was: so the picture in
which it is surer tells move-in from move-out. Masks are of the photo's pixels. Letters: H, W a picture; h, w, C its
features.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from refield.estimate.detect import Mask
from refield.estimate.look import Array, View
from refield.estimate.paper.align import AlignConfig, Picture, Warp, found_warp, unwarped, warped
from refield.vision import pixels
from refield.vision.segmenter import Segmenter

Box = NDArray[np.float64]
"""(4,) x0, y0, x1, y1 in pixels"""


@dataclass(frozen=True)
class DetectConfig:
    """How photos are compared with the old field."""  # §10.2.2

    align: AlignConfig = field(default_factory=AlignConfig)
    """of renders to photos"""
    blur: float = 0.03
    """of the width: the Gaussian's kernel"""
    smallest: float = 0.01
    """of the picture's pixels: the area from which on a contour counts"""
    box: float = 1.05
    """size of the box that is asked about, against the contour's own"""
    floor: float = 1.5
    """a change differs by more than this many times the level at which no old photo would show one"""
    merged: float = 1.5
    """a contour this many times as large as the view's others may be two that overlap"""  # Fig. 13
    own: float = 0.1
    """part of a contour that each picture's mask must hold for itself, if the two are of different places"""


@dataclass(frozen=True)
class Pair:
    """A photo and the rendering of the old field from the same place."""

    view: View
    capture: Picture
    """(H, W, 3)"""
    render: Picture
    """(H, W, 3) in the photo's pixels"""
    capture_features: Array
    """(h, w, C) of the blurred photo"""
    render_features: Array
    """(h, w, C) of the blurred rendering"""
    warp: Warp | None
    """(3, 3) the rendering's pixels to the photo's; None where they are the same"""

    @cached_property
    def unlike(self) -> Array:
        """(H, W) 1 - cosine similarity of the features, in [0, 2]."""
        a, b = self.capture_features, self.render_features
        norms = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
        cosine = np.where(norms > 0, (a * b).sum(-1) / np.maximum(norms, 1e-12), 1.0)
        h, w = self.view.shape
        return cv2.resize((1 - cosine).astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)

    def on_render(self, mask: Mask) -> Mask:
        """A mask (H, W) of the photo's pixels as it lies over the rendered depth, `View.surface`."""
        return unwarped(mask, self.warp)


@dataclass(frozen=True)
class Contour:
    """The outline of pixels that differ."""

    box: Box
    """+5 %"""
    area: float
    """pixels"""
    inside: Mask
    """(H, W) bool: it and what it encloses"""


@dataclass(frozen=True)
class ViewMasks:
    """What changed in one view."""

    pair: Pair
    move_in: tuple[Mask, ...] = ()
    """(H, W) bool each: an object that is there now"""
    move_out: tuple[Mask, ...] = ()
    """(H, W) bool each: an object that was there"""
    scores_in: tuple[float, ...] = ()
    """the segmenter's, of each ``move_in``"""
    scores_out: tuple[float, ...] = ()
    """and of each ``move_out``"""
    overlap: bool = False
    """whether one contour held the masks of two (Fig. 13)"""


def detect(
    views: Sequence[View], survey: Sequence[View], segmenter: Segmenter, config: DetectConfig
) -> tuple[ViewMasks, ...]:
    """Move-in and move-out masks of every new view; ``survey`` are old views."""
    level = floor_of([paired(v, segmenter, config).unlike for v in survey], config)
    pairs = [paired(v, segmenter, config) for v in views]
    found = [contours(p.unlike, level, config) for p in pairs]
    merged = overlapping(found, config.merged)
    return tuple(_told_apart(p, c, m, segmenter, config.own) for p, c, m in zip(pairs, found, merged))


def paired(view: View, segmenter: Segmenter, config: DetectConfig) -> Pair:
    """Align a view's two pictures and ask for their features."""
    capture, render = pixels.to_bytes(view.photo), pixels.to_bytes(view.rgb)
    warp = found_warp(render, capture, config.align)
    render = warped(render, warp)
    seen, shown = (segmenter.features(blurred(p, config.blur)) for p in (capture, render))
    return Pair(view, capture, render, seen, shown, warp)


def blurred(picture: Picture, share: float) -> Picture:
    """Gaussian with a kernel of ⌈share · W⌉ pixels, made odd; OpenCV's rule gives its sigma."""
    kernel = math.ceil(share * picture.shape[1]) | 1
    return np.asarray(cv2.GaussianBlur(picture, (kernel, kernel), 0), np.uint8)


def floor_of(unlike: Sequence[Array], config: DetectConfig) -> float:
    """The dissimilarity (H, W of old photos) that a change must exceed, whatever Otsu's method says.

    Otsu's method splits any histogram, also that of a scene in which nothing changed. At the level that all but 1 % of
    an old photo's pixels stay below, no contour is left in it that would count; the highest over the old photos, and a
    margin since a field shows the photos it learnt from best, is what the field's own errors come to.
    """
    return config.floor * max((float(np.quantile(u, 1 - config.smallest)) for u in unlike), default=0.0)


def contours(unlike: Array, level: float, config: DetectConfig) -> tuple[Contour, ...]:
    """Outlines of what differs in a view (H, W), the largest first (§10.2.2 steps 5 and 6)."""
    top = float(unlike.max())
    if top <= max(level, 1e-6):
        return ()
    mask = unlike > max(level, pixels.otsu(unlike, top))
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [c for c in outlines if cv2.contourArea(c) >= config.smallest * mask.size]
    large.sort(key=lambda c: -cv2.contourArea(c))
    return tuple(_contour(np.asarray(c), (mask.shape[0], mask.shape[1]), config.box) for c in large)


def _contour(outline: NDArray[np.int32], shape: tuple[int, int], factor: float) -> Contour:
    x, y, w, h = cv2.boundingRect(outline)
    inside = np.asarray(cv2.drawContours(np.zeros(shape, np.uint8), [outline], -1, 1, cv2.FILLED), np.uint8) > 0
    return Contour(enlarged((x, y, x + w, y + h), shape, factor), float(cv2.contourArea(outline)), inside)


def enlarged(box: Sequence[float] | Box, shape: tuple[int, int], factor: float) -> Box:
    """A box ``factor`` times as wide and high about its middle, cut to the picture (H, W)."""
    low, high = np.asarray(box[:2], np.float64), np.asarray(box[2:], np.float64)
    middle, half = (low + high) / 2, (high - low) / 2 * factor
    size = np.array(shape[::-1])
    return np.concatenate([np.clip(middle - half, 0, size), np.clip(middle + half, 0, size)])


def overlapping(found: Sequence[Sequence[Contour]], factor: float) -> list[frozenset[int]]:
    """Which contours of each view hold a move-in and a move-out mask at once (Fig. 13).

    The usual number of contours is the mode over the views that show any; of equally frequent numbers the larger, as an
    overlap hides contours and nothing adds them. A view that lacks n of them has merged its n largest (with one object:
    the only one). Where there are others to compare with, a merged one must also be ``factor`` times their median
    area, for a view may also lack a contour because something hides it.
    """
    counts = Counter(len(f) for f in found if f)
    usual = max(counts, key=lambda n: (counts[n], n), default=0)
    out = []
    for view in found:
        areas = [c.area for c in view]  # the largest first
        lacking = min(max(usual - len(view), 0), len(view))
        rest = float(np.median(areas[lacking:])) if areas[lacking:] else 0.0
        out.append(frozenset(i for i in range(lacking) if areas[i] >= factor * rest))
    return out


def holds_two(inside: Mask, came: Mask, left: Mask, own: float) -> bool:
    """Whether a contour's pixels (H, W) are those of two masks, each with a part of them for itself.

    The number of contours says nothing where the places overlap in every view, as those of a thing do that moved by
    less than it is wide. But then the photo's object covers one part of the contour, and the rendering's another.
    """
    least = own * inside.sum()
    return bool((inside & came & ~left).sum() >= least and (inside & left & ~came).sum() >= least)


def _told_apart(
    pair: Pair, found: Sequence[Contour], merged: frozenset[int], segmenter: Segmenter, own: float
) -> ViewMasks:
    """Ask the segmenter on both pictures: the surer one wins, but for merged contours, which keep both masks."""
    if not found:
        return ViewMasks(pair)
    boxes = np.stack([c.box for c in found])
    ins, sure_in = segmenter.masks(pair.capture, boxes)
    outs, sure_out = segmenter.masks(pair.render, boxes)
    both = np.array([i in merged or holds_two(c.inside, ins[i], outs[i], own) for i, c in enumerate(found)])
    came = (both | (sure_in > sure_out)) & ins.any((1, 2))
    left = (both | (sure_in <= sure_out)) & outs.any((1, 2))
    scores_in, scores_out = tuple(map(float, sure_in[came])), tuple(map(float, sure_out[left]))
    return ViewMasks(pair, tuple(ins[came]), tuple(outs[left]), scores_in, scores_out, bool(both.any()))
