"""2-D in-painting of where something left: a picture's pixels made up from those around them (§5.2).

The paper in-paints the evaluation photos with LaMa and takes that for what NeRF in-painting could reach. OpenCV's own
method needs no weights; LaMa comes from an ONNX file of the user's (OpenCV's model zoo: ``inpainting_lama``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
import torch
from torch import Tensor

from refield.scene.errors import InputError
from refield.vision.pixels import Image, Mask, dilate, to_bytes

_REMEDY = "give inpainting_lama_*.onnx of OpenCV's model zoo"


class Inpainter(Protocol):
    """Makes up the pixels in a mask."""

    def __call__(self, image: Image, mask: Mask) -> Image:
        """(H, W, 3) uint8 RGB and (H, W) bool, not empty -> (H, W, 3) uint8; only what is in the mask is used."""
        ...


class Diffusion:
    """OpenCV's: Telea's fast marching, or Navier–Stokes."""

    def __init__(self, method: Literal["telea", "navier-stokes"] = "telea", reach: float = 0.02) -> None:
        """``reach``: radius of the neighbourhood that is looked at, in image widths."""
        self._flag = {"telea": cv2.INPAINT_TELEA, "navier-stokes": cv2.INPAINT_NS}[method]
        self._reach = reach

    def __call__(self, image: Image, mask: Mask) -> Image:
        radius = max(3.0, self._reach * image.shape[1])
        return cv2.inpaint(np.ascontiguousarray(image), mask.astype(np.uint8), radius, self._flag)


class Lama:
    """LaMa (Suvorov et al. 2022) from an ONNX file, run by OpenCV on a CPU.

    The network has the inputs ``image`` (1, 3, 512, 512) RGB in [0, 1] and ``mask`` (1, 1, 512, 512), 1 where to
    paint; it answers (1, 3, 512, 512) in [0, 255].
    """

    SIDE = 512

    def __init__(self, path: Path) -> None:
        """Raises InputError: there is no such file, it is no ONNX model, or it has other inputs."""
        if not path.is_file():
            raise InputError(path, "there is no such file", _REMEDY)
        try:
            self._network = cv2.dnn.readNetFromONNX(str(path))
        except cv2.error as error:
            raise InputError(path, f"OpenCV cannot read it as an ONNX model ({_line(error)})", _REMEDY) from None
        self._path = path

    def __call__(self, image: Image, mask: Mask) -> Image:
        """Raises InputError: the network is not LaMa's."""
        h, w = mask.shape
        small = cv2.resize(image, (self.SIDE, self.SIDE), interpolation=cv2.INTER_LINEAR)
        # whatever is only in part to be painted over is painted over
        holes = cv2.resize(mask.astype(np.float32), (self.SIDE, self.SIDE), interpolation=cv2.INTER_LINEAR) > 0
        answer = self._answer(small.transpose(2, 0, 1)[None] / np.float32(255), holes[None, None].astype(np.float32))
        painted = np.clip(answer[0].transpose(1, 2, 0), 0, 255).astype(np.float32)
        resized = cv2.resize(painted, (w, h), interpolation=cv2.INTER_AREA if w < self.SIDE else cv2.INTER_CUBIC)
        return np.clip(np.rint(resized), 0, 255).astype(np.uint8)

    def _answer(self, image: Image, holes: Image) -> Image:
        wanted = (1, 3, self.SIDE, self.SIDE)
        try:
            self._network.setInput(image, "image")
            self._network.setInput(holes, "mask")
            answer = np.asarray(self._network.forward())
        except cv2.error as error:
            what = f"does not take an image and a mask of {self.SIDE}x{self.SIDE} pixels ({_line(error)})"
            raise InputError(self._path, what, _REMEDY) from None
        if answer.shape != wanted or not np.isfinite(answer).all():
            what = f"answers {answer.shape} in place of finite {wanted}"
            raise InputError(self._path, what, _REMEDY)
        return answer


def inpaint(image: Tensor, mask: Tensor, painter: Inpainter | None = None, margin: int = 0) -> Tensor:
    """A picture with the pixels of ``mask`` made up; those beyond its margin stay as they are.

    Args:
        image: (H, W, 3) in [0, 1].
        mask: (H, W) bool.
        painter: `Diffusion` by default.
        margin: pixels around the mask that are made up as well: in a render an object reaches a little beyond its
            mask.

    Returns:
        (H, W, 3) float32.

    Raises:
        InputError: the painter's weights are no use.
    """
    if not bool(mask.any()):
        return image.float()
    holes = dilate(mask.numpy(), margin)
    painted = (painter or Diffusion())(to_bytes(image.numpy()), holes)
    return torch.where(torch.from_numpy(holes)[..., None], torch.from_numpy(painted).float() / 255, image.float())


def _line(error: cv2.error) -> str:
    lines = [part.strip() for part in str(error).splitlines() if part.strip()]
    return lines[0][:160] if lines else "unknown"
