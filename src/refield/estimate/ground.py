"""What every step of the association shares, and when it believes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from refield.estimate.alone import object_alone
from refield.estimate.detail import Detail
from refield.estimate.detect import Changed, DetectConfig
from refield.estimate.hull import Hull, HullConfig
from refield.estimate.kept import Kept
from refield.estimate.look import Array, Seen, View
from refield.estimate.memory import Memory
from refield.estimate.objects import Old
from refield.estimate.outline import ObjectConfig
from refield.estimate.past import Past, look_past
from refield.estimate.pose_change import PoseChange, RefineConfig
from refield.estimate.register import RegisterConfig
from refield.estimate.tally import Tally
from refield.field.radiance import Field
from refield.scene.capture import Frame
from refield.scene.planes import Plane
from refield.vision.matcher import Matcher


@dataclass(frozen=True)
class AssociateConfig:
    """When a pose, a departure, an arrival is believed."""

    touched: float = 0.5
    """part of an old object's pixels that must have changed for it to be looked for elsewhere"""
    explains: float = 0.5
    """part of the object's pixels that the moved object must explain"""
    shown: float = 0.8
    """part of the object's pixels that the field shows right in old photos; if it is less, down to half as much need be
    explained"""
    gains: float = 0.15
    """by how much more than the old rendering did"""
    alike: float = 0.5
    """part of the pixels at its new place that look as before; if it is more, it must gain twice as much"""
    refined: int = 6
    """candidates of an object that are refined"""
    gone: float = 0.45
    """part of an object's pixels that must show what was behind it, for it to have left"""
    arrived: float = 0.5
    """part of a newcomer's pixels that nothing else explains"""
    smallest: float = 0.003
    """part of a photo that a place must fill in one at least, and what bodies cost goes by; what is smaller is an error
    of the field, or an edge"""
    # the paper's contour area is 1 %, §10.2.2
    trim: float = 0.03
    """part of an object's voxels that the new photos or the ground deny, from which on it is trimmed"""
    core: float = 0.25
    """part of an object's voxels that must remain when it is trimmed"""
    sunk: float = 0.8
    """part of its pixels that must show an object which would be mostly beneath what holds things up"""
    still: float = 1.2
    """pixels; what moved by less stayed"""
    most: int = 5
    """old objects, and places, that are tried; the largest first"""


@dataclass(frozen=True)
class Ground:
    """What every attempt shares."""

    field: Field
    hulls: Sequence[Hull]
    """the carved change, place by place"""
    up: Array
    """(3,) the support's normal"""
    planes: Sequence[Plane]
    """what holds things up"""
    survey: Sequence[View]
    memory: Memory
    """what old photos saw"""
    photographed: Sequence[Frame]
    """old photos that show the old state as it was"""
    detect: DetectConfig
    carving: HullConfig
    shape: ObjectConfig
    believe: AssociateConfig
    search: RegisterConfig
    fine: RefineConfig
    matcher: Matcher
    tally: Tally = dataclasses.field(default_factory=Tally)
    """of the explanations that are tried"""
    pasts: Kept[list[Past]] = dataclasses.field(init=False, default_factory=lambda: Kept(24))
    """the photos past some objects"""
    details: Kept[Detail] = dataclasses.field(init=False, default_factory=lambda: Kept(16))
    """what the field lacks of an object, by the old photos that are asked; as finely for all, since as many new photos
    ask"""
    alone: Kept[Seen] = dataclasses.field(init=False, default_factory=lambda: Kept(128))
    """a moved object's own picture in a photo"""

    def past(self, changed: Sequence[Changed], olds: Sequence[Old]) -> list[Past]:
        """The photos past some objects."""
        olds = sorted(olds, key=id)  # whichever is named first
        return self.pasts.get(
            (*changed, *olds),
            lambda: look_past(self.field, changed, self.memory, olds, (self.detect, self.carving)),
        )

    def object_alone(self, old: Old, view: View, change: PoseChange) -> Seen:
        """A moved object's own picture in a photo."""
        return self.alone.get(
            (old, view, change), lambda: object_alone(self.field, old, view.rays, change.new_from_old)
        )
