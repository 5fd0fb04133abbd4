"""Segment Anything's networks as the second side of the `Segmenter` seam (§3.2, §10.2.2).

The networks are transformers' model classes; what happens before and behind them is here, since transformers' own
processors of SAM 2 and SAM 3 need torchvision, which is none of our dependencies. `refield.vision.weights` opens them.

Left out: EdgeTAM, whose backbone comes from timm and so needs torchvision; SAM 3's and SAM 3 LiteText's detectors, to
which a box is an example of what to look for and not the place of one object (the tracker of SAM 3 is in).

Letters: H, W the image; S the side of the square that a network sees; h, w its embedding; B boxes.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from refield.vision.segmenter import Boxes

Size = tuple[int, int]
"""height, width"""
RGB = tuple[float, float, float]

IMAGENET_MEAN: RGB = (0.485, 0.456, 0.406)
IMAGENET_STD: RGB = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Family:
    """How the networks of a family take their image."""

    mean: RGB
    std: RGB
    padded: bool
    """the longer side fills the square and zeros the rest, right and below; else each axis is stretched to fill it"""

    def placed(self, size: Size, side: int) -> Size:
        """What part of the square, from its top-left corner, an image of this size takes."""
        if not self.padded:
            return side, side
        scale = side / max(size)
        return max(1, int(size[0] * scale + 0.5)), max(1, int(size[1] * scale + 0.5))


SAM = Family(IMAGENET_MEAN, IMAGENET_STD, padded=True)
"""SAM (Kirillov et al. 2023) and SAM-HQ (Ke et al. 2023)"""
SAM2 = Family(IMAGENET_MEAN, IMAGENET_STD, padded=False)
"""SAM 2 and 2.1 (Ravi et al. 2024)"""
SAM3 = Family((0.5, 0.5, 0.5), (0.5, 0.5, 0.5), padded=False)
"""the tracker of SAM 3 (Carion et al. 2025)"""


@final
@dataclass(eq=False)
class SamSegmenter:
    """A network of the SAM family, prompted with boxes. One network, one device; not for several threads at once."""

    model: Any
    """SamModel, SamHQModel, Sam2Model or Sam3TrackerModel"""
    family: Family
    device: torch.device | str = "cpu"
    batch: int = 16
    """boxes decoded at a time"""
    remembered: int = 16
    """images whose embeddings are kept, at 4 to 21 MB each; at least 1. Four views, photographed and rendered, twice"""
    sure: float = 0.95
    """see `Segmenter`"""  # §10.1.3
    _embeddings: OrderedDict[bytes, dict[str, Any]] = field(default_factory=OrderedDict, init=False, repr=False)

    def __post_init__(self) -> None:
        self.model.to(self.device).eval()

    @property
    def side(self) -> int:
        """S, pixels."""
        return int(self.model.config.prompt_encoder_config.image_size)

    @torch.inference_mode()
    def features(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """See `Segmenter.features`. The cells lie evenly over the image: none of them shows padding.

        Raises:
            FloatingPointError: the network's output is not finite.
        """
        embeddings = self._embed(image)["image_embeddings"]
        coarsest = embeddings if isinstance(embeddings, Tensor) else embeddings[-1]
        cells = _finite(covered(coarsest, self.family.placed(_size(image), self.side), self.side))
        return np.ascontiguousarray(cells[0].permute(1, 2, 0).float().cpu().numpy())

    @torch.inference_mode()
    def masks(
        self, image: NDArray[np.uint8], boxes: Boxes, hint: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """See `Segmenter.masks`. Boxes are cut to the image; one without area gets an empty mask and a score of 0.

        The score is the network's own prediction of its mask's intersection over union, which the paper calls
        confidence (§4.2.2); it judges the mask before ``hint`` cuts it.

        Raises:
            ValueError: a box is not finite.
            FloatingPointError: the network's output is not finite.
        """
        h, w = _size(image)
        boxes = np.asarray(boxes, np.float64).reshape(-1, 4)
        if not np.isfinite(boxes).all():
            raise ValueError("boxes must be finite")
        boxes = np.clip(boxes, 0, [w, h, w, h])
        found, scores = np.zeros((len(boxes), h, w), bool), np.zeros(len(boxes))
        real = np.flatnonzero((boxes[:, 2:] > boxes[:, :2]).all(1))
        for start in range(0, len(real), self.batch):
            some = real[start : start + self.batch]
            found[some], scores[some] = self._decode(image, boxes[some])
        return (found if hint is None else found & hint), scores

    def _decode(self, image: NDArray[np.uint8], boxes: Boxes) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """One mask per box: a box says what is meant, so that SAM's three answers to a vague prompt are not needed."""
        size, placed = _size(image), self.family.placed(_size(image), self.side)
        prompt = to_network(boxes, size, placed).to(self.device)
        out = self.model(**self._embed(image), input_boxes=prompt, multimask_output=False)
        logits, score = _finite(out.pred_masks[0, :, 0].float()), _finite(out.iou_scores[0, :, 0].double())
        masks = to_image(logits, size, placed, self.side if self.family.padded else None)
        return masks.cpu().numpy(), score.clamp(0, 1).cpu().numpy()

    def _embed(self, image: NDArray[np.uint8]) -> dict[str, Any]:
        """An image's embeddings, as the keywords of the model's call; computed once while the image is remembered."""
        key = hashlib.blake2b(repr(image.shape).encode() + np.ascontiguousarray(image).tobytes()).digest()
        if key not in self._embeddings:
            found = self.model.get_image_embeddings(to_square(image, self.side, self.family).to(self.device))
            # SAM-HQ's decoder also sees the first of some early layers; SAM 2 and 3 give a list of maps, finest first.
            parts = (found[0], found[1][:1]) if isinstance(found, tuple) else (found,)
            self._embeddings[key] = dict(zip(("image_embeddings", "intermediate_embeddings"), parts))
            if len(self._embeddings) > self.remembered:
                self._embeddings.popitem(last=False)
        self._embeddings.move_to_end(key)
        return self._embeddings[key]


