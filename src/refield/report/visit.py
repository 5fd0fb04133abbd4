"""What a visit's report holds, and the same as JSON and as one sentence."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

import torch
from torch import Tensor

from refield.scene.capture import Frame
from refield.scene.change import ObjectChange, PlacedPhoto, SceneChange
from refield.scene.pose import rotation_log, skew, transform
from refield.scene.world import World

_CENTRE = 1 / math.sqrt(24)  # of a cell: of the mean of two that lie anywhere in one
_VERSIONS_OF = ("refield", "torch", "numpy", "numba", "opencv-python-headless", "pycolmap")


def versions() -> dict[str, str]:
    """Python's and the main packages' versions; a package that is not installed is left out."""
    found = {"python": platform.python_version()}
    for name in _VERSIONS_OF:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


@dataclass(frozen=True)
class Comparison:
    """One view: the old field's render, the photograph, the updated field's render. Pictures are (H, W, 3),
    uint8 or float in [0, 1]; what is not known is None and is left out of the page."""

    name: str
    photo: Tensor | None
    before: Tensor | None = None
    after: Tensor | None = None
    mask_in: Tensor | None = None
    """(H, W) bool: changed pixels that show what is there now"""
    mask_out: Tensor | None = None
    """(H, W) bool: changed pixels where something used to be"""
    unclear: Tensor | None = None
    """(H, W) bool: changed pixels that are not understood"""
    frame: Frame | None = None
    """where it was taken, so that objects are numbered in it; None: they are not"""
    depth_before: Tensor | None = None
    """(H, W) of ``before``, along the rays, in world units; inf where no surface is"""
    depth_after: Tensor | None = None
    """likewise of ``after``"""

    @property
    def marked(self) -> bool:
        """Whether any mask is known."""
        return any(m is not None for m in (self.mask_in, self.mask_out, self.unclear))


def _now() -> datetime:
    return datetime.now(UTC)


@dataclass(frozen=True)
class VisitReport:
    """Everything the page shows. Only `title` and `change` are needed."""

    title: str
    """for example the workspace's name and the visit's number"""
    change: SceneChange
    photos: tuple[Comparison, ...] = ()
    """the new photos, used and rejected, under the names of ``change.photos``"""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """per stage, in the order in which they ran"""
    evaluation: Mapping[str, Any] | None = None
    """``refield.evaluate.Report.to_dict()``"""
    evaluation_views: tuple[Comparison, ...] = ()
    """the evaluation's views; ``photo`` is the truth"""
    facts: Mapping[str, str | int | float] = field(default_factory=dict)
    """further numbers worth a line each, such as the field's PSNR on held-out frames"""
    warnings: tuple[str, ...] = ()
    """what the user should know"""
    world: World | None = None
    """how large the scene is, and a unit; lengths are then told as a part of the scene, and in metres"""
    versions: Mapping[str, str] = field(default_factory=versions)
    """of Python and the packages"""
    number: int | None = None
    """the visit's, from 1; the page then lies in a workspace, with ``change.json`` beside it and its neighbours'
    pages next to its folder, and links to them"""
    made: datetime = field(default_factory=_now)
    """when, with its time zone"""
    old_frames: tuple[Frame, ...] = ()
    """of the old photos: where they were taken, for the plan"""


def turn(new_from_old: Tensor) -> tuple[float, list[float]]:
    """The rotation of a pose change: angle in degrees [0, 180] and unit axis (0, 0, 0 for no turn)."""
    phi = rotation_log(new_from_old[:3, :3].double())
    angle = float(phi.norm())
    return math.degrees(angle), (phi / angle).tolist() if angle > 1e-9 else [0.0, 0.0, 0.0]


def object_shift(change: ObjectChange) -> list[float] | None:
    """`ObjectChange.shift` as plain numbers."""
    return None if change.shift is None else change.shift.tolist()


