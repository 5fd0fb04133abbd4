"""The page's photos: before and after to wipe between, the photo with what changed marked, objects numbered in both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import torch
from torch import Tensor

from refield.report.pictures import data_uri, marks_uri
from refield.report.visit import Comparison
from refield.report.words import names, up_of
from refield.scene.boxes import upright_box
from refield.scene.capture import Frame
from refield.scene.change import Kind, ObjectChange
from refield.scene.pose import invert, transform
from refield.scene.world import World

ALL_PIXELS = 10e6
"""of a page's pictures together, about and at most: some 4 MB"""
MOST_VIEWS = 24
"""that are shown of the views of an evaluation"""
_EDGE = 5.0  # percent of a picture; badges keep this far from its sides
_APART = 7.0  # percent; closer badges of one object are shown as one


@dataclass(frozen=True)
class Spot:
    """Where an object's number goes in a picture."""

    number: int
    kind: Kind
    now: bool
    """where it is, not where it was"""
    left: float
    """percent of the picture's width"""
    top: float


def pictures_in(views: Sequence[Comparison]) -> int:
    """How many pictures `card` shows of so many views; for `ALL_PIXELS`."""
    return sum(p is not None for v in views for p in (v.photo, v.before, v.after))


def legend(views: Sequence[Comparison]) -> str:
    """What the colours in these photos say; empty if nothing is marked in any."""
    keys = (
        ("in", "blue-green: there now", any(v.mask_in is not None for v in views)),
        ("out", "orange: no longer there", any(v.mask_out is not None for v in views)),
        ("unclear", "violet: changed, not understood", any(v.unclear is not None for v in views)),
    )
    shown = " ".join(f'<span><i class="key {name}"></i>{told}</span>' for name, told, there in keys if there)
    return f'<p class="legend">{shown}</p>' if shown else ""


def card(title: str, view: Comparison, spots: Sequence[Spot], most: float) -> str:
    """One view: what is known of it. ``most``: pixels of a picture."""
    figures = [_pair(title, view, spots, most), _photo(title, view, spots, most)]
    shown = "".join(figures)
    return f'<article class="card"><h3>{escape(title)}</h3><div class="panels">{shown}</div></article>' if shown else ""


def spots_in(frame: Frame | None, objects: Sequence[ObjectChange], world: World | None) -> list[Spot]:
    """Where the objects' numbers, from 1, go in a photo: on top of them, where they were and where they are.

    Objects behind the camera or outside of the picture have none.
    """
    if frame is None:
        return []
    out: list[Spot] = []
    up = up_of(world)
    for number, o in enumerate(objects, 1):
        box = upright_box(o.grid, up).corners
        places = [] if o.kind == "added" else [(False, box, o.centre)]
        if o.kind == "added":
            places.append((True, box, o.centre))
        elif o.new_from_old is not None:
            pose = o.new_from_old.double()
            places.append((True, transform(pose, box), transform(pose, o.centre)))
        for now, corners, centre in places:
            at = _on_top(frame, corners, centre)
            if at is not None:
                out.append(Spot(number, o.kind, now, *at))
    return out


def _on_top(frame: Frame, corners: Tensor, centre: Tensor) -> tuple[float, float] | None:
    """Above an object's middle and at its upper end, in percent of the picture; None if it is not in it."""
    c = frame.camera
    pixels, depths = c.project(transform(invert(frame.world_from_cam.double()), torch.cat([centre[None], corners])))
    if bool((depths <= 0).any()) or not bool(pixels.isfinite().all()):
        return None
    x, y = pixels[0].tolist()
    if not (0 <= x <= c.width and 0 <= y <= c.height):
        return None
    top = float(pixels[1:, 1].amin())
    top += 0.1 * (y - top)
    at = (100 * x / c.width, 100 * top / c.height)
    return min(max(at[0], _EDGE), 100 - _EDGE), min(max(at[1], _EDGE), 100 - _EDGE)


