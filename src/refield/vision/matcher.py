"""The Matcher seam: which points of two images show the same thing. Default side: SIFT, no weights.

Pixels follow the project's convention: the top-left pixel's centre is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

_KEPT_BELOW = 1_000_000  # bytes
Matches = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


class Matcher(Protocol):
    """Finds corresponding points."""

    def match(self, image_a: NDArray[np.uint8], image_b: NDArray[np.uint8]) -> Matches:
        """(H, W, 3) uint8 RGB each -> (K, 2) px, (K, 2) px, (K,) score in [0, 1]."""
        ...


@dataclass(frozen=True)
class SiftMatcher:
    """SIFT with Lowe's ratio test and mutual nearest neighbours."""

    ratio: float = 0.85
    """a match is kept if it is this much nearer than the second nearest"""
    enlarge: float = 2.0
    """small images are enlarged by this before detection: objects are often a few dozen pixels wide"""
    enlarge_below: int = 400_000
    """pixels; larger images are taken as they are"""
    contrast: float = 0.02
    """SIFT's contrast threshold"""

    def features(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """(H, W, 3) uint8 -> keypoints (K, 2) px and their root-SIFT descriptors (K, 128); small images' are kept."""
        if image.size > _KEPT_BELOW:
            return self._features(image)
        return _known_features(self, image.tobytes(), image.shape)

    def _features(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        scale = self.enlarge if image.shape[0] * image.shape[1] < self.enlarge_below else 1.0
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if scale != 1.0:
            grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        points, descriptors = cv2.SIFT.create(contrastThreshold=self.contrast).detectAndCompute(grey, None)
        if not points:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        xy = (np.array([p.pt for p in points], np.float64) + 0.5) / scale
        root = np.sqrt(descriptors / (descriptors.sum(1, keepdims=True) + 1e-7))
        return xy, root.astype(np.float32)

    def match(self, image_a: NDArray[np.uint8], image_b: NDArray[np.uint8]) -> Matches:
        """See `Matcher.match`."""
        a, b = self.features(image_a), self.features(image_b)
        if min(len(a[0]), len(b[0])) < 2:
            return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
        similar = a[1] @ b[1].T
        distance = np.sqrt(np.maximum(2 - 2 * similar, 0))
        nearest = distance.argmin(1)
        rows = np.arange(len(a[0]))
        best = distance[rows, nearest]
        second = np.partition(distance, 1, axis=1)[:, 1]
        mutual = distance.argmin(0)[nearest] == rows
        keep = mutual & (best < self.ratio * second)
        score = 1 - best[keep] / np.maximum(second[keep], 1e-9)
        return a[0][keep], b[0][nearest[keep]], score


@lru_cache(maxsize=128)  # an object's pictures are each matched with several others
def _known_features(
    matcher: SiftMatcher, image: bytes, shape: tuple[int, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    return matcher._features(np.frombuffer(image, np.uint8).reshape(shape))
