"""Small operations on images and masks: blur, colour difference, thresholds, morphology, boxes.

Images are (H, W, 3) float32 RGB in [0, 1], masks (H, W) bool, numpy throughout.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from refield.vision.pixel_kernels import find_nearest

Image = NDArray[Any]
Mask = NDArray[Any]

_NEIGHBOURS = np.ones((3, 3), np.uint8)


def blur(image: Image, sigma: float) -> Image:
    """Gaussian blur; ``sigma`` in pixels, 0 leaves the image as it is."""
    if sigma <= 0:
        return image
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)


def to_bytes(image: Image) -> NDArray[np.uint8]:
    """[0, 1] -> 0-255, what segmenters and matchers take."""
    return (np.clip(image, 0, 1) * 255).astype(np.uint8)


def to_lab(image: Image) -> Image:
    """sRGB -> CIE Lab, L in 0-100: a difference of 1 is just visible."""
    return cv2.cvtColor(np.clip(image, 0, 1).astype(np.float32), cv2.COLOR_RGB2LAB)


def colour_difference(a: Image, b: Image, reach: int = 1) -> Image:
    """Lab distance (H, W) between two images, forgiving shifts of up to ``reach`` pixels either way.

    Each pixel of one image is compared with the most similar one near it in the other, both ways round; the
    larger of the two counts, so that a thing present in only one of the images is seen whichever it is.
    """
    lab_a, lab_b = to_lab(a), to_lab(b)
    return np.maximum(_nearest_distance(lab_a, lab_b, reach), _nearest_distance(lab_b, lab_a, reach))


def nearest_distance(colours: Image, image: Image, rows: Image, columns: Image, reach: int = 1) -> Image:
    """Distance of each colour (K, 3) to the most similar one of an image's within ``reach`` pixels of a place, (K,);
    rows, columns: (K,) int64. An image goes on beyond its border as it is there."""
    out = np.empty(len(colours), np.float32)
    find_nearest(np.ascontiguousarray(colours), np.ascontiguousarray(image), rows, columns, reach, out)
    return out


def _nearest_distance(a: Image, b: Image, reach: int) -> Image:
    rows, columns = np.indices(a.shape[:2]).reshape(2, -1)
    return nearest_distance(a.reshape(-1, 3), b, rows, columns, reach).reshape(a.shape[:2])


def median(images: Image) -> Image:
    """Over the first axis, that of what is not nan; nan where nothing is."""
    ordered, count = np.sort(images, 0), np.isfinite(images).sum(0)  # nan last
    low, high = (np.take_along_axis(ordered, k[None], 0)[0] for k in (np.maximum(count - 1, 0) // 2, count // 2))
    return np.where(count > 0, (low + high) / 2, np.nan).astype(np.float32)


def otsu(values: Image, top: float) -> float:
    """Otsu's threshold of values in [0, top]; larger ones count as ``top``."""
    grey = np.clip(values.reshape(1, -1) * (255 / top), 0, 255).astype(np.uint8)
    level, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    return (float(level) + 1) * top / 255  # the upper edge of the last grey level below


def dilate(mask: Mask, pixels: int = 1) -> Mask:
    """Grow by ``pixels`` (3 x 3 square, repeated)."""
    return cv2.dilate(mask.astype(np.uint8), _NEIGHBOURS, iterations=pixels).astype(bool) if pixels else mask


def erode(mask: Mask, pixels: int = 1) -> Mask:
    """Shrink by ``pixels`` (3 x 3 square, repeated); beyond the border counts as inside."""
    return cv2.erode(mask.astype(np.uint8), _NEIGHBOURS, iterations=pixels).astype(bool) if pixels else mask


def close(mask: Mask, size: int = 5) -> Mask:
    """Morphological closing with a ``size`` x ``size`` kernel, one iteration (§10.2.4)."""
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8)).astype(bool)


def enlarged(mask: Mask, shape: tuple[int, int]) -> Mask:
    """A mask that may be of a smaller picture, for one of ``shape`` (H, W)."""
    if mask.shape == shape:
        return mask
    return cv2.resize(mask * np.uint8(255), shape[::-1], interpolation=cv2.INTER_LINEAR) > 100