def to_square(image: NDArray[np.uint8], side: int, family: Family) -> Tensor:
    """(H, W, 3) uint8 -> what a network takes, (1, 3, S, S)."""
    h, w = family.placed(_size(image), side)
    resized = np.array(Image.fromarray(image).resize((w, h), Image.Resampling.BILINEAR), np.float32) / 255
    normalised = (resized - np.array(family.mean, np.float32)) / np.array(family.std, np.float32)
    return F.pad(torch.from_numpy(normalised).permute(2, 0, 1), (0, side - w, 0, side - h))[None]


def to_network(boxes: Boxes, size: Size, placed: Size) -> Tensor:
    """Boxes (B, 4), px xyxy in the image, edges at pixel borders -> (1, B, 4) in the network's square.

    The networks add half a pixel to what they are given, because they count from the centre of the first pixel.
    """
    scale = np.array([placed[1] / size[1], placed[0] / size[0]] * 2)
    return torch.from_numpy((boxes * scale - 0.5).astype(np.float32))[None]


def to_image(logits: Tensor, size: Size, placed: Size, side: int | None) -> Tensor:
    """Logits (B, h, w) over the square -> masks (B, H, W) bool; ``side`` of the square if it is padded, else None."""
    x = logits[:, None]
    if side is not None:
        x = F.interpolate(x, (side, side), mode="bilinear", align_corners=False)[..., : placed[0], : placed[1]]
    return F.interpolate(x, size, mode="bilinear", align_corners=False)[:, 0] > 0


def covered(embedding: Tensor, placed: Size, side: int) -> Tensor:
    """The part of an embedding (1, C, h, w) that the image takes, in as many whole cells as fit there.

    Where the image ends within a cell, the cells are spread to end with the image: resizing the result to (H, W) then
    puts every feature where it belongs.
    """
    if placed == (side, side):
        return embedding
    h, w = (max(1, cells * part // side) for cells, part in zip(embedding.shape[-2:], placed))
    y, x = placed[0] / side, placed[1] / side
    theta = torch.tensor([[[x, 0, x - 1], [0, y, y - 1]]], device=embedding.device, dtype=embedding.dtype)
    grid = F.affine_grid(theta, [1, embedding.shape[1], h, w], align_corners=False)
    return F.grid_sample(embedding, grid, padding_mode="border", align_corners=False)


def _size(image: NDArray[np.uint8]) -> Size:
    return image.shape[0], image.shape[1]


def _finite(x: Tensor) -> Tensor:
    if not torch.isfinite(x).all():
        raise FloatingPointError("the segmenter's output is not finite: its weights are damaged or too coarse a type")
    return x
