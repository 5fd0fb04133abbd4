"""What a hypothesis of what changed leaves unexplained in the new photos: one number, to compare hypotheses by.

Each pixel is asked how far its photo is from the picture that the hypothesis makes, beside what counts as a change
there; beyond that its cost grows as the field's own errors become seldom. What may show anything, since something came
or nobody knows what is behind, costs less than what is wrong, and more than what is right. Each body costs as much in
every photo that shows it, and less where it went: a pose is six numbers, whatever the shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from refield.estimate.arrive import shadows_of
from refield.estimate.cost import CAME, UNKNOWN, price, wrongness
from refield.estimate.detect import Mask, difference
from refield.estimate.explain import LIMIT, Compared, relit
from refield.estimate.ground import Ground
from refield.estimate.lattice import Body
from refield.estimate.look import Array
from refield.estimate.objects import Old
from refield.estimate.past import Past, silhouette
from refield.estimate.pose_change import SIDE, PoseChange
from refield.scene.pose import invert, transform


@dataclass(frozen=True)
class Settled:
    """What became of everything that changed."""

    moved: dict[int, PoseChange] = field(default_factory=dict)
    """by index of the old object"""
    removed: dict[int, float] = field(default_factory=dict)
    """by index of the old object: part of its pixels that show what was behind"""
    arrived: tuple[Body, ...] = ()
    views: tuple[Past, ...] = ()
    olds: tuple[Old, ...] = ()
    """the old objects, those that were found again without what cannot be theirs"""
    touched: tuple[int, ...] = ()
    """indices of those that may have moved or left"""
    came: tuple[float, ...] = ()
    """of what arrived: pixels that are explained by it, as a part of those that show it"""
    led: dict[int, float] = field(default_factory=dict)
    """by index of the old object: pixels that the best other answer for it does not explain and this one does, as a
    part of those that show it or show where it was"""
    left: tuple[Array, ...] = field(default=(), compare=False)
    """(H, W) of each photo, what is left unexplained of its pixels"""
    twins: dict[int, tuple[PoseChange, ...]] = field(default_factory=dict)
    """by index of the old object that moved: other poses at its place that explain as much"""

    @property
    def gone(self) -> list[Old]:
        """The old objects that are no longer where they were."""
        return [self.olds[k] for k in (*self.moved, *self.removed)]


def judged(ground: Ground, settled: Settled) -> tuple[Settled, float]:
    """The hypothesis without newcomers that explain no more than they cost; and what it costs: what it leaves
    unexplained over all new photos, in pixels that are as wrong as a pose may be, and its bodies.

    A newcomer is asked for where a photo shows it and what it stands before is known.
    """
    found = [_left(ground, settled, p) for p in settled.views]
    left, tells = [e for e, _, _ in found], [t for _, t, _ in found]
    arrived, came, cost, smallest = [], [], 0.0, ground.believe.smallest
    for one in settled.arrived:
        shown = shadows_of(settled.views, one)
        gain = sum(float((e[here & t] - CAME).sum()) for here, t, e in zip(shown, tells, left))
        least = price(shown, smallest)
        if gain > least:
            cost += least
            arrived.append(one)
            came.append(gain / sum(int(here.sum()) for here in shown))
            left = [np.where(here, CAME, e) for here, e in zip(shown, left)]
    for k in (*settled.moved, *settled.removed):
        cost += price((silhouette(p.view, settled.olds[k]) for p in settled.views), smallest)
    cost += sum(price(shown, smallest, moved=True) for shown in zip(*(placed for _, _, placed in found)))
    told = replace(settled, arrived=tuple(arrived), came=tuple(came), left=tuple(left))
    return told, cost + sum(float(e.sum()) for e in left)


def unexplained_at(ground: Ground, settled: Settled) -> Callable[[Old | Body, float], float]:
    """How much the hypothesis leaves unexplained where something was, newcomers left out.

    Returns:
        of something that was, and a part of its pixels: the pixels that are left, over all photos; 0 if they are fewer
        than it costs that it left, or than that part.
    """
    wrong = [_left(ground, settled, p)[0] for p in settled.views]

    def left(one: Old | Body, least: float) -> float:
        shown = [silhouette(p.view, one) for p in settled.views]
        much = sum(float(w[s].sum()) for w, s in zip(wrong, shown))
        enough = max(least * sum(int(s.sum()) for s in shown), price(shown, ground.believe.smallest))
        return much if much > enough else 0.0

    return left


def _left(ground: Ground, settled: Settled, p: Past) -> tuple[Array, Mask, list[Mask]]:
    """(H, W) what is left unexplained of each pixel of a photo, but for what arrived; the pixels of which it is known
    what they show without that; and those that show each of the objects that moved."""
    picture, anything = p.rgb, p.was & ~p.known
    depth, moved, placed = p.beyond, np.zeros(p.view.shape, bool), []
    for k, change in settled.moved.items():
        picture, depth, shown, bare = _before(ground, settled.olds[k], change, p, picture, depth)
        anything, moved = (anything & ~shown) | bare, moved | shown
        placed.append(shown)
    apart = difference(p.view, picture, ground.detect)
    # never seen in this light, nor by these cameras
    left = wrongness(apart, p.changed.threshold * np.where(moved, LIMIT, 1))
    left = np.where(anything, UNKNOWN, np.where(p.asked, left, 0)).astype(np.float32)
    return left, p.asked & ~anything, placed


def _before(
    ground: Ground, old: Old, change: PoseChange, p: Past, picture: Array, depth: Array
) -> tuple[Array, Array, Mask, Mask]:
    """The picture (H, W, 3) and its depth with a moved object in it, in the light in which the photo shows it; the
    pixels that show it, and those of them that show what no old photo saw of it."""
    view, pose = p.view, change.new_from_old
    alone = ground.object_alone(old, view, change)
    own, alpha, at = (t.reshape(*view.shape, -1).numpy() for t in (alone.rgb, alone.opacity, alone.depth))
    front = at[..., 0] <= depth + 2 * view.pixel_angle * np.where(np.isfinite(depth), depth, 0)
    alpha = np.where(front, alpha[..., 0], 0)
    shown = alpha > 0.5
    made = np.where(front[..., None], own + (1 - alpha[..., None]) * picture, picture).astype(np.float32)
    sides = np.full(view.shape, -1)
    x = view.centre + view.directions[shown] * at[shown]
    sides[shown] = old.side_of(transform(invert(pose), torch.from_numpy(x)).numpy())
    known = Compared(view.photo, made, view.rgb, p.changed.threshold, sides)
    away = float(np.linalg.norm(transform(pose, torch.from_numpy(old.centre).double()).numpy() - view.centre))
    made = relit(known, SIDE * old.radius / (away * view.pixel_angle))
    return made, np.where(shown, at[..., 0], depth), shown, shown & (sides < 0)


def pixels_of(ground: Ground, settled: Settled, k: int) -> int:
    """How many pixels of the new photos show an object, or show where it was."""
    there = sum(int(silhouette(p.view, settled.olds[k]).sum()) for p in settled.views)
    return there + (pixels_at(ground, settled, k) if k in settled.moved else 0)


def gained_apart(ground: Ground, best: Settled, other: Settled) -> float:
    """How much less another hypothesis leaves unexplained than the best one where anything is or was of which the two
    tell otherwise that it moved or left, newcomers not counted among such things."""
    apart = [np.zeros(p.view.shape, bool) for p in other.views]
    for k in {*best.moved, *best.removed, *other.moved, *other.removed}:
        if _tells(best, k) != _tells(other, k):
            for one in (best, other):
                if k in one.moved or k in one.removed:
                    apart = [a | shown for a, shown in zip(apart, shown_or_was(ground, one, k))]
    return sum(float((was - now)[where].sum()) for was, now, where in zip(best.left, other.left, apart))


def _tells(settled: Settled, k: int) -> tuple[object, ...]:
    """What a hypothesis says of an object, to be compared by identity."""
    return (k in settled.removed, id(settled.moved.get(k)), id(settled.olds[k]) if k < len(settled.olds) else None)


def shown_or_was(ground: Ground, settled: Settled, k: int) -> list[Mask]:
    """Per photo, the pixels (H, W) that show an object, or show where it was."""
    was = [silhouette(p.view, settled.olds[k]) for p in settled.views]
    return [a | b for a, b in zip(was, _at(ground, settled, k))] if k in settled.moved else was


def pixels_at(ground: Ground, settled: Settled, k: int) -> int:
    """How many pixels of the new photos show an object that moved."""
    return sum(int(shown.sum()) for shown in _at(ground, settled, k))


def _at(ground: Ground, settled: Settled, k: int) -> list[Mask]:
    """Per photo, the pixels (H, W) that show an object that moved."""
    old, change = settled.olds[k], settled.moved[k]
    return [_before(ground, old, change, p, p.rgb, p.beyond)[2] for p in settled.views]
