"""Features of whole photos that are recognised from well aside: SIFT on affine shapes (Lowe 2004; Mikolajczyk & Schmid
2004), pooled over domain sizes (Dong & Soatto 2015), by pycolmap.

On a world of `refield synth` these give three times the right matches between views 25° apart that plain SIFT gives.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from refield.scene.colmap import quiet_pycolmap
from refield.vision.sift import DIM, Features

LARGEST = 1600
"""pixels of the longer side; larger photos are scaled down"""
_SMALL, _LARGE = 300_000, 1_000_000  # pixels: below, photos are doubled first; above, domain sizes are not pooled


def photo_features(image: NDArray[np.uint8], most: int = 3000) -> Features:
    """At most ``most`` features of an image, (H, W, 3) uint8 RGB. About 0.7 s for half a megapixel."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = LARGEST / max(grey.shape)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, found = _extractor(grey.size < _SMALL, grey.size < _LARGE, most).extract_from_uint8_array(grey)
    if len(points) == 0:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, DIM), np.uint8))
    shrunk = np.array([image.shape[1] / grey.shape[1], image.shape[0] / grey.shape[0]])
    xy = np.array([(p.x, p.y) for p in points], np.float64) * shrunk
    return Features(xy.astype(np.float32), np.array(found.data, np.uint8).reshape(-1, DIM))


@lru_cache(maxsize=8)
def _extractor(doubled: bool, pooled: bool, most: int) -> Any:
    pycolmap = quiet_pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    options.sift.max_num_features = most
    options.sift.first_octave = -1 if doubled else 0
    options.sift.estimate_affine_shape = True
    options.sift.domain_size_pooling = pooled
    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
