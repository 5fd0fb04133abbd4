"""Pictures for the page: data URIs, change masks to be laid over a photo, the before/after sheet."""

from __future__ import annotations

import base64
import io
import math
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
_QUALITY = 88
_PNG_PIXELS = 64 * 64  # larger pictures are inlined as JPEG
_FILL = 0.45  # opacity of what is marked; its outline is opaque
_GAP, _CAPTION = 8, 22


def data_uri(image: Tensor, most: float = math.inf) -> str:
    """A picture (H, W, 3), uint8 or float in [0, 1], as text for an ``img``'s ``src``; of so many pixels at most."""
    picture = _picture(image)
    size = shown_size(picture.width, picture.height, most)
    if size != picture.size:
        picture = picture.resize(size, Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    if picture.width * picture.height <= _PNG_PIXELS:
        picture.save(buffer, "PNG")
        return _uri("png", buffer)
    picture.save(buffer, "JPEG", quality=_QUALITY, subsampling=0)
    return _uri("jpeg", buffer)


def shown_size(width: int, height: int, most: float = math.inf) -> tuple[int, int]:
    """The (width, height) in which a picture is put on the page."""
    part = min(1.0, WIDEST / width, math.sqrt(most / (width * height)))
    return max(round(width * part), 1), max(round(height * part), 1)


def marks_uri(
    mask_in: Tensor | None, mask_out: Tensor | None, unclear: Tensor | None = None, most: float = math.inf
) -> str:
    """What is new, gone and not understood, (H, W) bool each, in colour and outlined: to be laid over a photo of that
    size; as text for an ``img``'s ``src``. Raises ValueError if there is no mask."""
    masks = (unclear, UNCLEAR_COLOUR), (mask_in, IN_COLOUR), (mask_out, OUT_COLOUR)
    inked = [(m.detach().cpu(), colour) for m, colour in masks if m is not None]
    if not inked:
        raise ValueError("there is no mask to show")
    height, width = inked[0][0].shape
    size = shown_size(width, height, most)
    small = [(_resized(m, size), torch.tensor(colour, dtype=torch.uint8)) for m, colour in inked]
    out = torch.zeros(size[1], size[0], 4, dtype=torch.uint8)
    for mask, ink in small:
        out[mask] = torch.cat([ink, torch.tensor([round(255 * _FILL)], dtype=torch.uint8)])
    for mask, ink in small:
        out[_outline(mask)] = torch.cat([ink, torch.tensor([255], dtype=torch.uint8)])
    buffer = io.BytesIO()
    Image.fromarray(out.numpy(), "RGBA").save(buffer, "PNG", optimize=True)
    return _uri("png", buffer)


def _uri(kind: str, buffer: io.BytesIO) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _resized(mask: Tensor, size: tuple[int, int]) -> Tensor:
    """(H, W) bool at another (width, height)."""
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    scaled = functional.interpolate(mask[None, None].float(), (size[1], size[0]), mode="area")
    return scaled[0, 0] > 0.5


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
