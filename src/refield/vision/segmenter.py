"""The Segmenter seam: which pixels in a box are the object. Default side: GrabCut, no weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from refield.vision import pixels

Boxes = NDArray[np.float64]
_BINS = ((0.0, 100.0, 25.0, 0.5), (-60.0, 60.0, 15.0, 1.0), (-60.0, 60.0, 15.0, 1.0))
"""of L, a and b: the first bin's middle, the last one's, their distance, and the weight; shadow changes L most"""


class Segmenter(Protocol):
    """Image features and masks from box prompts (§3.2)."""

    @property
    def sure(self) -> float:
        """The score from which on a mask is believed; SAM's is 0.95 (§10.1.3)."""
        ...

    def features(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(H, W, 3) uint8 RGB -> (h, w, C)."""
        ...

    def masks(
        self, image: NDArray[np.uint8], boxes: Boxes, hint: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Boxes (B, 4) px xyxy -> (B, H, W) bool and (B,) score in [0, 1]; nothing outside ``hint`` (B, H, W) is in."""
        ...


def cut_out(segmenter: Segmenter, image: pixels.Image, hints: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What a segmenter finds of an image (H, W, 3) in [0, 1] in the boxes around hints (B, H, W), together, (H, W)."""
    boxes = np.array([pixels.bounding_box(h) for h in hints], np.float64)
    masks, _ = segmenter.masks(pixels.to_bytes(image), boxes, hints)
    return np.logical_or.reduce(masks)


@dataclass(frozen=True)
class GrabCutSegmenter:
    """Colour models inside and outside a box, cut along edges (Rother et al. 2004)."""

    rounds: int = 4
    """of colour model and cut"""
    around: float = 0.12
    """of the image's longer side; what is this near to the box shows the background's colours"""
    stride: int = 4
    """pixels a feature cell is wide"""
    sure: float = 0.6
    """see `Segmenter`; masks of which nine tenths are right score from 0.64 to 0.95"""

    def features(self, image: NDArray[np.uint8]) -> NDArray[Any]:
        """See `Segmenter.features`: soft histograms of L, a and b in each cell, C = 23.

        Their square roots, so that the cosine similarity of two cells is how far their histograms overlap
        (Bhattacharyya's coefficient). Unlike that of mean colours it is nothing as soon as colours differ, however much
        they do, and the histogram of a whole object tells what colours it has.
        """
        lab = pixels.to_lab(image.astype(np.float32) / 255)
        size = max(1, image.shape[1] // self.stride), max(1, image.shape[0] // self.stride)
        parts = []
        for channel, (low, high, width, weight) in zip(np.moveaxis(lab, -1, 0), _BINS):
            middles = np.arange(low, high + width / 2, width, dtype=np.float32)
            near = 1 - np.abs(np.clip(channel, low, high)[..., None] - middles) / np.float32(width)
            cells = cv2.resize(np.maximum(near, 0), size, interpolation=cv2.INTER_AREA)
            parts.append(np.sqrt(np.float32(weight) * cells))
        return np.concatenate(parts, -1)

    def masks(
        self, image: NDArray[np.uint8], boxes: Boxes, hint: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """See `Segmenter.masks`. The score is the part of the outline that lies on a colour edge, times how well the
        mask fills the box that was asked about (IoU of the boxes)."""
        boxes = np.asarray(boxes, np.float64).reshape(-1, 4)
        found = [self._mask(image, b, None if hint is None else hint[k]) for k, b in enumerate(boxes)]
        empty = np.zeros((0, *image.shape[:2]), bool)
        scores = [_outline_score(image, m) * _filled(m, b) for m, b in zip(found, boxes)]
        return (np.stack(found) if found else empty), np.array(scores)

    def _mask(
        self, image: NDArray[np.uint8], box: NDArray[np.float64], hint: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_]:
        h, w = image.shape[:2]
        x0, y0 = np.clip(np.floor(box[:2]).astype(int), 0, [w, h])
        x1, y1 = np.clip(np.ceil(box[2:]).astype(int), 0, [w, h])
        maybe = np.zeros((h, w), bool)
        maybe[y0:y1, x0:x1] = True if hint is None else hint[y0:y1, x0:x1]
        reach = round(self.around * max(h, w))
        x0, y0, x1, y1 = max(x0 - reach, 0), max(y0 - reach, 0), min(x1 + reach, w), min(y1 + reach, h)
        labels = np.where(maybe[y0:y1, x0:x1], cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
        if maybe.sum() < 8 or (labels == cv2.GC_PR_FGD).all():
            return maybe
        background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
        bgr = np.ascontiguousarray(image[y0:y1, x0:x1, ::-1])
        cv2.setRNGSeed(0)
        cv2.grabCut(bgr, labels, (0, 0, 1, 1), background, foreground, self.rounds, cv2.GC_INIT_WITH_MASK)
        maybe[y0:y1, x0:x1] &= labels == cv2.GC_PR_FGD
        return maybe


def _filled(mask: NDArray[np.bool_], box: NDArray[np.float64]) -> float:
    """IoU of the box around a mask and another one."""
    own = pixels.bounding_box(mask)
    if own is None:
        return 0.0
    a = np.array(own, np.float64)
    both = np.clip(np.minimum(a[2:], box[2:]) - np.maximum(a[:2], box[:2]), 0, None).prod()
    return float(both / ((a[2:] - a[:2]).prod() + (box[2:] - box[:2]).prod() - both))


def _outline_score(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> float:
    if not mask.any() or mask.all():
        return 0.0
    lab = pixels.to_lab(image.astype(np.float32) / 255)
    inner, outer = mask & ~pixels.erode(mask, 1), pixels.dilate(mask, 1) & ~mask
    reach = cv2.blur(np.where(outer[..., None], lab, 0), (5, 5)) / np.maximum(
        cv2.blur(outer.astype(np.float32), (5, 5))[..., None], 1e-6
    )
    step = np.linalg.norm(lab - reach, axis=-1)[inner]
    return float((step > 8.0).mean()) if len(step) else 0.0
