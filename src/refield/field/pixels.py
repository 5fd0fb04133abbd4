"""All pixels of a set of posed photos, and the ray of any of them. Photos stay uint8."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from refield.field.kernels.reference import offsets_of
from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays
from refield.scene.exposure import vignetting_basis
from refield.scene.images import frame_image

DIRECTIONS_MOST = 1 << 29  # bytes; camera-space directions are kept for every pixel of every distinct camera up to here

_TABLE_MOST = 64  # directions in the tables for each pixel of the bank
_ASKED = 1 << 20  # pixels, of which more say nothing new about how bright they are
_DIMMEST = 0.1  # 8 bits tell few colours of what is dimmer, and a fit would hardly begin
_DIM = 0.33  # rms of the colours; of the worlds and photographs that the fit was made on, the dimmest have 0.36


class Pixels(Protocol):
    """P pixels of F photos, wherever they are kept; see `PixelBank`."""

    frames: tuple[Frame, ...]
    starts: Tensor
    """(F + 1,) int64: frame i owns pixels ``starts[i] : starts[i + 1]``"""

    def __len__(self) -> int: ...
    def frame_of(self, pixels: Tensor) -> Tensor: ...
    def place_of(self, pixels: Tensor) -> Tensor: ...
    def rays(self, pixels: Tensor) -> Rays: ...
    def camera_directions(self, pixels: Tensor, owner: Tensor) -> Tensor: ...
    def vignetting_basis(self, pixels: Tensor, owner: Tensor) -> Tensor: ...
    def colours(self, pixels: Tensor) -> Tensor: ...


class PixelBank:
    """P pixels of F photos in one row: colours uint8, rays made on demand."""

    def __init__(
        self,
        frames: Sequence[Frame],
        images: Sequence[Tensor] | None = None,
        most: int | None = None,
        masks: Sequence[Tensor | None] | None = None,
    ) -> None:
        """Photos are read one by one.

        ``masks``: per photo, (H, W) bool, the pixels that are kept; None keeps all of them. Of more than ``most``
        pixels so many are kept, drawn from every photo alike.
        """
        if not frames:
            raise ValueError("a pixel bank needs at least one frame")
        self.frames = tuple(frames)
        parts = _kept(frames, most, [None] * len(frames) if masks is None else masks)
        counts = torch.tensor([f.camera.width * f.camera.height for f in frames])
        self.places: Tensor | None = None
        """(P,) int32: each pixel's place in its photo, row by row; None where every pixel is kept"""
        if parts is not None:
            self.places = torch.cat([p.int() for p in parts])
            counts = torch.tensor([len(p) for p in parts])
        self.starts = offsets_of(counts)
        """(F + 1,) int64: frame i owns pixels ``starts[i] : starts[i + 1]``, row by row"""
        self.rgb = torch.empty(int(counts.sum()), 3, dtype=torch.uint8)
        """(P, 3) uint8"""
        for i, frame in enumerate(frames):
            image = (frame_image(frame) if images is None else images[i]).reshape(-1, 3)
            self.rgb[self.starts[i] : self.starts[i + 1]] = image if parts is None else image[parts[i]]
        self._rotations = torch.stack([f.world_from_cam[:3, :3] for f in frames]).float()
        self._centres = torch.stack([f.centre for f in frames]).float()
        self._cameras = list(dict.fromkeys(f.camera for f in frames))
        self._camera_of = torch.tensor([self._cameras.index(f.camera) for f in frames])
        self._sizes = torch.tensor([(c.width, c.height) for c in self._cameras])
        self._tables: dict[Camera, Tensor] = {}
        distinct = sum(c.width * c.height for c in self._cameras)
        # a few pixels of large photos, as those that judge a fit, are not worth the others' directions
        self._tabulate = distinct * 12 <= DIRECTIONS_MOST and distinct <= _TABLE_MOST * len(self)

    def __len__(self) -> int:
        return int(self.starts[-1])

    @property
    def brightness(self) -> float:
        """The root mean square of its colours over that of what is barely dim, 0.1 to 1; of some of the pixels, spread
        over all, but for those that are black: of cut-out pictures nothing is there."""
        some = self.rgb[:: max(len(self) // _ASKED, 1) | 1].float() / 255
        lit = some[some.amax(-1) > 0]
        return min(max(float(lit.square().mean()) ** 0.5 / _DIM, _DIMMEST), 1.0) if len(lit) else 1.0

    def frame_of(self, pixels: Tensor) -> Tensor:
        """Index of the frame that owns each pixel, (B,) -> (B,)."""
        return torch.searchsorted(self.starts, pixels, right=True) - 1

    def place_of(self, pixels: Tensor) -> Tensor:
        """Each pixel's place in its photo, row by row, (B,) -> (B,) int64."""
        return self._place_of(pixels, self.frame_of(pixels))

    def _place_of(self, pixels: Tensor, owner: Tensor) -> Tensor:
        return pixels - self.starts[owner] if self.places is None else self.places[pixels].long()

    def rays(self, pixels: Tensor) -> Rays:
        """World rays through pixel centres, (B,) -> Rays of B."""
        owner = self.frame_of(pixels)
        world = (self._rotations[owner] @ self.camera_directions(pixels, owner)[:, :, None])[:, :, 0]
        return Rays(self._centres[owner], world)

    def camera_directions(self, pixels: Tensor, owner: Tensor) -> Tensor:
        """Unit directions in camera axes through the centres of pixels (B,) of photos ``owner`` (B,), (B, 3)."""
        local = self._place_of(pixels, owner)
        d = torch.empty(len(pixels), 3)
        for k, camera in enumerate(self._cameras):
            mine = slice(None) if len(self._cameras) == 1 else (self._camera_of[owner] == k).nonzero()[:, 0]
            d[mine] = self._directions(camera, local[mine])
        return d

    def vignetting_basis(self, pixels: Tensor, owner: Tensor) -> Tensor:
        """`refield.scene.exposure.vignetting_basis` at pixels (B,) of photos ``owner`` (B,), (B, 3)."""
        local, size = self._place_of(pixels, owner), self._sizes[self._camera_of[owner]]
        width = size[:, 0]
        return vignetting_basis(torch.stack([local % width, local // width], -1) + 0.5, size)

    def colours(self, pixels: Tensor) -> Tensor:
        """(B,) -> (B, 3) float32 in [0, 1]."""
        return self.rgb[pixels].float() / 255

    def _directions(self, camera: Camera, local: Tensor) -> Tensor:
        if not self._tabulate:
            v, u = local // camera.width, local % camera.width
            return camera.unproject(torch.stack([u, v], -1).double() + 0.5).float()
        if camera not in self._tables:
            self._tables[camera] = camera.unproject(camera.pixel_centres()).float()
        return self._tables[camera][local]


def _kept(frames: Sequence[Frame], most: int | None, masks: Sequence[Tensor | None]) -> list[Tensor] | None:
    """Places of the pixels that are kept, int64 for each photo; None if that is all of them.

    Raises ValueError if the masks are not the photos' in number and size.
    """
    sizes = [(f.camera.height, f.camera.width) for f in frames]
    if len(masks) != len(frames) or any(m is not None and tuple(m.shape) != s for m, s in zip(masks, sizes)):
        raise ValueError("each photo has one mask, of its own size, or None")
    counts = [h * w if m is None else int(m.sum()) for m, (h, w) in zip(masks, sizes)]
    share = 1.0 if most is None else most / max(sum(counts), 1)
    if share >= 1 and all(m is None for m in masks):
        return None
    g = torch.Generator().manual_seed(0)
    parts = []
    for mask, n in zip(masks, counts):
        chosen = torch.arange(n) if share >= 1 or not n else _some(n, max(int(n * share), 1), g)
        parts.append(chosen if mask is None else mask.reshape(-1).nonzero()[:, 0][chosen])
    return parts


def _some(count: int, wanted: int, g: torch.Generator) -> Tensor:
    """``wanted`` of ``count`` indices, in order."""
    return torch.randperm(count, generator=g)[:wanted].sort().values