def _pair(title: str, view: Comparison, spots: Sequence[Spot], most: float) -> str:
    """The picture before and the one after; without an update the photo takes the place of the latter."""
    if view.before is None or (view.after is None and view.photo is None):
        return ""
    then, now = [s for s in spots if not s.now], [s for s in spots if s.now]
    if view.after is not None:
        after, ends, caption = view.after, ("before", "after"), "Before and after"
        alts = f"{title}, before: the model from here", f"{title}, after: the updated model from here"
    else:
        assert view.photo is not None
        after, ends, caption = view.photo, ("model", "photo"), "The model and the photo"
        alts = f"{title}: the model from here", f"{title}: the photo"
    halves = _half(alts[0] + _told(then), ends[0], data_uri(view.before, most), then)
    halves += _half(alts[1] + _told(now), ends[1], data_uri(after, most), now)
    return _figure("pair", f"{title}: {ends[0]} and {ends[1]}", caption, halves, view.before)


def _half(alt: str, name: str, source: str, spots: Sequence[Spot]) -> str:
    return (
        f'<div class="half"><img alt="{escape(alt)}" src="{source}">{_badges(spots)}'
        f'<span class="tag">{escape(name)}</span></div>'
    )


def _photo(title: str, view: Comparison, spots: Sequence[Spot], most: float) -> str:
    """The photo, with what changed marked; not again where it is one half of the pair."""
    if view.photo is None or (view.after is None and view.before is not None and not view.marked):
        return ""
    shown = _once(spots)
    now, then = [s for s in shown if s.now], [s for s in spots if not s.now]
    alt = f"{title}: the photo{_told(now, ', now')}{_told(then, ', no longer there')}"
    laid, switch = "", ""
    if view.marked:
        laid = f'<img class="marks" alt="" src="{marks_uri(view.mask_in, view.mask_out, view.unclear, most)}">'
        switch = '<input type="checkbox" checked class="switch"> what changed'
    inner = f'<img alt="{escape(alt)}" src="{data_uri(view.photo, most)}">{laid}{_arrows(spots)}{_badges(shown)}'
    return _figure("photo", title, "The photo", inner, view.photo, switch)


def _figure(kind: str, name: str, caption: str, inner: str, picture: Tensor, switch: str = "") -> str:
    aspect = picture.shape[1] / picture.shape[0]
    label = f"<label>{switch}</label>" if switch else ""
    return (
        f'<figure class="{kind}" data-name="{escape(name)}" style="--aspect:{aspect:.4f}">'
        f'<figcaption><span>{escape(caption)}</span>{label}</figcaption><div class="stage">{inner}</div></figure>'
    )


def _badges(spots: Sequence[Spot]) -> str:
    return "".join(
        f'<b class="no {s.kind} {"is" if s.now else "was"}" aria-hidden="true"'
        f' style="left:{s.left:.1f}%;top:{s.top:.1f}%">{s.number}</b>'
        for s in spots
    )


def _once(spots: Sequence[Spot]) -> list[Spot]:
    """Without the old place of an object that is shown next to it at its new one."""
    now = {s.number: s for s in spots if s.now}
    return [s for s in spots if s.now or s.number not in now or _distance(s, now[s.number]) > _APART]


def _arrows(spots: Sequence[Spot]) -> str:
    """From where objects were to where they are; the badges lie on its ends."""
    now = {s.number: s for s in spots if s.now}
    ways = [(s, now[s.number]) for s in spots if not s.now and s.number in now]
    lines = "".join(
        f'<line x1="{a.left:.1f}" y1="{a.top:.1f}" x2="{b.left:.1f}" y2="{b.top:.1f}"/>'
        for a, b in ways
        if _distance(a, b) > _APART
    )
    view = 'viewBox="0 0 100 100" preserveAspectRatio="none" aria-hidden="true"'
    return f'<svg class="ways" {view}>{lines}</svg>' if lines else ""


def _distance(a: Spot, b: Spot) -> float:
    return max(abs(a.left - b.left), abs(a.top - b.top))


def _told(spots: Sequence[Spot], where: str = "") -> str:
    """Which objects are numbered in a picture, for those who do not see it."""
    numbers = sorted({s.number for s in spots})
    if not numbers:
        return ""
    return f"; {'object' if len(numbers) == 1 else 'objects'} {names([str(n) for n in numbers])}{where}"
