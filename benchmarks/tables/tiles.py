"""What sheets of pictures are laid out from."""

from __future__ import annotations

import io
from pathlib import Path

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from refield.report.pictures import IN_COLOUR, OUT_COLOUR
from refield.scene.files import write_bytes
from refield.scene.images import read_mask
from refield.vision.pixels import bounding_box

GAP, CAPTION, SIDE = 6, 20, 190
"""pixels"""


def masks_of(folder: Path, name: str) -> dict[str, Tensor]:
    """The masks of a photo in an evaluation folder, (H, W) bool each, by "in" and "out"; those that are there."""
    paths = {kind: folder / f"masks_{kind}" / f"{Path(name).stem}.png" for kind in ("in", "out")}
    return {kind: read_mask(p) for kind, p in paths.items() if p.is_file()}


def tile(image: Tensor, masks: dict[str, Tensor]) -> Image.Image:
    """The picture, its longer side the sheet's, with a box around where something arrived and left (Fig. 8)."""
    pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    h, w = image.shape[:2]
    scale = SIDE / max(h, w)
    picture = Image.fromarray(pixels).resize((round(scale * w), round(scale * h)), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(picture)
    for kind, ink in (("in", IN_COLOUR), ("out", OUT_COLOUR)):
        box = bounding_box(masks[kind].numpy(), margin=2) if kind in masks else None
        if box is not None:
            draw.rectangle([v * scale for v in box], outline=ink, width=2)
    return picture


def write_picture(path: Path, image: Image.Image) -> None:
    """As a PNG, whole or not at all."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    write_bytes(path, buffer.getvalue())
