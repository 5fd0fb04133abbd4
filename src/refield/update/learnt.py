"""What an updated field is made of, beside the old field and the change: what its visit learnt, what earlier visits
knew, and what later ones took back."""

from __future__ import annotations

from dataclasses import dataclass

from refield.field.radiance import Field
from refield.update.light import Relighting
from refield.update.region import Region

NOWHERE = Region(())


@dataclass(frozen=True)
class Learnt:
    """What the new photos of a visit told."""

    helper: Field | None = None
    """shows what is where the old field no longer speaks; without one that is cut out"""
    region: Region | None = None
    """where the helper speaks: by default M_out of the change, without a helper what the objects filled"""
    light: Relighting | None = None
    """on what stood still"""
    shading: tuple[Relighting | None, ...] = ()
    """the light on each moved object, at its old place"""
    bare: Region = NOWHERE
    """a part of the region that goes before what moved in"""


@dataclass(frozen=True)
class Origin:
    """Where an object of a change comes from: object ``index`` of the change that is ``layer`` updates before this."""

    object: int
    layer: int
    index: int


@dataclass(frozen=True)
class Earlier:
    """What an update takes from earlier visits in place of learning it."""

    undone: tuple[Origin, ...] = ()
    """Objects that are back where the field without that earlier change shows them; it is the one wrapped"""
    left: tuple[Origin, ...] = ()
    """Objects that left a place to which that earlier change had brought them"""
    places: Region = NOWHERE
    """these places, widely"""
    ground: Field | None = None
    """shows them without the objects"""
    unknown: Region = NOWHERE
    """parts of these places that even so nobody has seen: an object's old place and its new one overlapped"""

    def __bool__(self) -> bool:
        return bool(self.undone or self.left)


@dataclass(frozen=True)
class TakenBack:
    """What later visits took out of an update."""

    skipped: frozenset[int] = frozenset()
    """objects of its change that are as the old field shows them"""
    untaught: Region = NOWHERE
    """where something stood while its helper learnt: the old field knows better what is under it"""


NOTHING_LEARNT, NOTHING_EARLIER, NOTHING_TAKEN = Learnt(), Earlier(), TakenBack()
