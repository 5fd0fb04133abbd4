"""A workspace's first field beside the photos that were left out of its fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from record import Row
from torch import Tensor

from fields.floaters import Floaters, Points, floaters_before, pooled, surfaces
from fields.measures import band_energy, decibels, halves, lit, log_gains, mean_square
from refield.field.radiance import Field
from refield.field.render import render_camera
from refield.scene.capture import Frame
from refield.scene.errors import InputError
from refield.scene.files import read_json
from refield.scene.images import scaled_image
from refield.workspace import Workspace


@dataclass(frozen=True)
class View:
    """One photo that was left out, and its render."""

    name: str
    photo: Tensor
    """(H, W, 3) float32 in [0, 1]"""
    render: Tensor
    """the same shape, as rendered"""
    gains: Tensor
    """(3,) float64 logarithms, the photo's exposure as its left half tells it"""
    floaters: Floaters

    @property
    def lit(self) -> Tensor:
        """The render at the photo's exposure."""
        return lit(self.render, self.gains)

    def error(self, fitted: bool) -> float:
        """Mean square over the right half, of which the exposure knows nothing."""
        return mean_square(halves(self.lit if fitted else self.render)[1], halves(self.photo)[1])

    def energies(self) -> tuple[float, float]:
        """Of the render, at the photo's exposure, and of the photo; right halves."""
        return band_energy(halves(self.lit)[1]), band_energy(halves(self.photo)[1])

    def row(self) -> Row:
        return {
            "photo": self.name,
            "heldout": decibels(self.error(True)),
            "no exposure fitted": decibels(self.error(False)),
            "stops": [g / math.log(2) for g in self.gains.tolist()],
            "sharpness": _ratio(*self.energies()),
            "floaters": self.floaters.share,
        }


def judged(work: Path, longest: int) -> tuple[Row, list[View]]:
    """A workspace's figures, and what they are of. ``longest``: larger photos are judged at so many pixels a side.

    Raises:
        InputError: it is no workspace, or nothing was left out of its fit.
    """
    workspace = Workspace.open(work)
    capture, field = workspace.capture(), workspace.field()
    if not capture.held_out:
        raise InputError(work, "no photo was left out of its fit", "give a capture of more photos")
    field.eval()
    points = surfaces(field, capture.train)
    views = [_view(field, frame, points, longest) for frame in capture.held_out]
    told = read_json(work / "field" / "field.json").get("held_out_psnr")
    return {"photos": len(capture.frames), "left out": len(views), "told by the fit": told} | figures(views), views


def _view(field: Field, frame: Frame, points: Points, longest: int) -> View:
    camera = frame.camera.shrunk(min(1.0, longest / max(frame.camera.width, frame.camera.height)))
    photo = scaled_image(frame, camera)
    render = render_camera(field, camera, frame.world_from_cam).rgb.clamp(0, 1)
    gains = log_gains(halves(render)[0], halves(photo)[0])
    return View(frame.name, photo, render, gains, floaters_before(field, frame, points))


def figures(views: Sequence[View]) -> Row:
    """Over all views: PSNRs in dB, means over photos or pooled; sharpness; floaters, parts of pixels and of light."""
    fitted, plain = ([v.error(how) for v in views] for how in (True, False))
    energies = torch.tensor([v.energies() for v in views], dtype=torch.float64).sum(0)
    air = pooled([v.floaters for v in views])
    return {
        "heldout": sum(map(decibels, fitted)) / len(views),
        "heldout pooled": decibels(sum(fitted) / len(views)),
        "no exposure fitted": sum(map(decibels, plain)) / len(views),
        "sharpness": _ratio(*energies.tolist()),
        "floaters": air.share,
        "floaters' light": air.light,
        "floaters known": air.known,
        "views": [v.row() for v in views],
    }


def _ratio(render: float, photo: float) -> float:
    return math.sqrt(render / photo) if photo > 0 else math.nan
