"""The one image decoder: EXIF orientation applied, modes on an allow-list, sizes limited before decoding.

Transparent pictures are composited on black, which is what volume rendering shows where nothing is.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import ExifTags, Image, ImageOps, PngImagePlugin
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import Photo
from refield.scene.errors import InputError, expect
from refield.scene.files import AnyPath, as_path, write_bytes

MAX_PIXELS = 64_000_000
"""A 48-megapixel phone photo passes; what is larger is more likely a bomb or a mistake."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm")
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")  # nothing that starts another program (EPS)
_DIRECT = ("L", "RGB", "1")
_WITH_ALPHA = ("RGBA", "LA", "PA", "P")  # a palette may carry transparency
_MARK = ("Software", "refield")  # in every PNG we write, so that we replace no other
_SWAPPED = (5, 6, 7, 8)  # EXIF orientations that exchange width and height


@contextmanager
def opened(path: Path, max_pixels: int = MAX_PIXELS, formats: Sequence[str] = FORMATS) -> Iterator[Image.Image]:
    """The image's header, size checked; every failure in the block becomes an InputError naming the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own size warning; ours is an error below
            with Image.open(path, formats=tuple(formats)) as image:
                width, height = image.size
                if width * height > max_pixels:
                    what = f"{width}x{height} pixels are over the limit of {max_pixels / 1e6:.0f} megapixels"
                    raise InputError(path, what, "scale the image down")
                yield image
    except FileNotFoundError:
        raise InputError(path, "there is no such image", "check the path") from None
    except Image.DecompressionBombError:
        raise InputError(path, "claims a gigantic size", "check the file") from None
    except Image.UnidentifiedImageError:
        known = ", ".join(formats)
        raise InputError(path, "is not an image that can be read", f"give one of {known}") from None
    except (OSError, ValueError, SyntaxError, EOFError) as error:  # truncated data arrives as any of these
        raise InputError(path, f"cannot be decoded ({error})", "replace the file or leave it out") from None


def is_turned(image: Image.Image) -> bool:
    """Whether EXIF says that the pixels are not as the picture stands upright."""
    return _orientation(image) != 1


def _orientation(image: Image.Image) -> int:
    plain = isinstance(image, PngImagePlugin.PngImageFile) and _ends_with_pixels(Path(os.fsdecode(image.filename)))
    # Pillow decodes all of a PNG to find what may follow the pixels
    exif = Image.Image.getexif(image) if plain else image.getexif()
    return int(exif.get(ExifTags.Base.Orientation, 1) or 1)


def _ends_with_pixels(png: Path) -> bool:
    """Whether nothing that could say how to turn a PNG follows its pixels."""
    with png.open("rb") as file:
        file.seek(8)
        begun = False
        while len(head := file.read(8)) == 8:
            length, kind = int.from_bytes(head[:4]), head[4:]
            if kind == b"IEND":
                return True
            if begun and kind != b"IDAT":
                return False
            begun |= kind == b"IDAT"
            file.seek(length + 4, io.SEEK_CUR)
    return False


def read_size(path: Path, *, max_pixels: int = MAX_PIXELS) -> tuple[int, int]:
    """(width, height) from the header alone, as the picture stands upright.

    Raises:
        InputError: missing, not an image, or too large.
    """
    with opened(path, max_pixels) as image:
        width, height = image.size
        return (height, width) if _orientation(image) in _SWAPPED else (width, height)


def read_image(path: Path, *, max_pixels: int = MAX_PIXELS, background: tuple[int, int, int] = (0, 0, 0)) -> Tensor:
    """An image as uint8 (H, W, 3), upright; what is transparent shows ``background``.

    Raises:
        InputError: missing, truncated, too large, or of a mode whose colours would be a guess (CMYK,
            16-bit grey).
    """
    with opened(path, max_pixels) as image:
        return torch.from_numpy(np.array(upright_rgb(path, image, background)))


def upright_rgb(path: Path, image: Image.Image, background: tuple[int, int, int] = (0, 0, 0)) -> Image.Image:
    """An `opened` image as RGB, turned as its EXIF says; raises as `read_image`."""
    mode = image.mode
    if mode not in _DIRECT + _WITH_ALPHA:
        what = f"has the pixel mode {mode}, whose colours would be a guess"
        raise InputError(path, what, "save it as 8-bit RGB")
    upright = ImageOps.exif_transpose(image)
    if mode in _WITH_ALPHA:
        upright = upright.convert("RGBA")
        upright = Image.alpha_composite(Image.new("RGBA", upright.size, (*background, 255)), upright)
    return upright.convert("RGB")


def read_mask(path: Path, *, max_pixels: int = MAX_PIXELS) -> Tensor:
    """A mask as bool (H, W): true where brighter than 127, or where 1 if no pixel is brighter than 1.

    Raises:
        InputError: missing, truncated, too large, or not an 8-bit image.
    """
    with opened(path, max_pixels) as image:
        if image.mode not in _DIRECT + _WITH_ALPHA:
            raise InputError(path, f"has the pixel mode {image.mode}", "save the mask as 8-bit grey")
        upright = ImageOps.exif_transpose(image)
        if upright.mode == "1":
            return torch.from_numpy(np.array(upright))
        grey = np.array(upright.convert("RGB")).max(-1)
        return torch.from_numpy(grey > (127 if grey.max() > 1 else 0))


def write_image(path: AnyPath, image: Tensor) -> None:
    """Write a PNG at once: uint8 or float [0, 1] (H, W, 3) or (H, W), or a bool (H, W) mask in one bit a pixel.

    Raises:
        ValueError: it has another shape, or holds values that are not finite.
    """
    path, shown = as_path(path, "the picture's file"), "a tensor (H, W, 3) or (H, W), such as the rgb of a rendering"
    expect("the picture", image, Tensor, shown)
    if image.dim() != 2 and (image.dim() != 3 or image.shape[-1] != 3):
        raise ValueError(f"{path}: a picture of the shape {tuple(image.shape)} cannot be written; give {shown}")
    if image.is_floating_point() and not bool(image.isfinite().all()):
        raise ValueError(f"{path}: the picture holds values that are not finite")
    write_bytes(path, png(image), durable=False)


def png(image: Tensor) -> bytes:
    """A picture as `write_image` writes it."""
    image = image.detach().cpu()
    if image.is_floating_point():
        image = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    buffer = io.BytesIO()
    mark = PngImagePlugin.PngInfo()
    mark.add_text(*_MARK)
    Image.fromarray(image.numpy()).save(buffer, format="PNG", pnginfo=mark)
    return buffer.getvalue()


def is_ours(path: Path) -> bool:
    """Whether a file is a PNG that `write_image` wrote, and may be replaced."""
    try:
        with Image.open(path, formats=("PNG",)) as image:
            return image.info.get(_MARK[0]) == _MARK[1]
    except (OSError, ValueError, SyntaxError):
        return False


def check_decodes(path: Path) -> None:
    """Decode an image for the errors alone, JPEGs at an eighth of their size.

    Raises:
        InputError: as `read_image`.
    """
    with opened(path, MAX_PIXELS) as image:
        if image.mode not in _DIRECT + _WITH_ALPHA:
            raise InputError(path, f"has the pixel mode {image.mode}", "save it as 8-bit RGB")
        image.draft(None, (max(image.width // 8, 1), max(image.height // 8, 1)))
        image.load()


def frame_image(photo: Photo) -> Tensor:
    """The pixels of a photo at its camera's size, uint8 (H, W, 3); those of a larger file are averaged. They are as of
    neutral exposure, if the photo's own is known.

    Raises:
        InputError: as `read_image`, or if the file's size is not what is known of it.
    """
    if photo.made is not None and not photo.path.exists():
        photo.made(photo.path)
    image = read_image(photo.path)
    height, width = image.shape[:2]
    camera = photo.camera
    wide, high = photo.file_size or (camera.width, camera.height)
    if (width, height) != (wide, high):
        expected = f"its camera says {wide}x{high}"
        raise InputError(photo.path, f"has {width}x{height} pixels, {expected}", "correct w and h, or the image")
    if photo.file_size is not None:
        small = cv2.resize(image.numpy(), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        image = torch.from_numpy(small)
    return image if photo.exposure is None else photo.exposure.neutral(image, camera)


def scaled_image(photo: Photo, camera: Camera) -> Tensor:
    """The pixels of a photo as ``camera``, its own scaled down, would take it, (H, W, 3) float32 in [0, 1].

    Raises:
        InputError: as `frame_image`.
    """
    image = frame_image(photo).numpy()
    if image.shape[:2] != (camera.height, camera.width):
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(image.astype(np.float32) / 255)
