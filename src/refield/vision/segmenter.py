"""The Segmenter seam: which pixels in a box are the object. Default side: GrabCut, no weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from refield.vision import pixels

Boxes = NDArray[np.float64]


class Segmenter(Protocol):
    """Image features and masks from box prompts (§3.2)."""

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

    def features(self, image: NDArray[np.uint8]) -> NDArray[Any]:
        """See `Segmenter.features`: Lab colour at two blurs and the strength of edges, C = 7."""
        lab = pixels.to_lab(image.astype(np.float32) / 255)
        h, w = max(1, image.shape[0] // self.stride), max(1, image.shape[1] // self.stride)
        grey = pixels.blur(lab[..., :1].repeat(3, -1), 1.0)[..., 0]
        edges = np.hypot(*np.gradient(grey))[..., None].astype(np.float32)
        full = np.concatenate([lab, pixels.blur(lab, 2.0 * self.stride), edges], -1)
        return cv2.resize(full, (w, h), interpolation=cv2.INTER_AREA)

    def masks(
        self, image: NDArray[np.uint8], boxes: Boxes, hint: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """See `Segmenter.masks`. The score is the part of the outline that lies on a colour edge."""
        boxes = np.asarray(boxes, np.float64).reshape(-1, 4)
        found = [self._mask(image, b, None if hint is None else hint[k]) for k, b in enumerate(boxes)]
        empty = np.zeros((0, *image.shape[:2]), bool)
        return (np.stack(found) if found else empty), np.array([_outline_score(image, m) for m in found])

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
