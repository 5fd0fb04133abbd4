"""What a visit found, in everyday words: things, lengths, moves, how sure it is, and when it was."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from datetime import datetime

import torch
from torch import Tensor

from refield.report.visit import lengths, object_shift, turn, uncertainty
from refield.scene.boxes import upright_box
from refield.scene.change import Kind, ObjectChange, SceneChange
from refield.scene.world import World

KINDS: dict[Kind, str] = {"moved": "moved", "removed": "gone", "added": "new"}
_MONTHS = ["January", "February", "March", "April", "May", "June", "July"]
_MONTHS += ["August", "September", "October", "November", "December"]
_NUMBERS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
_STAGES = {
    "load the capture": "Reading the first photos",
    "find where the photos were taken": "Finding where the first photos were taken",
    "keep the field": "Storing the model",
    "localize": "Finding where the new photos were taken",
    "load the field": "Reading the model",
    "detect": "Comparing the new photos with the model",
    "hull": "Finding where in space something changed",
    "pose": "Finding how things moved and turned",
    "segment": "Finding the things' shapes",
    "move": "Moving the things in the model",
    "light": "Following light and shadows",
    "supervise": "Choosing what the photos can teach",
    "freeze": "Holding on to what did not change",
    "train": "Learning what has come into view",
    "show": "Checking that nothing else got worse",
    "report": "Making this report",
}
_STILL = 0.02  # of a thing's longest side; a move by less is not spoken of
_TURNED, _ANY_TURN = 1.0, 30.0  # degrees; below the one there was no turn, and with a larger σ it is not known
_UPRIGHT, _LEVEL, _RISEN = 0.9, 0.3, 0.3
_SURE, _FAIRLY = 0.85, 0.6


def counted(number: int, noun: str) -> str:
    """ "one photo", "three photos", "15 photos"."""
    return f"{_word(number)} {noun}{'' if number == 1 else 's'}"


def headline(change: SceneChange) -> str:
    """ "Two objects moved, one is gone", or "One object moved, by hand", without a full stop."""
    if not change.objects:
        return "Something changed that is not understood" if change.unexplained else "Nothing changed"
    kinds = Counter(o.kind for o in change.objects)
    parts: list[str] = []
    for kind in KINDS:
        if kinds[kind]:
            who = _word(kinds[kind]) if parts else counted(kinds[kind], "object")
            be = "" if kind == "moved" else ("is " if kinds[kind] == 1 else "are ")
            parts.append(f"{who} {be}{KINDS[kind]}")
    text = ", ".join([*parts, "by hand"] if change.by_hand else parts)
    return text[0].upper() + text[1:]


def sentence(number: int, o: ObjectChange, world: World | None) -> str:
    """ "Object 1, a thing of 50 × 47 × 40 cm, moved 52 cm and turned 40° anticlockwise, seen from above."

    Lengths are metric where the world's scale is known, else in its units and as a part of the scene.
    """
    thing = f"Object {number}, a thing of {size(o, world)},"
    if o.kind == "moved":
        return f"{thing} {motion(o, world)}."
    return f"{thing} is {'no longer there' if o.kind == 'removed' else 'new'}."


def size(o: ObjectChange, world: World | None) -> str:
    """ "50 × 47 × 40 cm": longer and shorter side of what it stands on, and its height."""
    sides = upright_box(o.grid, up_of(world)).sides
    unit, factor, digits = _unit(max(sides), world)
    return f"{' × '.join(f'{s * factor:.{digits}f}' for s in sides)} {unit}"


def length(units: float, world: World | None) -> str:
    """ "52 cm", or "0.52 units (13 % of the scene)"."""
    unit, factor, digits = _unit(units, world)
    told = f"{units * factor:.{digits}f} {unit}"
    part = lengths(units, world)[0]
    metric = world is not None and world.metres_per_unit is not None
    return told if metric or part is None else f"{told} ({_percent(part)} of the scene)"


def motion(o: ObjectChange, world: World | None) -> str:
    """ "moved 52 cm and turned 40° anticlockwise, seen from above"."""
    assert o.new_from_old is not None
    shift, known = torch.tensor(object_shift(o), dtype=torch.float64), uncertainty(o)
    far, (angle, _) = float(shift.norm()), turn(o.new_from_old)
    off, wrong = known or (0.0, 0.0)
    still = far < max(2 * off, _STILL * max(upright_box(o.grid, up_of(world)).sides))
    turned = angle >= max(2 * wrong, _TURNED)
    if wrong > _ANY_TURN:
        return f"moved {length(far, world)}{_risen(shift, world)}; the photos do not show how it turned"
    if still and turned:
        return f"stayed in its place and {_turned(o.new_from_old, world)}"
    if turned:
        return f"moved {length(far, world)}{_risen(shift, world)} and {_turned(o.new_from_old, world)}"
    return f"moved {length(far, world)}{_risen(shift, world)} without turning"


def sure(confidence: float) -> str:
    """How sure the estimate is, in words."""
    word = "sure" if confidence >= _SURE else "fairly sure" if confidence >= _FAIRLY else "not sure"
    return f"{word} ({_percent(confidence)})"


def give_or_take(o: ObjectChange, world: World | None) -> str:
    """Two standard deviations of a move, in words; empty if they are not known."""
    known = uncertainty(o)
    if known is None:
        return ""
    unit, factor, digits = _unit(2 * known[0], world)
    told = f"give or take {2 * known[0] * factor:.{digits}f} {unit}"
    return told if known[1] > _ANY_TURN else f"{told} and {degrees(2 * known[1])}"


def scale_note(world: World | None) -> str:
    """What the lengths of a page are told in."""
    order = "Sizes are told as length × width × height."
    if world is None:
        return f"{order} Lengths are in units of the scene."
    if world.metres_per_unit is not None:
        return order
    span = f"{world.size:.3g} units"
    return (
        f"{order} How long a unit is in metres is not known: photos alone do not tell. The scene is {span} across, "
        "from camera to outermost camera."
    )


def date(moment: datetime) -> str:
    """ "3 November 2026, 14:05 UTC"."""
    return f"{day(moment)}, {moment:%H:%M} {moment.tzname() or ''}".strip()


def day(moment: datetime) -> str:
    """ "3 November 2026"."""
    return f"{moment.day} {_MONTHS[moment.month - 1]} {moment.year}"


def stage(name: str) -> str:
    """What was done during a stage; one that is not known keeps its name."""
    fitted = re.fullmatch(r"fit a field to (\d+) photos", name)
    return f"Making the model from {fitted[1]} photos" if fitted else _STAGES.get(name, name)


def names(items: Sequence[str]) -> str:
    """ "a, b and c"."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}" if items else ""


