"""The scene in three dimensions, before and after: points that the new photos' places show, to be turned by hand.

`space.js` draws them, on any processor. Coordinates on the page: the origin between the changed objects, z up, lengths
in radii, a radius being half of the points' median distance from it.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import torch
from torch import Tensor

from refield.field.volrend import depths_around
from refield.report.visit import Comparison
from refield.report.words import up_of
from refield.scene.boxes import across, upright_box
from refield.scene.capture import camera_rays
from refield.scene.change import ObjectChange
from refield.scene.pose import transform
from refield.scene.world import World

POINTS = 20_000
"""of a state, about and at most: 240 kB on the page"""
_WIDER = 1.4  # so many times as far as points lie apart they are wide: less lets the background through
_EDGE = 1.15  # times as far away as a neighbour
_WITHIN = 8.0  # radii from the middle along each axis: what lies beyond is left out
_FROM = (3.5, 8.0)  # radii from which it is seen at first, at least and at most
_PITCH = (math.radians(15), math.radians(60))  # likewise, how steeply from above
_NOTE = (
    "Points of the model, from where the new photos were taken. Drag to turn; + and − come nearer and go away. "
    "Blue-green: where a thing is now. Dashed orange: where it was."
)


@dataclass(frozen=True)
class _Placed:
    """Where the page's coordinates lie in the world."""

    rotation: Tensor
    """(3, 3) float64: its rows are the page's axes"""
    middle: Tensor
    """(3,) float64, world"""
    radius: float
    """world units"""

    def __call__(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> (..., 3) float64 on the page."""
        return (x.double() - self.middle) @ self.rotation.T / self.radius


def space(views: Sequence[Comparison], objects: Sequence[ObjectChange], world: World | None) -> str:
    """The section; empty if no view tells how far away things are, before and after."""
    seen = [v for v in views if v.frame is not None and v.depth_before is not None and v.depth_after is not None]
    if not seen or not objects:
        return ""
    states = [_points(_of(seen, now)) for now in (False, True)]
    if min(len(xyz) for xyz, _, _ in states) == 0:
        return ""
    places = [_places(o, world) for o in objects]
    middle = torch.stack([box.mean(0) for was_is in places for box in was_is if box is not None]).mean(0)
    a, b = across(up_of(world))
    all_xyz = torch.cat([xyz for xyz, _, _ in states])
    radius = float((all_xyz - middle).norm(dim=-1).median()) / 2
    on_page = _Placed(torch.stack([a, b, torch.linalg.cross(a, b)]), middle, radius)
    told: dict[str, Any] = {
        "within": _WITHIN,
        "from": _first_look(on_page, seen[0]),
        "states": [_packed(on_page(xyz), rgb) for xyz, rgb, _ in states],
        "point": _WIDER * float(torch.cat([apart for _, _, apart in states]).median()) / radius,
        "objects": [[None if box is None else _rounded(on_page(box)) for box in was_is] for was_is in places],
    }
    badges = "".join(_badges(number, o, was_is) for number, (o, was_is) in enumerate(zip(objects, places), 1))
    data = escape(json.dumps(told, separators=(",", ":")))
    label = "The scene in three dimensions; the arrow keys turn it, + and - come nearer and go away"
    return (
        '<section class="in-space" hidden><h2>In 3-D</h2>'
        f'<figure class="space card" data-name="The scene in 3-D" style="--aspect:1.5" data-space="{data}">'
        f'<figcaption><span>{_NOTE}</span><label><input type="checkbox" checked> as it is now</label></figcaption>'
        f'<div class="stage"><canvas width="840" height="560" tabindex="0" role="img" aria-label="{label}"></canvas>'
        f"{badges}</div></figure></section>"
    )


def _of(views: Sequence[Comparison], now: bool) -> list[tuple[Comparison, Tensor, Tensor]]:
    """Views with a state's depths and pictures."""
    found = [(v, v.depth_after, v.after) if now else (v, v.depth_before, v.before) for v in views]
    return [(v, depth, rgb) for v, depth, rgb in found if depth is not None and rgb is not None]


def _points(views: Sequence[tuple[Comparison, Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """World points (P, 3), colours (P, 3) and how far apart they lie (P,), of every so-many-th pixel and row."""
    found = []
    step = math.ceil(math.sqrt(sum(depth.numel() for _, depth, _ in views) / POINTS))
    for v, depth, picture in views:
        assert v.frame is not None
        height, width = depth.shape
        camera = v.frame.camera.scaled(width, height)
        rays, t = camera_rays(camera, v.frame.world_from_cam), depth.reshape(-1).cpu()
        drawn = torch.zeros(height, width, dtype=torch.bool)
        drawn[step // 2 :: step, step // 2 :: step] = True
        there = (_calm(depth.cpu()) & drawn).reshape(-1)
        xyz = rays.origins[there] + rays.directions[there] * t[there, None]
        apart = step * t[there] / math.sqrt(camera.fx * camera.fy)
        found.append((xyz.double(), picture.reshape(-1, 3).cpu()[there], apart))
    xyz, rgb, apart = (torch.cat(part) for part in zip(*found))
    return xyz, rgb, apart


def _calm(depth: Tensor) -> Tensor:
    """(H, W) bool: pixels that show a surface, not beside an edge, where a pixel holds some of what lies behind."""
    nearest, farthest = depths_around(depth.float())
    return farthest < _EDGE * nearest


def _places(o: ObjectChange, world: World | None) -> tuple[Tensor | None, Tensor | None]:
    """The corners (8, 3) of an object's box where it was and where it is."""
    box = upright_box(o.grid, up_of(world)).corners
    if o.kind == "added":
        return None, box
    return box, None if o.new_from_old is None else transform(o.new_from_old.double(), box)


def _badges(number: int, o: ObjectChange, places: tuple[Tensor | None, Tensor | None]) -> str:
    kinds = [kind for kind, box in zip(("was", "is"), places) if box is not None]
    return "".join(f'<b class="no {o.kind} {kind}" aria-hidden="true">{number}</b>' for kind in kinds)


def _first_look(on_page: _Placed, view: Comparison) -> list[float]:
    """Turn, pitch (radians) and distance of the first view, about as its photo was taken."""
    assert view.frame is not None
    x, y, z = on_page(view.frame.world_from_cam[:3, 3]).tolist()
    pitch = min(max(math.atan2(z, math.hypot(x, y)), _PITCH[0]), _PITCH[1])
    return [math.atan2(y, x), pitch, min(max(math.hypot(x, y, z), _FROM[0]), _FROM[1])]


def _packed(xyz: Tensor, rgb: Tensor) -> dict[str, str]:
    """Points as 16 bits a coordinate and 8 a colour, in text."""
    near = (xyz.abs() < _WITHIN).all(-1)
    places = ((xyz[near] / _WITHIN + 1) / 2 * 65535).round().int().numpy().astype("<u2")
    colours = rgb[near] if rgb.dtype == torch.uint8 else (rgb[near].clamp(0, 1) * 255).round().to(torch.uint8)
    return {key: base64.b64encode(v.tobytes()).decode() for key, v in (("xyz", places), ("rgb", colours.numpy()))}


def _rounded(corners: Tensor) -> list[list[float]]:
    return [[round(v, 4) for v in corner] for corner in corners.tolist()]
