"""How well does a field show what is there now? PSNR, SSIM and LPIPS, -in and -out (§11.2); pose error to truth.

Renders are rounded to 8 bits first, so the scores are those of the PNGs that ``refield render`` writes.
Regions of a view: *in* and *out* are the pixels of its two change masks, *untouched* those far from both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from refield.field.radiance import Field, check_field
from refield.field.render import render_frame
from refield.scene.capture import Frame
from refield.scene.errors import InputError
from refield.scene.files import AnyPath, as_path
from refield.scene.images import frame_image, read_mask
from refield.scene.pose import angle_between, transform
from refield.scene.transforms_json import load_transforms, stem_of
from refield.vision.alignment import align
from refield.vision.perceptual import Perceptual, lpips_in_box
from refield.vision.pixels import dilate
from refield.vision.similarity import WINDOW, pooled_psnr, squared_error, ssim, ssim_in_box

MASKS = ("masks_in", "masks_out")
"""the folders of an evaluation's masks"""


@dataclass(frozen=True)
class EvaluateConfig:
    """How views are compared."""

    margin: int = 4
    """untouched pixels are those in neither mask dilated by so many pixels"""
    crop: int = 256
    """side to which the masks' bounding boxes are resized for SSIM and LPIPS"""  # §11.2
    align: bool = False
    """align each render to its photo by a homography first: for photos whose poses are not exact"""  # §5.3


@dataclass(frozen=True)
class Scores:
    """One field's quality, in one view or over all. PSNR in dB, at most 100; None: no such mask or no such
    pixels."""

    psnr: float | None = None
    """of all pixels"""
    ssim: float | None = None
    """of whole views (§11.3.2)"""
    psnr_in: float | None = None
    ssim_in: float | None = None
    psnr_out: float | None = None
    ssim_out: float | None = None
    psnr_untouched: float | None = None
    """of the pixels in neither mask, by `EvaluateConfig.margin`"""
    lpips_in: float | None = None
    """LPIPS needs weights; None without them"""
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
    frame: Frame | None = field(default=None, repr=False, compare=False)
    """where it was taken"""


@dataclass(frozen=True)
class Report:
    """Every view, and all of them together."""

    views: tuple[ViewReport, ...]
    pooled: Scores
    """PSNR over the pixels of all views together; SSIM and LPIPS as the mean over views"""
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
    folder: AnyPath,
    *,
    old: Field | None = None,
    frames: Sequence[Frame] | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    on_view: Callable[[str], None] | None = None,
    perceptual: Perceptual | None = None,
) -> Report:
    """Render every frame of ``folder/transforms.json``, or of ``frames``, and compare it with its image.

    ``folder`` also holds ``masks_in/`` and ``masks_out/``, PNGs with the images' stems; larger ones are scaled down.
    Either folder may be missing, and its scores are then None. ``old`` is scored on the same pixels; ``on_view`` hears
    each view's name; ``perceptual`` measures LPIPS.

    Raises:
        InputError: the folder cannot be read, or a mask is missing or of another size than its image.
    """
    folder = as_path(folder, "the evaluation's folder")
    check_field(field)
    views = []
    for frame in looked_over(folder, frames):
        if on_view is not None:
            on_view(frame.name)
        views.append(_scored(_view(field, old, folder, frame, config), config, perceptual))
    return _report(views, config)


def looked_over(folder: Path, frames: Sequence[Frame] | None = None) -> Sequence[Frame]:
    """The views that `evaluate` would compare, after a look at everything that it reads; nothing is rendered.

    Raises:
        InputError: as `evaluate`.
    """
    frames = load_transforms(folder).frames if frames is None else frames
    for frame in frames:
        need_masks(folder, frame.name, (frame.camera.height, frame.camera.width))
    return frames


def need_masks(folder: Path, name: str, shape: tuple[int, int]) -> None:
    """Look at the masks of the view ``name`` of (H, W) pixels.

    Raises:
        InputError: one is missing or of another size.
    """
    for masks in MASKS:
        _mask(folder / masks, name, shape)


def rescored(
    report: Report,
    pictures: Sequence[Tensor],
    config: EvaluateConfig = EvaluateConfig(),
    perceptual: Perceptual | None = None,
) -> Report:
    """The same views as ``report`` shows, with other pictures in place of its renders, (H, W, 3) in [0, 1] each.

    They are rounded as renders are, and not aligned.
    """
    views = [replace(v, render=_rounded(p), render_before=None) for v, p in zip(report.views, pictures, strict=True)]
    return _report([_scored(v, config, perceptual) for v in views], config)


