"""LightGlue's network as the second side of the `Matcher` seam (§9, §10.2.3).

The networks are transformers' model classes; what happens before and behind them is here, so that no processor of
theirs (and no torchvision) is needed. `refield.vision.weights` opens them. Keypoints come from SuperPoint, the only
detector that transformers has: its LightGlue can take neither DISK nor ALIKED without code from outside.

Left out: EfficientLoFTR. It runs, but the class of transformers 5.23 compares cells that do not belong together: it
takes the k-th cell of one image's list of partners with the k-th of the other's, and the lists are ordered differently.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from refield.vision.matcher import Matches

GREY = (0.2989, 0.5870, 0.1140)
"""weights of red, green and blue, as the published weights were trained with"""


@final
@dataclass(frozen=True)
class LightGlueMatcher:
    """SuperPoint's keypoints (DeTone et al. 2018) matched by LightGlue (Lindenberger et al. 2023) or SuperGlue."""

    model: Any
    """LightGlueForKeypointMatching or SuperGlueForKeypointMatching"""
    device: torch.device | str = "cpu"
    threshold: float = 0.2
    """matches with a score of at most this are left out"""
    size: tuple[int, int] = (480, 640)
    """height and width, multiples of 8, to which both images are brought; upright if both images are"""

    def __post_init__(self) -> None:
        self.model.to(self.device).eval()

    @torch.inference_mode()
    def match(self, image_a: NDArray[np.uint8], image_b: NDArray[np.uint8]) -> Matches:
        """See `Matcher.match`. The score is the network's probability that the two points are the same.

        Raises:
            FloatingPointError: the network's output is not finite.
        """
        upright = all(i.shape[0] > i.shape[1] for i in (image_a, image_b))
        size = (max(self.size), min(self.size)) if upright else self.size
        pair = torch.stack([to_grey(image_a, size), to_grey(image_b, size)])[None].to(self.device)
        out = self.model(pixel_values=pair)
        a, b, score = matched(out, self.threshold)
        xy_a, xy_b = (in_pixels(p, size, i.shape) for p, i in ((a, image_a), (b, image_b)))
        return xy_a, xy_b, score.double().clamp(0, 1).cpu().numpy()


def to_grey(image: NDArray[np.uint8], size: tuple[int, int]) -> Tensor:
    """(H, W, 3) uint8 -> (3, h, w) in [0, 1], the grey three times."""
    resized = Image.fromarray(image).resize((size[1], size[0]), Image.Resampling.BILINEAR)
    r, g, b = torch.from_numpy(np.array(resized, np.float32) / 255).unbind(-1)
    # What is grey already stays as it is: the three weights add up to 0.9999.
    grey = r if torch.equal(r, g) and torch.equal(g, b) else GREY[0] * r + GREY[1] * g + GREY[2] * b
    return grey.expand(3, -1, -1)


def matched(out: Any, threshold: float) -> tuple[Tensor, Tensor, Tensor]:
    """A network's output for one pair -> (K, 2) and (K, 2) as fractions of the image, (K,) score.

    Raises:
        FloatingPointError: scores or points are not finite.
    """
    points, (real_a, real_b) = out.keypoints[0], out.mask[0] > 0  # lists are filled up to the longer one's length
    partner, score = out.matches[0, 0].long(), out.matching_scores[0, 0]
    if not (torch.isfinite(points).all() and torch.isfinite(score[real_a]).all()):
        raise FloatingPointError("the matcher's output is not finite: its weights are damaged or too coarse a type")
    keep = real_a & (partner >= 0) & real_b[partner.clamp_min(0)] & (score > threshold)
    return points[0][keep], points[1][partner[keep]], score[keep]


def in_pixels(points: Tensor, size: tuple[int, int], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """(K, 2) fractions xy of the network's (h, w) -> px of an image of this shape, whose first pixel is at (0.5, 0.5).

    The network counts from the centre of the first pixel that it sees, which is half a pixel of its own size inside.
    """
    seen = np.array([size[1], size[0]], np.float64)
    return (points.double().cpu().numpy() + 0.5 / seen) * np.array([shape[1], shape[0]], np.float64)
