"""What a notebook shows of our types: small tables, photos as thumbnails. Text is escaped, colours are the page's."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from PIL import Image
from torch import Tensor

from refield.scene.capture import Photo
from refield.scene.errors import InputError
from refield.scene.images import opened, upright_rgb

SIDE = 160
"""pixels of a thumbnail's longer side"""
_CELL = ' style="text-align:left"'


def facts(title: str, rows: Iterable[tuple[str, object]]) -> str:
    """A heading and a line for each fact."""
    body = "".join(f"<tr><th{_CELL}>{escape(k)}</th><td{_CELL}>{escape(str(v))}</td></tr>" for k, v in rows)
    return f"<p><b>{escape(title)}</b></p><table>{body}</table>"


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """One row each."""
    top = "".join(f"<th{_CELL}>{escape(head)}</th>" for head in heads)
    body = "".join("<tr>" + "".join(f"<td{_CELL}>{escape(str(v))}</td>" for v in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def strip(pictures: Iterable[tuple[str, Image.Image | None]]) -> str:
    """Pictures side by side, each over its name; one that cannot be shown is named all the same."""
    return f'<div style="display:flex;flex-wrap:wrap;gap:8px">{"".join(_figure(*p) for p in pictures)}</div>'


def thumbnail(photo: Photo) -> Image.Image | None:
    """A photo as its file has it, small; None if it cannot be read."""
    try:
        with opened(photo.path) as image:
            image.draft("RGB", (2 * SIDE, 2 * SIDE))  # JPEGs are decoded at a part of their size
            small = upright_rgb(photo.path, image)
            small.thumbnail((SIDE, SIDE))
            return small
    except InputError:
        return None


def drawn(picture: Tensor) -> Image.Image:
    """A picture (H, W, 3) float in [0, 1], small."""
    small = Image.fromarray((picture.detach().cpu().nan_to_num(0).clamp(0, 1) * 255).byte().numpy())
    small.thumbnail((SIDE, SIDE))
    return small


def inked(image: Image.Image, masks: Iterable[tuple[Tensor, tuple[int, int, int]]]) -> Image.Image:
    """A thumbnail with masks (H, W) bool of the whole picture laid over it, each in its colour."""
    for mask, colour in masks:
        cover = Image.fromarray(mask.cpu().numpy() * np.uint8(140)).resize(image.size, Image.Resampling.BILINEAR)
        image = Image.composite(Image.new("RGB", image.size, colour), image, cover)
    return image


def _figure(name: str, image: Image.Image | None) -> str:
    shown = "<small>(no picture)</small>"
    if image is not None:
        buffer = io.BytesIO()
        image.save(buffer, "JPEG", quality=85)
        uri = f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"
        shown = f'<img src="{uri}" alt="{escape(name)}">'
    return f'<figure style="margin:0">{shown}<figcaption><small>{escape(name)}</small></figcaption></figure>'
