"""What changed between two visits: the only thing that crosses from `estimate` to `update`.

An object is an occupancy grid (§4.2.4) in the world, a kind, and for a moved one the paper's T, here
``new_from_old``. Files: ``change.json``, ``grid_<i>.npz``, ``masks/`` (see `refield.workspace`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from refield.scene.capture import Frame, Rays
from refield.scene.inside import in_grid, meet_grid, trilinear
from refield.scene.pose import invert, rotation_log, transform

Kind = Literal["moved", "removed", "added"]
_IN, _OUT, _UNCLEAR = (16, 185, 199), (249, 115, 22), (147, 51, 234)  # as on the report's page


@dataclass(frozen=True, repr=False)
class OccupancyGrid:
    """An object's 3-D mask M: values at the grid's nodes, corner to corner of a world-aligned box."""

    aabb: Tensor
    """(2, 3) float32: minimum and maximum corner, world."""
    values: Tensor
    """(X, Y, Z) float32 in [0, 1]; node (i, j, k) lies at ``lerp(aabb, (i, j, k) / (size - 1))``."""

    def sample(self, x: Tensor) -> Tensor:
        """Trilinear value at world points (..., 3) -> (...,); 0 outside the box."""
        return trilinear(x, self.aabb, self.values)

    def contains(self, x: Tensor) -> Tensor:
        """M(x): world points (..., 3) -> (...,) bool, trilinear value > 0.5 (§4.2.4)."""
        flat = x.detach().reshape(-1, 3)
        return in_grid(flat, self.aabb, self.values, 0.5).reshape(x.shape[:-1])

    def met_by(self, rays: Rays, places: int = 40) -> Tensor:
        """Whether each of N rays passes through the object, at one of so many places on its way, (N,) bool."""
        tight = self.tight_aabb()
        return meet_grid(rays, self.aabb, self.values, 0.5, tight, places)

    def nodes(self) -> Tensor:
        """World positions of the nodes, (X, Y, Z, 3) float32."""
        lo, hi = self.aabb
        axes = [torch.linspace(float(a), float(b), n) for a, b, n in zip(lo, hi, self.values.shape)]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)

    def occupied(self) -> Tensor:
        """World positions of the nodes inside the object, (K, 3) float32."""
        return self.nodes()[self.values > 0.5]

    @cached_property
    def centre(self) -> Tensor:
        """Mean of the occupied nodes, (3,) float64, world; the middle of the grid's own box if none is."""
        points = self.occupied()
        return (points if len(points) else self.aabb).double().mean(0)

    @property
    def cell(self) -> Tensor:
        """(3,) float32 distance of neighbouring nodes along each axis, world units."""
        return (self.aabb[1] - self.aabb[0]) / (torch.tensor(self.values.shape) - 1)

    def tight_aabb(self) -> Tensor:
        """(2, 3) box around the occupied nodes, half a cell wider; the grid's own box if none is occupied."""
        return self._tight

    @cached_property
    def _tight(self) -> Tensor:
        points = self.occupied()
        if len(points) == 0:
            return self.aabb
        size = torch.tensor(self.values.shape)
        half_cell = (self.aabb[1] - self.aabb[0]) / (size - 1) / 2
        return torch.stack([points.amin(0) - half_cell, points.amax(0) + half_cell])

    def dilated(self, factor: float) -> OccupancyGrid:
        """M_out (§10.1.3): grown equally on every side until its box is ``factor`` times as large.

        The distance is half of (factor - 1) times the mean side of the tight box.
        """
        box = self.tight_aabb()
        reach = float((box[1] - box[0]).mean()) * (factor - 1) / 2
        size = torch.tensor(self.values.shape, dtype=torch.float32)
        cell = float(((self.aabb[1] - self.aabb[0]) / (size - 1)).max())
        step = max(cell, reach / 16)  # a coarser lattice is enough for a region's outline
        lo, hi = box[0] - reach - step, box[1] + reach + step
        shape = ((hi - lo) / step).ceil().long() + 1
        hi = lo + (shape - 1) * step
        grid = OccupancyGrid(torch.stack([lo, hi]), torch.zeros(*shape.tolist()))
        from scipy.ndimage import distance_transform_edt

        inside = self.contains(grid.nodes()).numpy()
        distance = torch.from_numpy(distance_transform_edt(~inside)).float() * step
        # a ramp of one step around the reach keeps the trilinear 0.5 level on the true distance
        return replace(grid, values=(0.5 + (reach - distance) / (2 * step)).clamp(0, 1))

    def moved(self, new_from_old: Tensor) -> OccupancyGrid:
        """The same object at its new place, resampled on a world-aligned grid."""
        size = torch.tensor(self.values.shape, dtype=torch.float32)
        cell = float(((self.aabb[1] - self.aabb[0]) / (size - 1)).min())
        corners = torch.cartesian_prod(*self.tight_aabb().T.double())
        corners = transform(new_from_old, corners).float()
        lo, hi = corners.amin(0) - cell, corners.amax(0) + cell
        shape = ((hi - lo) / cell).ceil().long() + 1
        grid = OccupancyGrid(torch.stack([lo, lo + (shape - 1) * cell]), torch.zeros(*shape.tolist()))
        return replace(grid, values=self.sample(transform(invert(new_from_old), grid.nodes())))

    def __repr__(self) -> str:
        shape, box = " x ".join(map(str, self.values.shape)), self.tight_aabb()
        return f"OccupancyGrid({shape}, from {_place(box[0])} to {_place(box[1])})"


