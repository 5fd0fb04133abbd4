"""The scene from above as a drawing (SVG): where things stood and stand, and where the photos were taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from refield.report import words
from refield.scene.boxes import across, upright_box
from refield.scene.capture import Frame
from refield.scene.change import ObjectChange
from refield.scene.pose import transform
from refield.scene.world import World

_WIDTH, _MARGIN, _BAR = 420.0, 30.0, 34.0
_TALLEST, _FLATTEST = 1.1, 0.45  # height over width
_REACH = 4.0  # times the things' own reach; cameras beyond are drawn at the edge
_BADGE, _EDGE = 11.0, 18.0
_NAME = 56.0, 14.0  # room for a photo's name
_MOST_NAMED, _MOST_OLD = 12, 400


@dataclass(frozen=True)
class Thing:
    """Something to be drawn."""

    label: str
    """what its badge says, such as "1" """
    change: ObjectChange


@dataclass(frozen=True)
class _Paper:
    """From the world to the drawing."""

    right: Tensor
    ahead: Tensor
    low: Tensor
    """(2,) the left and upper edge, along ``right`` and against ``ahead``"""
    scale: float
    height: float

    def at(self, points: Tensor) -> Tensor:
        """World (..., 3) -> drawing (..., 2)."""
        return (_level(points, self.right, self.ahead) - self.low) * self.scale + _MARGIN


def plan(
    things: Sequence[Thing], world: World | None, cameras: Sequence[tuple[str, Frame]] = (), old: Sequence[Frame] = ()
) -> str:
    """An ``<svg>``; empty without things, or where it is not known which way is up.

    ``cameras``: the new photos with their names; the first looks up the page. ``old``: those of the field, as dots.
    """
    if world is None or not things:
        return ""
    up = words.up_of(world)
    paper = _paper(things, [frame for _, frame in cameras], up)
    shapes = [_footprints(t.change, up, paper) for t in things]
    parts = [f'<circle class="old-photo" cx="{x:.1f}" cy="{y:.1f}" r="1.6"/>' for x, y in _old_photos(old, paper)]
    parts += [_outlines(t.change, before, after) for t, (before, after) in zip(things, shapes)]
    parts += [_arrow(t.change, paper) for t in things]
    parts += _cameras(cameras, paper)
    parts += [_badge(t, paper) for t in things]
    parts.append(_scale_bar(paper, world))
    said = " ".join(f"{t.label}: {words.KINDS[t.change.kind]}." for t in things)
    size = f"0 0 {_WIDTH:.0f} {paper.height:.0f}"
    return (
        f'<svg class="plan" viewBox="{size}" role="img" aria-label="Plan of the scene from above. {escape(said)}">'
        f"{''.join(parts)}</svg>"
    )


def _level(points: Tensor, right: Tensor, ahead: Tensor) -> Tensor:
    points = points.double()
    return torch.stack([points @ right, -(points @ ahead)], -1)


def _paper(things: Sequence[Thing], frames: Sequence[Frame], up: Tensor) -> _Paper:
    right, ahead = across(up)
    if frames:
        look = frames[0].world_from_cam[:3, 2].double()
        look = look - (look @ up) * up
        if float(look.norm()) > 0.1:
            ahead = look / look.norm()
            right = torch.linalg.cross(ahead, up)
    boxes = torch.cat([_corners(t.change, up) for t in things])
    spots = _level(boxes, right, ahead)
    middle = (spots.amin(0) + spots.amax(0)) / 2
    reach = max(float((spots - middle).norm(dim=1).max()), 1e-9)
    if frames:
        seen = _level(torch.stack([f.centre for f in frames]), right, ahead)
        spots = torch.cat([spots, middle + (seen - middle).clamp(-_REACH * reach, _REACH * reach)])
    low, high = spots.amin(0), spots.amax(0)
    wide, tall = (high - low).clamp_min(0.2 * reach).tolist()
    room = _WIDTH - 2 * _MARGIN
    scale = min(room / wide, (_WIDTH * _TALLEST - 2 * _MARGIN) / tall)
    height = max(tall * scale + 2 * _MARGIN, _FLATTEST * _WIDTH)
    shown = torch.tensor([room, height - 2 * _MARGIN], dtype=torch.float64) / scale
    return _Paper(right, ahead, (low + high - shown) / 2, scale, height + _BAR)


def _corners(o: ObjectChange, up: Tensor) -> Tensor:
    """(8 or 16, 3) of a thing's box where it was and where it is."""
    box = upright_box(o.grid, up).corners
    return box if o.new_from_old is None else torch.cat([box, transform(o.new_from_old.double(), box)])


def _footprints(o: ObjectChange, up: Tensor, paper: _Paper) -> tuple[Tensor | None, Tensor | None]:
    """Outlines on paper (K, 2) of where a thing was and where it is."""
    corners = paper.at(_corners(o, up))
    if o.kind == "moved":
        return _hull(corners[:8]), _hull(corners[8:])
    return (_hull(corners), None) if o.kind == "removed" else (None, _hull(corners))


