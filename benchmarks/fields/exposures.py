"""A copy of photographs whose exposure and white balance were put off at random, each by its own amount."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from refield.photos.sources import find_sources
from refield.scene.errors import InputError
from refield.scene.images import opened
from refield.scene.load import is_posed, load_capture
from refield.scene.srgb import to_linear, to_srgb

STOPS, CAST = 0.5, 0.05
"""the most by which a photo's exposure is off, stops, and the gains of its red and blue"""
_QUALITY = 95  # of JPEG


def put_off(data: Path, out: Path, seed: int) -> dict[str, list[float]]:
    """Copy a folder as `refield train` takes it to the new folder ``out``, its photos put off; each one's three gains.

    Pixels alone change: names, EXIF, and whatever else lies there stay. What becomes too bright is clipped.

    Raises:
        InputError: it cannot be read, or holds videos or photos in other places.
    """
    data = (data.parent if data.is_file() else data).resolve()
    photos = photos_of(data)
    shutil.rmtree(out, ignore_errors=True)
    told = {}
    for path in sorted(p for p in data.rglob("*") if p.is_file() and p not in photos):
        to = out / path.relative_to(data)
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, to)
    for i, path in enumerate(photos):
        name = path.relative_to(data).as_posix()
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        told[name] = gains_of(seed, i)
        _rewritten(path, out / name, told[name])
    return told


def photos_of(data: Path) -> list[Path]:
    """The photos of the capture in a folder whose path is resolved; in their order.

    Raises:
        InputError: as `put_off`.
    """
    if is_posed(data):
        paths = [frame.path.resolve() for frame in load_capture(data).frames]
    else:
        sources = find_sources(data)
        other = next((s for s in sources if s.kind != "picture"), None)
        if other is not None:
            raise InputError(other.path, f"is of the kind {other.kind}", "give JPEGs or PNGs to put exposures on")
        paths = [s.path.resolve() for s in sources]
    outside = next((p for p in paths if not p.is_relative_to(data)), None)
    if outside is not None:
        raise InputError(outside, f"is not in {data}", "give a folder that holds its photos")
    return paths


def gains_of(seed: int, index: int) -> list[float]:
    """Linear gains of a photo's red, green and blue."""
    draw = np.random.default_rng([seed, index]).uniform(-1, 1, 3)
    exposure = 2.0 ** (STOPS * draw[0])
    return [exposure * (1 + CAST * draw[1]), exposure, exposure * (1 + CAST * draw[2])]


def _rewritten(path: Path, out: Path, gains: Sequence[float]) -> None:
    """The photo in its own format, turned as it was."""
    with opened(path) as image:
        kept = {k: image.info[k] for k in ("exif", "icc_profile") if image.info.get(k)}
        alpha = image.getchannel("A") if "A" in image.getbands() else None
        pixels, form = np.array(image.convert("RGB")), image.format
    levels = to_linear(np.arange(256, dtype=np.float32) / np.float32(255))
    for c, gain in enumerate(gains):
        table = np.rint(to_srgb(levels * np.float32(gain)) * 255).astype(np.uint8)
        pixels[..., c] = table[pixels[..., c]]
    picture = Image.fromarray(pixels)
    if alpha is not None:
        picture.putalpha(alpha)
    picture.save(out, form, **kept, **({"quality": _QUALITY, "subsampling": 0} if form == "JPEG" else {}))
