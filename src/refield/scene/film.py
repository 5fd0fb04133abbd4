"""The one film encoder: H.264 in an MP4 that browsers play, GIF, animated WebP. A film appears whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

from PIL import Image
from torch import Tensor

from refield.scene.errors import InputError
from refield.scene.files import umask

SUFFIXES = (".mp4", ".gif", ".webp")
_FASTEST = {".mp4": 240.0, ".gif": 50.0, ".webp": 240.0}  # players show a GIF that is faster slowly
_OURS = "made by refield"
_SOFTWARE = 0x0131  # EXIF
_LOSS = {"crf": "18", "preset": "medium"}  # of H.264; from 17 or 18 on the eye sees no loss


def is_film(path: Path) -> bool:
    """Whether a name is that of a film."""
    return path.suffix.lower() in SUFFIXES


def refuse_unless_possible(path: Path, fps: float) -> None:
    """Check, before any work, that a film of this name can be written.

    Raises:
        InputError: the encoder is missing, or the format knows no such rate.
    """
    kind = path.suffix.lower()
    if not 0 < fps <= _FASTEST[kind]:
        what = f"{fps:g} pictures a second cannot be had in a {kind} film"
        raise InputError(path, what, f"give an --fps above 0 and up to {_FASTEST[kind]:g}")
    if kind == ".mp4":
        _encoder(path)


def is_our_film(path: Path) -> bool:
    """Whether a file is a film that `film` wrote, and may be replaced."""
    try:
        if path.suffix.lower() == ".mp4":
            with _encoder(path).open(str(path)) as container:
                return bool(container.metadata.get("comment") == _OURS)
        with Image.open(path, formats=("GIF", "WEBP")) as image:
            comment = image.info.get("comment") or str(image.getexif().get(_SOFTWARE, "")).encode()
            return bool(comment == _OURS.encode())
    except (OSError, ValueError, SyntaxError):
        return False


@contextlib.contextmanager
def film(path: Path, fps: float, size: tuple[int, int]) -> Iterator[Callable[[Tensor], None]]:
    """Call it with one picture after the other, (H, W, 3) uint8 of width and height ``size``, even in an MP4.

    ``path`` is replaced at once when the block ends well, and stays as it was otherwise.

    Raises:
        InputError: see `refuse_unless_possible`.
    """
    refuse_unless_possible(path, fps)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=".part-", suffix=path.suffix.lower(), dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        with (_h264 if path.suffix.lower() == ".mp4" else _animated)(temporary, fps, size) as add:
            yield add
        temporary.chmod(0o666 & ~umask())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _encoder(path: Path) -> Any:
    try:
        import av
    except ImportError:
        what = "an .mp4 needs the extra 'video'"
        raise InputError(path, what, "pip install 'refield[video]', or name a .webp or .gif") from None
    return av


@contextlib.contextmanager
def _h264(path: Path, fps: float, size: tuple[int, int]) -> Iterator[Callable[[Tensor], None]]:
    av = _encoder(path)
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        container.metadata["comment"] = _OURS
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001), options=_LOSS)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"  # the only layout that all browsers play
        context = stream.codec_context
        # said and not left to be guessed by the size
        context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
        context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.IEC61966_2_1

        def add(picture: Tensor) -> None:
            frame = av.VideoFrame.from_ndarray(picture.contiguous().numpy(), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG)
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode(None))


@contextlib.contextmanager
def _animated(path: Path, fps: float, size: tuple[int, int]) -> Iterator[Callable[[Tensor], None]]:
    pictures: list[Image.Image] = []
    gif = path.suffix == ".gif"

    def add(picture: Tensor) -> None:
        image = Image.fromarray(picture.contiguous().numpy())
        pictures.append(image.quantize(256, Image.Quantize.MEDIANCUT) if gif else image)

    yield add
    unit = 10 if gif else 1  # milliseconds
    ends = [round(1000 / unit * (i + 1) / fps) * unit for i in range(len(pictures))]
    durations = [end - start for start, end in zip([0, *ends], ends)]
    more: dict[str, Any] = {"comment": _OURS.encode(), "optimize": False, "disposal": 1}
    if not gif:
        exif = Image.Exif()
        exif[_SOFTWARE] = _OURS
        more = {"exif": exif.tobytes(), "quality": 80, "method": 4}
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, **more)
