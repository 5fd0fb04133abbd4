"""How well does a field show what is there now? PSNR and SSIM, -in and -out (§11.2); pose error to truth.

Renders are rounded to 8 bits first, so the scores are those of the PNGs that ``refield render`` writes.
Regions of a view: *in* and *out* are the pixels of its two change masks, *untouched* those far from both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_frame
from refield.scene.capture import Frame
from refield.scene.errors import InputError
from refield.scene.images import frame_image, read_mask
from refield.scene.pose import angle_between, transform
from refield.scene.transforms_json import load_transforms, stem
from refield.vision.alignment import align
from refield.vision.pixels import dilate
from refield.vision.similarity import pooled_psnr, squared_error, ssim_in_box


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
    """One field's quality, in one view or over all. PSNR in dB, at most 100; None: no such mask or no such
    pixels."""

    psnr: float | None = None
    """of all pixels"""
    psnr_in: float | None = None
    ssim_in: float | None = None
    psnr_out: float | None = None
    ssim_out: float | None = None
    psnr_untouched: float | None = None
    """of the pixels in neither mask, by `EvaluateConfig.margin`"""
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
    """the same shape; aligned, if that was asked for"""
    render_before: Tensor | None = field(repr=False, compare=False)
    mask_in: Tensor | None = field(repr=False, compare=False)
    """(H, W) bool"""
    mask_out: Tensor | None = field(repr=False, compare=False)


@dataclass(frozen=True)
class Report:
    """Every view, and all of them together."""

    views: tuple[ViewReport, ...]
    pooled: Scores
    """PSNR over the pixels of all views together; SSIM as the mean over views"""
    mean: Scores
    """mean over the views that have a value"""
    pooled_before: Scores | None = None
    """of the old field, if one was given"""
    mean_before: Scores | None = None

    def to_dict(self) -> dict[str, Any]:
        """Everything but the pictures, as JSON can hold it."""

        def plain(scores: Scores | None) -> dict[str, float | None] | None:
            return None if scores is None else asdict(scores)

        views = [{"name": v.name, "scores": plain(v.scores), "before": plain(v.scores_before)} for v in self.views]
        return {
            "pooled": plain(self.pooled),
            "mean": plain(self.mean),
            "pooled_before": plain(self.pooled_before),
            "mean_before": plain(self.mean_before),
            "views": views,
        }


def evaluate(
    field: Field,
    folder: Path | str,
    *,
    old: Field | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    on_view: Callable[[str], None] | None = None,
) -> Report:
    """Render every frame of ``folder/transforms.json`` and compare it with its image.

    ``folder`` also holds ``masks_in/`` and ``masks_out/``, PNGs with the images' stems. Either folder may be
    missing, and its scores are then None. ``old`` is scored on the same pixels; ``on_view`` hears each view's
    name.

    Raises:
        InputError: the folder cannot be read, or a mask is missing or of another size than its image.
    """
    folder = Path(folder)
    views = []
    for frame in load_transforms(folder).frames:
        if on_view is not None:
            on_view(frame.name)
        views.append(_view(field, old, folder, frame, config))
    before = [v.scores_before for v in views if v.scores_before is not None]
    return Report(
        views=tuple(views),
        pooled=_pooled(views, False, config),
        mean=_mean([v.scores for v in views]),
        pooled_before=_pooled(views, True, config) if before else None,
        mean_before=_mean(before) if before else None,
    )


def pose_error(new_from_old: Tensor, true_new_from_old: Tensor, centre: Tensor) -> tuple[float, float]:
    """How far an estimated pose change is off (§11.3.3).

    The distance between the two places to which they take the object's old ``centre`` (3,), in world units,
    and the angle between their rotations in degrees.
    """
    a, b = new_from_old.double(), true_new_from_old.double()
    c = centre.double()
    distance = (transform(a, c) - transform(b, c)).norm()
    return float(distance), float(angle_between(a, b))


# --- one view ---


def _view(new: Field, old: Field | None, folder: Path, frame: Frame, config: EvaluateConfig) -> ViewReport:
    truth = frame_image(frame).float() / 255
    mask_in, mask_out = (_mask(folder / name, frame) for name in ("masks_in", "masks_out"))
    regions = _regions(mask_in, mask_out, config.margin, truth)
    render = _rendered(new, frame, truth, config)
    before = None if old is None else _rendered(old, frame, truth, config)
    return ViewReport(
        name=frame.name,
        scores=_scores([_View(render, truth, regions)], config),
        scores_before=None if before is None else _scores([_View(before, truth, regions)], config),
        truth=truth,
        render=render,
        render_before=before,
        mask_in=mask_in,
        mask_out=mask_out,
    )


def _rendered(field: Field, frame: Frame, truth: Tensor, config: EvaluateConfig) -> Tensor:
    rgb = render_frame(field, frame).rgb.clamp(0, 1).cpu()
    if config.align:
        rgb = torch.from_numpy(align(rgb.numpy(), truth.numpy()))
    return (rgb * 255).round() / 255


def _mask(folder: Path, frame: Frame) -> Tensor | None:
    if not folder.is_dir():
        return None
    path = folder / f"{stem(frame)}.png"
    if not path.is_file():
        raise InputError(path, f"there is no mask for {frame.name}", "add it, all black if nothing changed there")
    mask = read_mask(path)
    expected = (frame.camera.height, frame.camera.width)
    if tuple(mask.shape) != expected:
        what = f"the mask has {mask.shape[1]}x{mask.shape[0]} pixels, its image {expected[1]}x{expected[0]}"
        raise InputError(path, what, "give both the same size")
    return mask


def _regions(mask_in: Tensor | None, mask_out: Tensor | None, margin: int, like: Tensor) -> dict[str, Tensor]:
    """The known regions of a view of the size of ``like``, (H, W) bool each."""
    regions = {"all": torch.ones(like.shape[:2], dtype=torch.bool)}
    changed = {name: mask for name, mask in (("in", mask_in), ("out", mask_out)) if mask is not None}
    if changed:
        either = torch.stack(list(changed.values())).any(0)
        regions["untouched"] = ~torch.from_numpy(dilate(either.numpy(), margin))
    return regions | changed


# --- scores ---


@dataclass(frozen=True)
class _View:
    """A picture, the truth, and where to compare them."""

    image: Tensor
    truth: Tensor
    regions: Mapping[str, Tensor]


def _scores(views: Sequence[_View], config: EvaluateConfig) -> Scores:
    """PSNR over the regions' pixels of all views together, SSIM as the mean over the views."""

    def decibels(region: str) -> float | None:
        known = [v for v in views if region in v.regions]
        return pooled_psnr([squared_error(v.image, v.truth, v.regions[region]) for v in known])

    def similarity(region: str) -> float | None:
        known = [v for v in views if region in v.regions]
        return _average([ssim_in_box(v.image, v.truth, v.regions[region], config.crop) for v in known])

    return Scores(
        psnr=decibels("all"),
        psnr_in=decibels("in"),
        ssim_in=similarity("in"),
        psnr_out=decibels("out"),
        ssim_out=similarity("out"),
        psnr_untouched=decibels("untouched"),
    )


def _pooled(views: Sequence[ViewReport], before: bool, config: EvaluateConfig) -> Scores:
    pictures = []
    for v in views:
        image = v.render_before if before else v.render
        assert image is not None  # asked for only where every view has one
        pictures.append(_View(image, v.truth, _regions(v.mask_in, v.mask_out, config.margin, v.truth)))
    return _scores(pictures, config)


def _mean(scores: Sequence[Scores]) -> Scores:
    return Scores(**{f.name: _average([getattr(s, f.name) for s in scores]) for f in fields(Scores)})


def _average(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known else None
