"""A sheet of left-out photos to look at: photo, render, error; whole, and a crop at full resolution."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont
from tables.tiles import CAPTION, GAP, write_picture
from torch import Tensor

from fields.judge import View
from fields.measures import decibels

BRIGHTER = 4
"""the factor by which errors are shown"""
_SIDE, _ROWS = 256, 5  # pixels of a tile; photos
_INK = (60, 60, 67)
_COLUMNS = ("photo", "render, at its exposure", f"absolute error, times {BRIGHTER}")


def contact_sheet(views: Sequence[View], path: Path) -> None:
    """Of views spread evenly; the worst of them is always there."""
    chosen = _spread(views)
    width = 6 * (_SIDE + GAP) + GAP
    out = Image.new("RGB", (width, CAPTION + len(chosen) * (CAPTION + _SIDE + GAP)), "white")
    draw, font = ImageDraw.Draw(out), ImageFont.load_default(13)
    for i, title in enumerate((*_COLUMNS, *(f"{c}: pixel by pixel" for c in _COLUMNS[:2]), "the same")):
        draw.text((GAP + i * (_SIDE + GAP), CAPTION / 2), title, fill=_INK, font=font, anchor="lm")
    for k, view in enumerate(chosen):
        top = CAPTION + k * (CAPTION + _SIDE + GAP)
        row = view.row()
        told = f"{view.name} · {row['heldout']:.2f} dB ({row['no exposure fitted']:.2f} as rendered)"
        told += f" · sharpness {row['sharpness']:.2f} · floaters {100 * row['floaters']:.1f} %"
        draw.text((GAP, top + CAPTION / 2), told, fill=_INK, font=font, anchor="lm")
        pictures = (view.photo, view.lit, BRIGHTER * (view.lit - view.photo).abs())
        box = crop_of(view.photo)
        tiles = [*(_whole(p) for p in pictures), *(_picture(p[box[0], box[1]]) for p in pictures)]
        for i, tile in enumerate(tiles):
            out.paste(tile, (GAP + i * (_SIDE + GAP), top + CAPTION))
    write_picture(path, out)


def crop_of(photo: Tensor, side: int = _SIDE) -> tuple[slice, slice]:
    """Rows and columns of the part of the right half that has most detail; by the photo alone, so that sheets of
    several fits show the same."""
    h, w = photo.shape[:2]
    left, tall, wide = w // 2, min(side, h), min(side, w - w // 2)
    luma = photo.mean(-1)
    detail = torch.zeros(h, w)
    detail[1:, 1:] = (luma[1:, 1:] - luma[:-1, 1:]).abs() + (luma[1:, 1:] - luma[1:, :-1]).abs()
    stride = max(side // 8, 1)
    means = torch.nn.functional.avg_pool2d(detail[None, None, :, left:], (tall, wide), stride)[0, 0]
    row, column = divmod(int(means.argmax()), means.shape[1])
    top, begin = row * stride, left + column * stride
    return slice(top, top + tall), slice(begin, begin + wide)


def _spread(views: Sequence[View]) -> list[View]:
    worst = max(views, key=lambda v: v.error(True))
    step = max(-(-len(views) // _ROWS), 1)
    chosen = list(views[::step])
    if all(v is not worst for v in chosen):  # views hold tensors, of which == is no yes or no
        chosen[-1] = worst
    return sorted(chosen, key=lambda v: decibels(v.error(True)))


def _whole(image: Tensor) -> Image.Image:
    picture = _picture(image)
    scale = _SIDE / max(picture.size)
    size = tuple(max(round(scale * side), 1) for side in picture.size)
    return picture.resize((size[0], size[1]), Image.Resampling.BOX if scale < 1 else Image.Resampling.NEAREST)


def _picture(image: Tensor) -> Image.Image:
    return Image.fromarray((image.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
