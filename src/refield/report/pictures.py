"""Pictures for the page: data URIs, change masks laid over a photo, the before/after sheet."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn import functional

from refield.report.visit import Comparison
from refield.scene.files import write_bytes

IN_COLOUR, OUT_COLOUR, UNCLEAR_COLOUR = (
    (16, 185, 199),
    (249, 115, 22),
    (147, 51, 234),
)  # told apart by colour-blind eyes too, unlike green and red
WIDEST = 960  # pixels of a picture on the page
_PNG_PIXELS = 256 * 256  # larger pictures are inlined as JPEG
_GAP, _CAPTION = 8, 22


def data_uri(image: Tensor) -> str:
    """A picture (H, W, 3), uint8 or float in [0, 1], as text for an ``img``'s ``src``."""
    picture = _picture(image)
    if picture.width > WIDEST:
        picture = picture.resize((WIDEST, round(picture.height * WIDEST / picture.width)), Image.Resampling.LANCZOS)
    kind = "PNG" if picture.width * picture.height <= _PNG_PIXELS else "JPEG"
    buffer = io.BytesIO()
    picture.save(buffer, kind, **({} if kind == "PNG" else {"quality": 90}))
    return f"data:image/{kind.lower()};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def with_masks(photo: Tensor, mask_in: Tensor | None, mask_out: Tensor | None, unclear: Tensor | None = None) -> Tensor:
    """The photo in pale grey with what is new, gone and not understood in colour and outlined; (H, W, 3) float."""
    image = _unit(photo)
    grey = (image @ torch.tensor([0.299, 0.587, 0.114]))[..., None]
    out = (0.75 * grey + 0.25).expand(*image.shape).clone()
    masks = (unclear, UNCLEAR_COLOUR), (mask_in, IN_COLOUR), (mask_out, OUT_COLOUR)
    inked = [(m, torch.tensor(c) / 255) for m, c in masks if m is not None]
    for mask, ink in inked:
        out[mask] = 0.5 * image[mask] + 0.5 * ink
    for mask, ink in inked:
        out[_outline(mask)] = ink
    return out


def write_contact_sheet(path: Path | str, views: Sequence[Comparison], height: int = 240) -> Path:
    """One row per view, before · photo · after, as a PNG. Views that lack one of the three are left out.

    Raises ValueError if no view has all three.
    """
    rows = [[v.before, v.photo, v.after] for v in views]
    complete = [[_at_height(p, height) for p in row if p is not None] for row in rows if None not in row]
    if not complete:
        raise ValueError("no view has a picture before, a photo and a picture after")
    widths = [max(row[i].width for row in complete) for i in range(3)]
    size = (sum(widths) + 4 * _GAP, _CAPTION + len(complete) * (height + _GAP) + _GAP)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(13)
    x = _GAP
    for i, caption in enumerate(("before", "photo", "updated")):
        draw.text((x, _CAPTION / 2 + 2), caption, fill=(60, 60, 67), font=font, anchor="lm")
        for j, row in enumerate(complete):
            sheet.paste(row[i], (x, _CAPTION + _GAP // 2 + j * (height + _GAP)))
        x += widths[i] + _GAP
    buffer = io.BytesIO()
    sheet.save(buffer, "PNG")
    write_bytes(Path(path), buffer.getvalue())
    return Path(path)


def _at_height(image: Tensor, height: int) -> Image.Image:
    picture = _picture(image)
    return picture.resize((round(picture.width * height / picture.height), height), Image.Resampling.BICUBIC)


def _picture(image: Tensor) -> Image.Image:
    return Image.fromarray((_unit(image) * 255).round().to(torch.uint8).numpy())


def _unit(image: Tensor) -> Tensor:
    """uint8 or float -> float32 in [0, 1] on the CPU; what is not a number becomes black."""
    image = image.detach().cpu()
    if image.dtype == torch.uint8:
        return image.float() / 255
    return image.float().nan_to_num(0.0).clamp(0, 1)


def _outline(mask: Tensor) -> Tensor:
    """The mask's own pixels that touch its outside."""
    outside = functional.max_pool2d((~mask)[None].float(), 3, stride=1, padding=1)[0] > 0
    return mask & outside