def uncertainty(change: ObjectChange) -> tuple[float, float] | None:
    """Standard deviations of a pose change: of the centre's shift (world units) and of the turn (degrees).

    Each is the root of the summed variances along the three axes. How far the centre of a thing that turned went
    depends on where in it the centre is, and that is known no better than the grid is fine: each of two opposite sides
    may lie anywhere in a cell.
    """
    if change.covariance is None or change.new_from_old is None:
        return None
    cov = change.covariance.double()
    centre = transform(change.new_from_old.double(), change.centre)
    lever = torch.cat([torch.eye(3, dtype=cov.dtype), -skew(centre)], 1)  # d centre / d twist
    turned = change.new_from_old[:3, :3].double() - torch.eye(3, dtype=cov.dtype)  # d shift / d centre
    where = turned @ torch.diag((_CENTRE * change.grid.cell.double()).square()) @ turned.T
    spread = float(((lever @ cov @ lever.T).trace().clamp_min(0) + where.trace()).sqrt())
    return spread, math.degrees(float(cov[3:, 3:].trace().clamp_min(0).sqrt()))


def summary(change: SceneChange) -> str:
    """One sentence: "2 objects changed: 1 moved, 1 removed, seen in 4 new photos (1 rejected)."""
    used = len(change.frames)
    rejected = len(change.photos) - used
    photos = f"{used} new photo{'' if used == 1 else 's'}" + (f" ({rejected} rejected)" if rejected else "")
    if not change.objects:
        what = "Something changed that is not understood" if change.unexplained else "Nothing changed"
        return f"{what}; seen in {photos}."
    n = len(change.objects)
    how = "by hand" if change.by_hand else f"seen in {photos}"
    return f"{n} object{'' if n == 1 else 's'} changed: {change.kinds}; {how}."


def visit_report_dict(report: VisitReport) -> dict[str, Any]:
    """The content of ``report.json``: everything but the pictures; only what JSON can hold (no NaN)."""
    return {
        "title": report.title,
        "made": report.made.isoformat(timespec="seconds"),
        "summary": summary(report.change),
        "why": report.change.why,
        "world": None if report.world is None else report.world.to_dict(),
        "objects": [_object_dict(o, report.world) for o in report.change.objects],
        "photos": [_photo_dict(p) for p in report.change.photos],
        "warnings": list(report.warnings),
        "facts": {k: finite(v) for k, v in report.facts.items()},
        "seconds": {k: finite(v) for k, v in report.seconds.items()},
        "evaluation": None if report.evaluation is None else dict(report.evaluation),
        "versions": dict(report.versions),
    }


def finite(value: Any) -> Any:
    """A number that is not finite becomes None: JSON has no word for it."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def lengths(units: float, world: World | None) -> tuple[float | None, float | None]:
    """A length in the world's units as a part of the scene's size, and in metres; None where that is not known."""
    if world is None:
        return None, None
    part = units / world.size if world.size > 0 else None
    return part, None if world.metres_per_unit is None else units * world.metres_per_unit


def _photo_dict(photo: PlacedPhoto) -> dict[str, Any]:
    told: dict[str, Any] = {"file": photo.name, "status": photo.status, "why": photo.why}
    return told if photo.placement is None else told | {"placement": asdict(photo.placement)}


def _object_dict(o: ObjectChange, world: World | None) -> dict[str, Any]:
    sure = uncertainty(o)
    shift = object_shift(o)
    part, metres = (None, None) if shift is None else lengths(math.hypot(*shift), world)
    return {
        "kind": o.kind,
        "aabb": o.grid.tight_aabb().tolist(),
        "new_from_old": None if o.new_from_old is None else o.new_from_old.tolist(),
        "shift": shift,
        "shift_of_scene": part,
        "shift_metres": metres,
        "angle_deg": o.turn_deg,
        "axis": None if o.new_from_old is None else turn(o.new_from_old)[1],
        "std_shift": None if sure is None else finite(sure[0]),
        "std_angle_deg": None if sure is None else finite(sure[1]),
        "confidence": finite(o.confidence),
        "note": o.note,
    }