@dataclass(frozen=True, repr=False)
class ObjectChange:
    """One object that moved, left or arrived."""

    kind: Kind
    grid: OccupancyGrid
    """Where it was (moved, removed) or where it is now (added)."""
    new_from_old: Tensor | None = None
    """(4, 4) float64, the paper's T; only for ``moved``."""
    masks: tuple[Tensor | None, ...] = ()
    """Per old training frame, (H, W) bool: where the object was seen. None = unsure, the frame is left out
    (§10.1.3). Empty for ``added``."""
    masks_in: tuple[Tensor | None, ...] = ()
    """Per old training frame, (H, W) bool: where its new place projects. Empty for ``removed``."""
    confidence: float = 1.0
    covariance: Tensor | None = None
    """(6, 6) float64 of the twist (world units, radians; about the world's origin) that left-multiplies
    ``new_from_old``."""
    note: str = ""
    """Why it is believed, and what the user should know: an unobservable turn, a weak match."""
    alternatives: tuple[Tensor, ...] = ()
    """(4, 4) float64 each: other pose changes, at the same place, that the photos show as well as ``new_from_old``: a
    thing may look the same from several sides. Only for ``moved``."""

    def __post_init__(self) -> None:
        if (self.kind == "moved") != (self.new_from_old is not None):
            raise ValueError(f"new_from_old belongs to a moved object, and only to one (kind is {self.kind!r})")

    @property
    def old_from_new(self) -> Tensor:
        """T⁻¹ of a moved object, (4, 4) float64."""
        if self.new_from_old is None:
            raise ValueError(f"an object that was {self.kind} has no pose change")
        return invert(self.new_from_old)

    @property
    def centre(self) -> Tensor:
        """The mean of the grid's occupied part, (3,) float64, world: wherever a place of the object is told, it is that
        of this point, and a move's length is how far it went."""
        return self.grid.centre

    @property
    def shift(self) -> Tensor | None:
        """How far a moved object's centre went, (3,) float64, world units.

        Unlike T's own last column it does not depend on where the world's origin lies.
        """
        if self.new_from_old is None:
            return None
        return transform(self.new_from_old.double(), self.centre) - self.centre

    @property
    def grid_now(self) -> OccupancyGrid | None:
        """Where the object is now; None for one that left."""
        if self.kind == "removed":
            return None
        return self.grid if self.new_from_old is None else self.grid.moved(self.new_from_old)

    @property
    def turn_deg(self) -> float | None:
        """By how much a moved object turned, [0, 180]."""
        if self.new_from_old is None:
            return None
        return math.degrees(float(rotation_log(self.new_from_old[:3, :3].double()).norm()))

    def __repr__(self) -> str:
        told = f"{self.kind} at {_place(self.centre)}"
        if self.shift is not None:
            told = f"moved from {_place(self.centre)} by {float(self.shift.norm()):.4g}, turned {self.turn_deg:.1f}°"
        return f"ObjectChange({told}, confidence {self.confidence:.2f})"