def _hull(points: Tensor) -> Tensor:
    try:
        return points[torch.from_numpy(ConvexHull(points.numpy()).vertices).long()]
    except QhullError:  # no area
        return points


def _outlines(o: ObjectChange, before: Tensor | None, after: Tensor | None) -> str:
    parts = []
    for shape, style in ((before, "was"), (after, "is")):
        if shape is not None:
            parts.append(_polygon(f"{style} {o.kind}", shape))
    return "".join(parts)


def _arrow(o: ObjectChange, paper: _Paper) -> str:
    if o.shift is None:
        return ""
    start, end = paper.at(torch.stack([o.centre, o.centre + o.shift]))
    way = end - start
    far = float(way.norm())
    if far < _BADGE + 12:  # the outlines alone tell it
        return ""
    way = way / far
    tip = end - way * (_BADGE + 3)
    neck, side = tip - way * 9, torch.stack([-way[1], way[0]]) * 5
    head = _polygon("head", torch.stack([tip, neck + side, neck - side]))
    (x0, y0), (x1, y1) = start.tolist(), neck.tolist()
    line = f'<line class="way" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>'
    return f'<circle class="from" cx="{x0:.1f}" cy="{y0:.1f}" r="3"/>{line}{head}'


def _cameras(cameras: Sequence[tuple[str, Frame]], paper: _Paper) -> list[str]:
    """Wedges that open to where photos look, with their names beside them unless they are many."""
    wedges, texts = [], []
    taken: list[tuple[float, float]] = []
    for name, frame in cameras:
        at, ahead = _stands(frame, paper)
        side = torch.stack([-ahead[1], ahead[0]])
        wedges.append(_polygon("camera", torch.stack([at, at + ahead * 13 + side * 7, at + ahead * 13 - side * 7])))
        if not name or len(cameras) > _MOST_NAMED:
            continue
        x, y = (at - ahead * 11).tolist()
        if abs(float(ahead[0])) > 0.7:  # there is no room for a name behind it
            x, y = float(at[0]), float(at[1]) + 17
        x, y = min(max(x, _NAME[0] / 2), _WIDTH - _NAME[0] / 2), y + 4
        while any(abs(x - a) < _NAME[0] and abs(y - b) < _NAME[1] for a, b in taken):
            y += _NAME[1]
        taken.append((x, y))
        texts.append(f'<text x="{x:.1f}" y="{y:.1f}">{escape(name)}</text>')
    return wedges + texts


def _stands(frame: Frame, paper: _Paper) -> tuple[Tensor, Tensor]:
    """Where a camera is drawn, at the edge if it is further away, and which way it looks there (unit)."""
    at = paper.at(frame.centre)
    ahead = paper.at(frame.centre + frame.world_from_cam[:3, 2].double()) - at
    limit = at.new_tensor([_WIDTH, paper.height - _BAR])
    return torch.minimum(at.clamp_min(_EDGE), limit - _EDGE), ahead / ahead.norm().clamp_min(1e-9)


def _polygon(style: str, corners: Tensor) -> str:
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners.tolist())
    return f'<polygon class="{style}" points="{points}"/>'


def _badge(thing: Thing, paper: _Paper) -> str:
    o = thing.change
    x, y = paper.at(o.centre if o.shift is None else o.centre + o.shift).tolist()
    wide = _BADGE + 4.0 * max(len(thing.label) - 2, 0)
    return (
        f'<rect class="badge {o.kind}" x="{x - wide:.1f}" y="{y - _BADGE:.1f}" width="{2 * wide:.1f}"'
        f' height="{2 * _BADGE:.1f}" rx="{_BADGE:.1f}"/>'
        f'<text class="no" x="{x:.1f}" y="{y + 4.6:.1f}">{escape(thing.label)}</text>'
    )


def _old_photos(frames: Sequence[Frame], paper: _Paper) -> list[list[float]]:
    if not frames:
        return []
    at = paper.at(torch.stack([f.centre for f in frames[:: max(len(frames) // _MOST_OLD, 1)]]))
    inner = at.new_tensor([_WIDTH, paper.height - _BAR])
    return at[((at > 3) & (at < inner - 3)).all(1)].tolist()


def _scale_bar(paper: _Paper, world: World) -> str:
    """A bar of a round length, in metres if they are known."""
    unit = 1.0 if world.metres_per_unit is None else 1 / world.metres_per_unit
    most = _WIDTH / 3 / paper.scale / unit
    tens = 10 ** math.floor(math.log10(most))
    number = next(n * tens for n in (5, 2, 1) if n * tens <= most)
    if world.metres_per_unit is None:
        name = f"{number:g} unit{'' if number == 1 else 's'}"
    else:
        name = f"{number * 100:g} cm" if number < 1 else f"{number:g} m"
    x, y, wide = _MARGIN, paper.height - 12, number * unit * paper.scale
    bar = f'<path class="bar" d="M{x:.1f} {y - 5:.1f}v5h{wide:.1f}v-5"/>'
    return f'{bar}<text class="left" x="{x + wide + 8:.1f}" y="{y:.1f}">{name}</text>'
