"""The Describer seam: one vector per photo, by which photos of the same place are found (§10.2.1).

Default: VLAD of the capture's own SIFT features (`refield.vision.vlad`). The other side: a network with weights from a
local folder, in NetVLAD's place: DINOv2 (Oquab et al. 2023), its patches pooled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""of the pictures that the published weights were trained on"""


class Describer(Protocol):
    """Tells what a photo looks like as a whole."""

    def describe(self, image: NDArray[np.uint8]) -> Tensor:
        """(H, W, 3) uint8 RGB -> (D,) unit vector."""
        ...


@final
@dataclass(frozen=True)
class DinoDescriber:
    """DINOv2's class token beside the generalised mean (GeM) of its patches."""

    model: Any
    """Dinov2Model or Dinov2WithRegistersModel"""
    device: torch.device | str = "cpu"
    shorter: int = 224
    """pixels of the shorter side; both become multiples of the patch"""
    power: float = 3.0
    """of the mean"""

    def __post_init__(self) -> None:
        self.model.to(self.device).eval()

    @torch.inference_mode()
    def describe(self, image: NDArray[np.uint8]) -> Tensor:
        """See `Describer.describe`.

        Raises:
            FloatingPointError: the network's output is not finite.
        """
        tokens = self.model(pixel_values=self._input(image)).last_hidden_state[0].float()
        first = 1 + int(getattr(self.model.config, "num_register_tokens", 0) or 0)
        patches = torch.nn.functional.normalize(tokens[first:], dim=1).clamp_min(1e-6)
        pooled = patches.pow(self.power).mean(0).pow(1 / self.power)
        parts = [torch.nn.functional.normalize(p, dim=0) for p in (tokens[0], pooled)]
        out = torch.nn.functional.normalize(torch.cat(parts), dim=0).cpu()
        if not bool(out.isfinite().all()):
            raise FloatingPointError("DINOv2 returned values that are not finite")
        return out

    def _input(self, image: NDArray[np.uint8]) -> Tensor:
        patch = int(self.model.config.patch_size)
        height, width = image.shape[:2]
        scale = self.shorter / min(height, width)
        size = [max(round(side * scale / patch), 1) * patch for side in (width, height)]
        picture = np.asarray(Image.fromarray(image).resize((size[0], size[1]), Image.Resampling.BICUBIC))
        unit = (torch.tensor(picture).float() / 255 - torch.tensor(_MEAN)) / torch.tensor(_STD)
        return unit.permute(2, 0, 1)[None].to(self.device)