@dataclass(frozen=True)
class Placement:
    """How well a photo's pose is known from the points that it shows (§4.2.1)."""

    inliers: int
    """points that agree with the pose"""
    matches: int
    """points that were recognised"""
    error: float
    """median distance of the inliers from where the pose puts them, pixels"""
    camera: str = ""
    """where its intrinsics come from"""


@dataclass(frozen=True)
class PlacedPhoto:
    """What became of one new photo."""

    name: str
    status: Literal["used", "rejected"]
    why: str = ""
    frame: Frame | None = None
    placement: Placement | None = None
    """None where the pose was given"""

    def __post_init__(self) -> None:
        if (self.status == "used") != (self.frame is not None):
            raise ValueError("a used photo has a frame; a rejected one has none")


@dataclass(frozen=True, repr=False)
class SceneChange:
    """Everything that changed. No objects means: nothing changed."""

    objects: tuple[ObjectChange, ...] = ()
    photos: tuple[PlacedPhoto, ...] = ()
    why: str = ""
    """In one sentence, why this was concluded (also when nothing was)."""
    masks_in: tuple[Tensor, ...] = field(default=())
    """Per used photo, (H, W) bool: all changed pixels showing what is there now."""
    masks_out: tuple[Tensor, ...] = field(default=())
    """Per used photo, (H, W) bool: all changed pixels where something used to be."""
    unexplained: tuple[Tensor, ...] = field(default=())
    """Per used photo, (H, W) bool: changed pixels that nothing of what is said here explains; empty if they are few."""
    by_hand: bool = False
    """Whether somebody told it, and no photo was asked."""

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The new photos that are used, with their poses."""
        return tuple(p.frame for p in self.photos if p.frame is not None)

    @property
    def kinds(self) -> str:
        """How many objects did what: "1 moved, 2 removed"."""
        count = Counter(o.kind for o in self.objects)
        return ", ".join(f"{count[kind]} {kind}" for kind in get_args(Kind) if count[kind])

    def among(self, placed: Sequence[PlacedPhoto]) -> SceneChange:
        """The same, with what localization said of all ``placed`` photos, of which the used ones were compared."""
        verdicts = {photo.name: photo for photo in self.photos}
        photos = [
            replace(verdicts[p.name], placement=p.placement) if p.name in verdicts and p.frame is not None else p
            for p in placed
        ]
        return replace(self, photos=tuple(photos))

    def __repr__(self) -> str:
        objects = ", ".join(map(repr, self.objects)) or self._nothing
        return f"SceneChange({objects}; {self._counted})"

    @property
    def _nothing(self) -> str:
        return "changed, but not understood" if self.unexplained else "nothing changed"

    @property
    def _counted(self) -> str:
        return "by hand, no photos" if self.by_hand else f"{len(self.frames)} of {len(self.photos)} photos used"

    def _repr_html_(self) -> str:
        from refield.scene import notebook

        heads = ("what", "where", "moved by", "turned by", "confidence", "note")
        told = notebook.table(heads, [_row(o) for o in self.objects]) if self.objects else ""
        rows: list[tuple[str, object]] = [("photos", self._counted)]
        rows += [("why", self.why)] if self.why else []
        if not self.objects:
            rows.insert(0, ("objects", self._nothing))
        pictures: list[tuple[str, Any]] = []
        used = 0
        for photo in self.photos:
            if photo.frame is None:
                pictures.append((f"{photo.name}: {photo.why or 'rejected'}", None))
                continue
            image = notebook.thumbnail(photo.frame)
            kinds = ((self.masks_out, _OUT), (self.masks_in, _IN), (self.unexplained, _UNCLEAR))
            masks = [(kind[used], colour) for kind, colour in kinds if kind]
            pictures.append((photo.name, None if image is None else notebook.inked(image, masks)))
            used += 1
        return notebook.facts("Change", rows) + told + notebook.strip(pictures)


def _place(x: Tensor) -> str:
    return f"({', '.join(f'{v:.4g}' for v in x.tolist())})"


def _row(o: ObjectChange) -> tuple[str, ...]:
    """Of the notebook's table."""
    moved = "" if o.shift is None else f"{float(o.shift.norm()):.4g}"
    turned = "" if o.turn_deg is None else f"{o.turn_deg:.1f}°"
    return o.kind, _place(o.centre), moved, turned, f"{o.confidence:.2f}", o.note