def _report(views: Sequence[ViewReport], config: EvaluateConfig) -> Report:
    mean = _mean([v.scores for v in views])
    before = [v.scores_before for v in views if v.scores_before is not None]
    mean_before = _mean(before) if before else None
    return Report(
        views=tuple(views),
        pooled=replace(mean, **_pooled(views, False, config)),
        mean=mean,
        pooled_before=None if mean_before is None else replace(mean_before, **_pooled(views, True, config)),
        mean_before=mean_before,
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
    shape = (frame.camera.height, frame.camera.width)
    mask_in, mask_out = (_mask(folder / masks, frame.name, shape) for masks in MASKS)
    return ViewReport(
        name=frame.name,
        scores=Scores(),
        scores_before=None,
        truth=truth,
        render=_rendered(new, frame, truth, config),
        render_before=None if old is None else _rendered(old, frame, truth, config),
        mask_in=mask_in,
        mask_out=mask_out,
        frame=frame,
    )


def _scored(view: ViewReport, config: EvaluateConfig, perceptual: Perceptual | None) -> ViewReport:
    """The view with the scores of its pictures."""
    regions = _regions(view.mask_in, view.mask_out, config.margin, view.truth)

    def of(image: Tensor) -> Scores:
        return _scores(_View(image, view.truth, regions), config, perceptual)

    before = None if view.render_before is None else of(view.render_before)
    return replace(view, scores=of(view.render), scores_before=before)


def _rendered(field: Field, frame: Frame, truth: Tensor, config: EvaluateConfig) -> Tensor:
    rgb = render_frame(field, frame).rgb.clamp(0, 1).cpu()
    if config.align:
        rgb = torch.from_numpy(align(rgb.numpy(), truth.numpy()))
    return _rounded(rgb)


def _rounded(rgb: Tensor) -> Tensor:
    return (rgb.clamp(0, 1) * 255).round() / 255


def _mask(folder: Path, name: str, expected: tuple[int, int]) -> Tensor | None:
    if not folder.is_dir():
        return None
    path = folder / f"{stem_of(name)}.png"
    if not path.is_file():
        raise InputError(path, f"there is no mask for {name}", "add it, all black if nothing changed there")
    mask = read_mask(path)
    if _is_larger(mask, expected):  # the photo was scaled down when it was taken in
        mask = functional.interpolate(mask[None, None].float(), expected, mode="nearest")[0, 0] > 0.5
    if tuple(mask.shape) != expected:
        what = f"the mask has {mask.shape[1]}x{mask.shape[0]} pixels, its image {expected[1]}x{expected[0]}"
        raise InputError(path, what, "give both the same size")
    return mask


def _is_larger(mask: Tensor, expected: tuple[int, int]) -> bool:
    """Whether a mask is a larger one of the same shape, to within half a pixel."""
    by = mask.shape[0] / expected[0]
    return by > 1.1 and abs(mask.shape[1] / by - expected[1]) <= 0.5


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


def _scores(view: _View, config: EvaluateConfig, perceptual: Perceptual | None) -> Scores:
    """Of one view."""

    def similarity(region: str) -> float | None:
        mask = view.regions.get(region)
        return None if mask is None else ssim_in_box(view.image, view.truth, mask, config.crop)

    def distance(region: str) -> float | None:
        mask = view.regions.get(region)
        if mask is None or perceptual is None:
            return None
        return lpips_in_box(perceptual, view.image, view.truth, mask, config.crop)

    large = min(view.truth.shape[:2]) >= WINDOW
    return Scores(
        **_decibels([view]),
        ssim=ssim(view.image, view.truth) if large else None,
        ssim_in=similarity("in"),
        ssim_out=similarity("out"),
        lpips_in=distance("in"),
        lpips_out=distance("out"),
    )


def _decibels(views: Sequence[_View]) -> dict[str, float | None]:
    """PSNR of each region, over its pixels in all the views together."""

    def of(region: str) -> float | None:
        known = [v for v in views if region in v.regions]
        return pooled_psnr([squared_error(v.image, v.truth, v.regions[region]) for v in known])

    return {"psnr": of("all")} | {f"psnr_{region}": of(region) for region in ("in", "out", "untouched")}


def _pooled(views: Sequence[ViewReport], before: bool, config: EvaluateConfig) -> dict[str, float | None]:
    pictures = []
    for v in views:
        image = v.render_before if before else v.render
        assert image is not None  # asked for only where every view has one
        pictures.append(_View(image, v.truth, _regions(v.mask_in, v.mask_out, config.margin, v.truth)))
    return _decibels(pictures)


def _mean(scores: Sequence[Scores]) -> Scores:
    return Scores(**{f.name: _average([getattr(s, f.name) for s in scores]) for f in fields(Scores)})


def _average(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known else None
