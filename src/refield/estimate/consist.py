"""A newcomer's shape and surface, by the colours that photos agree on (space carving, Kutulakos and Seitz 2000).

What a few silhouettes allow is about twice the object: a pyramid stands on its top, a skirt around its foot. A voxel of
that excess is seen against something else by each photo, so their colours disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from refield.estimate.detect import Mask
from refield.estimate.lattice import Body, Lattice, components
from refield.estimate.look import Array, View
from refield.vision import pixels

_UNLIKE = 10.0  # Lab units between two photos' colours of a point
_ROUNDS = 40
_LONGEST = 40  # voxels along the longest side while carving
_LEAST = 0.15  # of the voxels that must be left, else the colours say nothing


def consistent(body: Body, photos: Sequence[tuple[View, Mask]]) -> Body:
    """What is left of a body once the voxels are taken off, from the outside in, whose colours photos do not agree on.

    Args:
        photos: new views, and the pixels (H, W) of each that show something new.
    """
    labs = [pixels.to_lab(pixels.blur(v.photo, 0.7)) for v, _ in photos]
    where = body.places
    coarse = Lattice.over(where.min(0), where.max(0), _LONGEST, body.lattice.cell)
    left = body.lattice.holds(body.voxels, coarse.centres)
    begin = int(left.sum())
    for _ in range(_ROUNDS):
        at = np.argwhere(left)
        seen = [_shown(v, m, coarse.centres[left], coarse.cell) for v, m in photos]
        wrong = _disagree(seen, labs)
        if not wrong.any():
            break
        left[tuple(at[wrong].T)] = False
    parts = components(left, 8)
    if not parts or parts[0].sum() < _LEAST * begin:
        return body
    return replace(body, voxels=body.voxels & coarse.holds(parts[0], body.lattice.centres))


def colours_of_others(body: Body, photos: Sequence[tuple[View, Mask]]) -> list[Array]:
    """Per photo, the colours that the others show of a body's surface under each pixel, (H, W, 3), the median over
    those that see it; nan where none does.

    Args:
        photos: new views, and the pixels (H, W) of each that show the body.
    """
    points = body.places
    seen = [_shown(view, mask, points, body.lattice.cell) for view, mask in photos]
    shown = [np.where(s[:, None], v.photo[at[:, 1], at[:, 0]], np.nan) for (v, _), (at, s) in zip(photos, seen)]
    out = []
    for i, (view, _) in enumerate(photos):
        at, ours = seen[i]
        others = shown[:i] + shown[i + 1 :]
        picture = np.full((*view.shape, 3), np.nan, np.float32)
        if others:
            order = np.argsort(-np.linalg.norm(points - view.centre, axis=-1))  # the nearest last
            order = order[ours[order]]
            picture[at[order, 1], at[order, 0]] = pixels.median(np.stack(others))[order]
        out.append(picture)
    return out


def _shown(view: View, mask: Mask, points: Array, cell: float) -> tuple[Array, Array]:
    """Pixel (N, 2) int of each point, and whether the photo shows it: nothing of the points stands before it."""
    uv, distance, inside = view.project(points)
    h, w = view.shape
    at = np.clip(uv.astype(np.int64), 0, [w - 1, h - 1])
    front = np.full((h, w), np.inf, np.float32)
    np.minimum.at(front, (at[inside, 1], at[inside, 0]), distance[inside])
    slack = 1.5 * (cell + view.pixel_angle * distance)
    return at, inside & mask[at[:, 1], at[:, 0]] & (distance < front[at[:, 1], at[:, 0]] + slack)


def _disagree(seen: Sequence[tuple[Array, Array]], labs: Sequence[Array]) -> Mask:
    """Points (N,) of which two photos show colours that differ, also from what is a pixel aside."""
    worst = np.zeros(len(seen[0][0]), np.float32)
    for a in range(len(seen)):
        for b in range(a):
            both = np.flatnonzero(seen[a][1] & seen[b][1])
            if len(both):
                one = _nearest(labs[a], seen[a][0][both], labs[b], seen[b][0][both])
                two = _nearest(labs[b], seen[b][0][both], labs[a], seen[a][0][both])
                worst[both] = np.maximum(worst[both], np.minimum(one, two))
    return worst > _UNLIKE


def _nearest(lab: Array, at: Array, other: Array, there: Array) -> Array:
    """Distance (K,) of a pixel's colour to the most similar one around a pixel of another photo."""
    return pixels.nearest_distance(lab[at[:, 1], at[:, 0]], other, there[:, 1], there[:, 0])
