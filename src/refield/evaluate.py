"""How well does a field show what is there now? PSNR and SSIM, -in and -out (§11.2); pose error against truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from torch import Tensor

from refield.field.radiance import Field


@dataclass(frozen=True)
class EvaluateConfig:
    """How views are compared."""

    margin: int = 4
    """untouched pixels are those in neither mask dilated by so many pixels"""
    crop: int = 256
    """side to which the masks' bounding boxes are resized for SSIM (§11.2)"""
    align: bool = False
    """align each render to its photo by a homography first (§5.3): for photos whose poses are not exact"""


@dataclass(frozen=True)
class Scores:
    """One field's quality, in one view or over all. None: no such mask, or no such pixels. PSNR in dB."""

    psnr: float | None
    """of all pixels"""
    psnr_in: float | None = None
    ssim_in: float | None = None
    psnr_out: float | None = None
    ssim_out: float | None = None
    psnr_untouched: float | None = None
    """of the pixels in neither mask"""
    lpips_in: float | None = None
    """not computed: it needs downloaded weights"""
    lpips_out: float | None = None


@dataclass(frozen=True)
class ViewReport:
    """One evaluation view. The pictures are for the report page and are no part of the JSON."""

    name: str
    scores: Scores
    scores_before: Scores | None
    """of the old field, if one was given"""
    truth: Tensor = field(repr=False, compare=False)
    """(H, W, 3) float32 in [0, 1]"""
    render: Tensor = field(repr=False, compare=False)
    render_before: Tensor | None = field(repr=False, compare=False)
    mask_in: Tensor | None = field(repr=False, compare=False)
    mask_out: Tensor | None = field(repr=False, compare=False)


@dataclass(frozen=True)
class Report:
    """All views, and the same over all of them."""

    views: tuple[ViewReport, ...]
    pooled: Scores
    """PSNR over the pixels of all views together; SSIM as the mean over views"""
    mean: Scores
    """mean over the views that have a value"""
    pooled_before: Scores | None
    mean_before: Scores | None

    def to_dict(self) -> dict[str, Any]:
        """Everything but the pictures, as JSON can hold it."""
        raise NotImplementedError


def evaluate(
    field: Field,
    folder: Path | str,
    *,
    old: Field | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    on_view: Callable[[str], None] | None = None,
) -> Report:
    """Render every frame of ``folder/transforms.json`` and compare it with its image.

    ``folder`` also holds ``masks_in/`` and ``masks_out/`` (PNGs with the images' stems; a folder may be missing, or
    a mask: then nothing changed in that view, and its region's scores are None).

    Raises:
        InputError: the folder cannot be read.
    """
    raise NotImplementedError


def pose_error(new_from_old: Tensor, true_new_from_old: Tensor, centre: Tensor) -> tuple[float, float]:
    """Distance between the two new places of the object's old ``centre`` (3,), world units, and the angle between
    the two rotations in degrees (§11.3.3)."""
    raise NotImplementedError
