"""One visit's photos: Photo → Frame → Capture, and the rays of a frame.

A `Photo` is an image with intrinsics; a `Frame` also knows where it was taken. Two types, so that an unplaced
photo cannot be used as a view by mistake. World units and axes are the capture's own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, Self

import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.errors import InputError, expect
from refield.scene.exposure import Exposure

_MOST_SHOWN = 6  # photos or cameras in a notebook


class Made(Protocol):
    """How a photo that is not there yet comes about: from one that shows how things were."""

    @property
    def before(self) -> Any:
        """The Field of what it shows."""

    def __call__(self, path: Path) -> None:
        """Write it."""

    def near(self, rays: Rays) -> Tensor:
        """Which rays from its place pass by something that has another shape since, (N,) bool."""

    def at(self, camera: Camera, was: Tensor, now: Tensor) -> Tensor:
        """The photo (H, W, 3) float32 in [0, 1] as its ``camera``, scaled down, would have taken it; nothing is
        written. ``was`` and ``now``, of the same shape, are what the fields of then and now show there; as in a photo,
        not all is so."""


@dataclass(frozen=True, repr=False)
class Photo:
    """An image file and the camera that took it; where it was taken is not known."""

    path: Path
    camera: Camera
    name: str
    """How the file calls it (the ``file_path`` of a transforms.json); unique within a capture."""
    made: Made | None = field(default=None, kw_only=True, repr=False, compare=False)
    """Writes the file when its pixels are first asked for; None for a file that is there."""
    exposure: Exposure | None = field(default=None, kw_only=True)
    """How it was exposed, if that is known: its pixels are then read as those of a photo of neutral exposure."""
    file_size: tuple[int, int] | None = field(default=None, kw_only=True)
    """Width and height of the file, where ``camera`` takes a smaller picture; None: the camera's."""

    def shrunk(self, part: float) -> Self:
        """The same photo, to be read at a part of its size."""
        size = self.file_size or (self.camera.width, self.camera.height)
        return self if part == 1 else replace(self, camera=self.camera.shrunk(part), file_size=size)

    def whole(self) -> Self:
        """The same photo, to be read at the size of its file."""
        if self.file_size is None:
            return self
        return replace(self, camera=self.camera.scaled(*self.file_size), file_size=None)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.camera.width} x {self.camera.height})"


@dataclass(frozen=True, repr=False)
class Frame(Photo):
    """A photo with its pose."""

    world_from_cam: Tensor
    """(4, 4) float64, OpenCV camera axes."""

    @property
    def centre(self) -> Tensor:
        """Camera centre in the world, (3,) float64."""
        return self.world_from_cam[:3, 3]

    def __repr__(self) -> str:
        at = ", ".join(f"{v:.4g}" for v in self.centre.tolist())
        return f"Frame({self.name!r}, {self.camera.width} x {self.camera.height}, at ({at}))"


@dataclass(frozen=True)
class Rays:
    """N rays: ``origins`` and unit ``directions``, both (N, 3) float32, world."""

    origins: Tensor
    directions: Tensor

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Rays:
        return Rays(self.origins[index], self.directions[index])


def camera_rays(camera: Camera, world_from_cam: Tensor, pixels: Tensor | None = None) -> Rays:
    """World rays through ``pixels`` (N, 2), or through every pixel centre row by row."""
    pixels = camera.pixel_centres() if pixels is None else pixels
    d = camera.unproject(pixels.double()) @ world_from_cam[:3, :3].T
    return Rays(world_from_cam[:3, 3].float().expand(len(d), 3).contiguous(), d.float().contiguous())


@dataclass(frozen=True, repr=False)
class Capture:
    """Posed photos of one state of the scene, and what structure from motion knows of it."""

    frames: tuple[Frame, ...]
    points: Tensor = field(default_factory=lambda: torch.zeros(0, 3))
    """(P, 3) float32 SfM points in the world; may be empty."""
    held_out_every: int = 10
    """Every so-many-th frame is kept from training to measure quality; 0 holds none out."""

    @property
    def held_out(self) -> tuple[Frame, ...]:
        k = self.held_out_every
        return tuple(f for i, f in enumerate(self.frames) if k and i % k == k // 2)

    @property
    def train(self) -> tuple[Frame, ...]:
        k = self.held_out_every
        return tuple(f for i, f in enumerate(self.frames) if not (k and i % k == k // 2))

    def __repr__(self) -> str:
        return f"Capture({', '.join(f'{value} {name}' for name, value in self._facts().items())})"

    def _facts(self) -> dict[str, int]:
        return {"photos": len(self.frames), "held out": len(self.held_out), "points": len(self.points)}

    def _repr_html_(self) -> str:
        from refield.scene import notebook

        cameras = dict.fromkeys(frame.camera for frame in self.frames)
        sizes = [f"{c.width} x {c.height}, focal length {c.fx:.4g} px" for c in cameras]
        more = [f"and {len(sizes) - _MOST_SHOWN} more"] if len(sizes) > _MOST_SHOWN else []
        rows = [*self._facts().items(), *(("camera", told) for told in sizes[:_MOST_SHOWN] + more)]
        there = [frame for frame in self.frames if frame.made is None]
        some = there[:: max(-(-len(there) // _MOST_SHOWN), 1)]
        return notebook.facts("Capture", rows) + notebook.strip((f.name, notebook.thumbnail(f)) for f in some)


def check_capture(capture: Capture) -> None:
    """Check a caller's argument. Raises TypeError: it is no capture."""
    made = "as refield.load_capture makes one, or the .capture of what refield.capture_from_photos gives"
    expect("the capture", capture, Capture, f"a Capture, {made}")


def check_frames(frames: Sequence[Frame]) -> None:
    """Check a caller's argument.

    Raises:
        TypeError: it is no list of frames.
        InputError: there is none, or several have one name.
    """
    give = "a list of frames, as refield.load_new_photos makes one, or the .frame of each placed photo"
    expect("what is given as frames", frames, (list, tuple), give)
    for i, frame in enumerate(frames):
        expect(f"frame {i}", frame, Frame, give)
    names = [frame.name for frame in frames]
    twice = next((name for name in names if names.count(name) > 1), None)
    if not names:
        raise InputError("the new photos", "there are none", "give one or more, 4 is a good number")
    if twice is not None:
        raise InputError("the new photos", f"several are called {twice!r}", "give each a name of its own")


def centres(frames: Iterable[Frame]) -> Tensor:
    """Camera centres (F, 3) float64."""
    return torch.stack([f.centre for f in frames])