def up_of(world: World | None) -> Tensor:
    """(3,) float64, unit; the z axis if nothing is known."""
    return torch.tensor((0.0, 0.0, 1.0) if world is None else world.up, dtype=torch.float64)


def degrees(angle: float) -> str:
    """ "40°", "2.5°", "0.08°"."""
    return f"{angle:.{min(_digits(angle), 2)}f}°"


def _word(number: int) -> str:
    return _NUMBERS[number] if 0 <= number < len(_NUMBERS) else str(number)


def _unit(units: float, world: World | None) -> tuple[str, float, int]:
    """The unit in which to tell lengths of this size, how many of it a unit of the world is, and decimals."""
    if world is None or world.metres_per_unit is None:
        return "units", 1.0, _digits(units)
    metres = units * world.metres_per_unit
    for name, factor in (("mm", 1e3), ("cm", 1e2)):
        if metres * factor < 99.5 and (name == "cm" or metres < 0.02):
            return name, factor * world.metres_per_unit, _digits(metres * factor)
    return "m", world.metres_per_unit, 2 if metres < 10 else 1


def _digits(value: float) -> int:
    """Decimals that leave two digits that count."""
    rounded = float(f"{value:.1e}")
    return 0 if rounded >= 10 or rounded <= 0 else min(1 - math.floor(math.log10(rounded)), 6)


def _percent(part: float) -> str:
    return f"{100 * part:.{0 if part >= 0.095 else 1}f} %"


def _turned(new_from_old: Tensor, world: World | None) -> str:
    angle, axis = turn(new_from_old)
    if world is None:
        return f"turned {degrees(angle)}"
    upright = float(torch.tensor(axis, dtype=torch.float64) @ up_of(world))
    if abs(upright) > _UPRIGHT:
        return f"turned {degrees(angle)} {'anti' if upright > 0 else ''}clockwise, seen from above"
    return f"{'tipped' if abs(upright) < _LEVEL else 'turned and tipped'} by {degrees(angle)}"


def _risen(shift: Tensor, world: World | None) -> str:
    """What of a move is up or down, if that is much of it."""
    if world is None:
        return ""
    rise = float(shift @ up_of(world))
    if abs(rise) < _RISEN * float(shift.norm()):
        return ""
    unit, factor, digits = _unit(abs(rise), world)
    return f" ({abs(rise) * factor:.{digits}f} {unit} {'up' if rise > 0 else 'down'})"
