"""From one state of a field to another in one picture: a wipe, or a cross-fade."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_frame
from refield.field.volrend import Rendering
from refield.scene.capture import Frame

Blend = Literal["wipe", "fade"]
_HELD = 0.15  # of the time between two states, at its begin and at its end, in which one of them alone is seen
_LINE = 240  # the wipe's edge is as wide as the picture over this


class Transition:
    """Pictures between states of a field, one after the other: ``fields`` as they follow each other, by ``blend``.

    With ``standing`` every view is the same, and each state is rendered once.
    """

    def __init__(self, fields: Sequence[Field], blend: Blend = "wipe", *, standing: bool = False) -> None:
        self._fields, self._blend, self._standing = fields, blend, standing
        self._whole: dict[int, Rendering] = {}

    def __call__(self, frame: Frame, at: float) -> Rendering:
        """What is seen in a view ``at`` 0 (the first state) to 1 (the last one); leading shape (height, width). A wipe
        takes each pixel from one state, as long as a plain picture; a fade renders two."""
        last = len(self._fields) - 1
        if last == 0:
            return self._shown(0, frame)
        first = min(int(at * last), last - 1)
        part = _eased(at * last - first)
        if part in (0, 1):
            return self._shown(first + int(part), frame)
        return (_wiped if self._blend == "wipe" else _faded)(self, first, frame, part)

    def _shown(self, state: int, frame: Frame, left: int = 0, right: int | None = None) -> Rendering:
        """The columns from ``left`` to ``right`` of the view of a state."""
        right = frame.camera.width if right is None else right
        if not self._standing:
            part = replace(frame.camera, width=right - left, cx=frame.camera.cx - left)
            return render_frame(self._fields[state], replace(frame, camera=part))
        if state not in self._whole:
            self._whole[state] = render_frame(self._fields[state], frame)
        whole = self._whole[state]
        return Rendering(*(t[:, left:right] for t in (whole.rgb, whole.depth, whole.opacity)))


def _eased(part: float) -> float:
    x = min(max((part - _HELD) / (1 - 2 * _HELD), 0.0), 1.0)
    return x * x * (3 - 2 * x)


def _wiped(show: Transition, first: int, frame: Frame, part: float) -> Rendering:
    """The later state comes in from the left, behind a white line."""
    width = frame.camera.width
    cut = round(part * width)
    if cut in (0, width):
        return show._shown(first + (cut > 0), frame)
    after, before = show._shown(first + 1, frame, 0, cut), show._shown(first, frame, cut)
    rgb, depth, opacity = (
        torch.cat([getattr(side, k) for side in (after, before)], 1) for k in ("rgb", "depth", "opacity")
    )
    thick = max(width // _LINE, 1)
    rgb[:, max(cut - thick, 0) : min(cut + thick, width)] = 1.0
    return Rendering(rgb, depth, opacity)


def _faded(show: Transition, first: int, frame: Frame, part: float) -> Rendering:
    """Depths cannot be mixed: they are of the state that is seen more."""
    before, after = show._shown(first, frame), show._shown(first + 1, frame)
    rgb, opacity = (_mixed(getattr(before, k), getattr(after, k), part) for k in ("rgb", "opacity"))
    return Rendering(rgb, (before if part < 0.5 else after).depth, opacity)


def _mixed(a: Tensor, b: Tensor, part: float) -> Tensor:
    return a + (b - a) * part
