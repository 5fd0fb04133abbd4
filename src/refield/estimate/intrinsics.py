"""Which camera took a new photo: one of the old photos', one that its EXIF tells of, or one to be found out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

from refield.photos.landmarks import Landmarks
from refield.photos.lens import Lens
from refield.photos.taken import Taken
from refield.scene.camera import Camera
from refield.scene.capture import Capture

_ROUNDING = 1.5  # pixels that a side may be off where a picture was scaled down


@dataclass(frozen=True)
class Guess:
    """Intrinsics that a photo may have."""

    camera: Camera
    how: str
    """where they come from"""
    refine: bool = False
    """the focal length is only roughly known, and distortion not at all"""
    search: bool = False
    """the focal length is not known"""


def guesses(photo: Taken, capture: Capture, landmarks: Landmarks) -> list[Guess]:
    """What to try, the likeliest first; the last one supposes nothing of the old cameras."""
    old = Counter((f.camera, lens) for f, lens in zip(capture.frames, landmarks.lenses))
    out: list[Guess] = []
    for (camera, lens), _ in old.most_common():
        guess = _shared(photo, camera) if lens.may_be(photo.lens) else None
        if guess is not None and all(guess.camera != g.camera for g in out):
            out.append(guess)
    sure = any(lens.name and lens.name == photo.lens.name for _, lens in old)
    return out if out and sure else [*out, _own(photo)]


def _shared(photo: Taken, camera: Camera) -> Guess | None:
    """The old camera on the new photo, if the picture can be one of its own: as large, scaled, or turned."""
    width, height = photo.width, photo.height
    if (width, height) == (camera.width, camera.height):
        return Guess(camera, "that of the old photos")
    if _alike(width, height, camera.width, camera.height):
        return Guess(camera.scaled(width, height), "that of the old photos, scaled")
    if _alike(height, width, camera.width, camera.height):
        return Guess(_turned(camera.scaled(height, width)), "that of the old photos, turned", refine=True)
    return None


def _alike(width: int, height: int, other_width: int, other_height: int) -> bool:
    return abs(width - other_width * height / other_height) < _ROUNDING + width / other_width / 2


def _turned(camera: Camera) -> Camera:
    """Held upright in place of across, or the reverse; which way round is not known, so the centre is the middle."""
    width, height = camera.height, camera.width
    out = replace(camera, width=width, height=height, fx=camera.fy, fy=camera.fx, p1=0.0, p2=0.0)
    return replace(out, cx=width / 2, cy=height / 2)


def _own(photo: Taken) -> Guess:
    """A camera of its own, with square pixels and its centre in the middle."""
    lens: Lens = photo.lens
    known = lens.focal(photo.width, photo.height)
    focal = lens.guess(photo.width, photo.height)
    camera = Camera(photo.width, photo.height, focal, focal, photo.width / 2, photo.height / 2)
    how = "its own, by EXIF" if known else "its own, from the matches"
    return Guess(camera, how, refine=True, search=known is None)
