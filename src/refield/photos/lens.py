"""What a photo's EXIF says of the lens: which camera it was, and its focal length."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags, Image

_FULL_FRAME_DIAGONAL = math.hypot(36, 24)  # mm; "35 mm equivalent" is by the diagonal (CIPA DCG-001)
_FALLBACK = 1.2  # focal length over the longer side, of a usual phone


@dataclass(frozen=True)
class Lens:
    """A camera at one zoom. Unknown: an empty name and no focal length."""

    name: str = ""
    """maker, model and lens"""
    focal_35mm: float | None = None
    """focal length in mm, as of full-frame film"""

    def focal(self, width: int, height: int) -> float | None:
        """In pixels of the whole picture at this size; None if not known."""
        if self.focal_35mm is None:
            return None
        return self.focal_35mm * math.hypot(width, height) / _FULL_FRAME_DIAGONAL

    def guess(self, width: int, height: int) -> float:
        """As `focal`; a usual phone's where it is not known."""
        return self.focal(width, height) or _FALLBACK * max(width, height)

    def may_be(self, other: Lens) -> bool:
        """Whether two photos can be of one camera at one zoom; what is unknown can be anything."""
        if self.name and other.name and self.name != other.name:
            return False
        a, b = self.focal_35mm, other.focal_35mm
        return a is None or b is None or abs(a - b) < 0.02 * a


def read_lens(image: Image.Image) -> Lens:
    """The lens of an opened image; what EXIF lacks or garbles is unknown."""
    try:
        exif = image.getexif()
        details = exif.get_ifd(ExifTags.IFD.Exif)
    except (OSError, ValueError, SyntaxError, KeyError, TypeError):  # whatever a stranger's EXIF holds
        return Lens()
    parts = [exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model), details.get(ExifTags.Base.LensModel)]
    name = " ".join(_text(p) for p in parts if _text(p))
    focal = _number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    return Lens(name[:120], focal if focal is not None and 5 <= focal <= 1000 else None)


def _text(value: Any) -> str:
    return "".join(c for c in str(value or "") if c.isprintable()).strip()


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None