def fill_holes(mask: Mask, largest: float) -> Mask:
    """Fill enclosed holes of at most ``largest`` pixels."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= largest
    small[0] = False
    h, w = mask.shape
    x0, y0 = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    at_border = (x0 == 0) | (y0 == 0) | (x0 + stats[:, 2] == w) | (y0 + stats[:, 3] == h)
    return mask | (small & ~at_border)[labels] if count > 1 else mask


def keep_components(mask: Mask, smallest: float, seeds: Mask | None = None) -> Mask:
    """Components (8-connected) of at least ``smallest`` pixels that hold a seed, if seeds are given."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= smallest
    keep[0] = False
    if seeds is not None:
        keep &= np.bincount(labels[seeds & mask], minlength=count) > 0
    return keep[labels]


def bounding_box(mask: Mask, margin: int = 0) -> tuple[int, int, int, int] | None:
    """(x0, y0, x1, y1), end exclusive, clipped to the image; None for an empty mask."""
    ys, xs = np.nonzero(mask)
    if len(xs) == 0:
        return None
    h, w = mask.shape
    return (
        max(int(xs.min()) - margin, 0),
        max(int(ys.min()) - margin, 0),
        min(int(xs.max()) + 1 + margin, w),
        min(int(ys.max()) + 1 + margin, h),
    )


def _likeliest_gain(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The gain per channel, (3,), about which most colours (N, 3) are carried to others, within half and double."""
    ratio = np.log(y / x)
    grey = ratio.mean(-1)
    most, near = np.log(2.0), 0.1
    counted, edges = np.histogram(grey, 70, (-most, most))
    if not counted.any():
        return np.ones(3)
    width = near / 2 / (edges[1] - edges[0])  # ground whose texture is not learnt is that wide, one even thing is not
    k = int(gaussian_filter1d(counted.astype(np.float64), width, mode="constant").argmax())
    alike = np.abs(grey - (edges[k] + edges[k + 1]) / 2) < near
    return np.exp(np.clip(np.median(ratio[alike], axis=0), -most, most)) if alike.any() else np.ones(3)


def _line(x: NDArray[np.float64], y: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gain and offset per channel, (2, 3), of colours (N, 3) by others: a straight line as far as the two go together
    (by their squared correlation), and the quotient of their means as far as they do not; what is noise in ``x`` would
    flatten a line."""
    w = weight[:, None] / weight.sum()
    mean_x, mean_y = (w * x).sum(0), (w * y).sum(0)
    dx, dy = x - mean_x, y - mean_y
    along, of_x, of_y = (w * dx * dy).sum(0), (w * dx**2).sum(0), (w * dy**2).sum(0)
    together = np.clip(along, 0, None) ** 2 / np.maximum(of_x * of_y, 1e-12)
    gain = together * along / np.maximum(of_x, 1e-9) + (1 - together) * mean_y / mean_x
    return np.stack([gain, mean_y - gain * mean_x])


def fit_colours(source: Image, target: Image, rounds: int = 8) -> NDArray[np.float64]:
    """Gain and offset per channel, (2, 3), that carry ``source`` to ``target`` where the two show the same.

    Robust: begun with the gain about which most pixels are, and reweighted by what the better ones leave, so that more
    than half may show something else, unless that is more alike. (1, 0) where too few are neither dark nor saturated.
    """
    out = np.stack([np.ones(3), np.zeros(3)])
    usable = np.all((source > 0.02) & (source < 0.98) & (target > 0.02) & (target < 0.98), axis=-1)
    if usable.sum() < 50:
        return out
    x, y = source[usable].astype(np.float64), target[usable].astype(np.float64)
    out[0] = _likeliest_gain(x, y)
    for _ in range(rounds):
        error = np.sqrt(((x * out[0] + out[1] - y) ** 2).sum(-1))
        # of normal errors in three channels 1.5 times their median, but asked of the better half
        scale = max(2.1 * float(np.quantile(error, 0.25)), 0.01)
        out = _line(x, y, 1 / (1 + (error / scale) ** 2) ** 2)
    return out
