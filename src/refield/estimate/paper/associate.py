"""Which masks show the same object: from view to view, and before and after (§10.2.2; SAM's appendix D.6).

The segmenter's features, averaged inside a mask, say what it shows; their cosine similarities are matched best overall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from refield.estimate.detect import Mask
from refield.estimate.look import Array
from refield.estimate.paper.detect import Pair, ViewMasks


@dataclass(frozen=True)
class Sighting:
    """One mask of one view."""

    pair: Pair
    mask: Mask
    """(H, W) bool, the photo's pixels"""
    score: float
    """the segmenter's"""
    pooled: Array
    """(C,) unit, the features inside the mask"""


@dataclass(frozen=True)
class Thing:
    """An object at one of the two times, as several views show it."""

    sightings: tuple[Sighting, ...]

    @property
    def pooled(self) -> Array:
        """(C,) unit, over its views."""
        return unit(np.sum([s.pooled for s in self.sightings], axis=0))

    @property
    def score(self) -> float:
        """The segmenter's mean."""
        return float(np.mean([s.score for s in self.sightings]))


@dataclass(frozen=True)
class Partners:
    """An object before and after; one side is missing if it left or arrived."""

    gone: Thing | None
    came: Thing | None


def associate(seen: Sequence[ViewMasks], least: float) -> list[Partners]:
    """Group the masks of all views by what they show, and find the partners of what left among what came.

    Args:
        least: cosine similarity below which two are no partners.
    """
    gone = grouped([_sightings(v, v.move_out, v.scores_out, v.pair.render_features) for v in seen])
    came = grouped([_sightings(v, v.move_in, v.scores_in, v.pair.capture_features) for v in seen])
    chosen = [(i, j) for i, j in matched(gone, came) if float(gone[i].pooled @ came[j].pooled) >= least]
    out = [Partners(gone[i], came[j]) for i, j in chosen]
    out += [Partners(g, None) for i, g in enumerate(gone) if i not in {i for i, _ in chosen}]
    return out + [Partners(None, c) for j, c in enumerate(came) if j not in {j for _, j in chosen}]


def grouped(views: Sequence[Sequence[Sighting]]) -> list[Thing]:
    """Sightings of each view -> things. The view with the most masks names them; the others' are matched to those."""
    order = sorted(views, key=lambda v: (-len(v), -sum(s.score for s in v)))
    things = [Thing((s,)) for s in order[0]] if order else []
    for view in order[1:]:
        single = [Thing((s,)) for s in view]
        for i, j in matched(things, single):
            things[i] = Thing((*things[i].sightings, view[j]))
    return things


def matched(a: Sequence[Thing], b: Sequence[Thing]) -> list[tuple[int, int]]:
    """The pairs (index in a, index in b) of the highest total cosine similarity (Hungarian method)."""
    if not a or not b:
        return []
    similar = np.stack([t.pooled for t in a]) @ np.stack([t.pooled for t in b]).T
    rows, columns = linear_sum_assignment(-similar)
    return [(int(i), int(j)) for i, j in zip(rows, columns)]


def pooled(features: Array, mask: Mask) -> Array:
    """Mean of features (h, w, C) inside a mask (H, W), as a unit vector (C,)."""
    h, w = features.shape[:2]
    weight = cv2.resize(mask.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    return unit(np.einsum("hwc,hw->c", features.astype(np.float64), weight))


def unit(v: Array) -> Array:
    """A vector (C,) of length one, or zero."""
    return v / max(float(np.linalg.norm(v)), 1e-12)


def _sightings(view: ViewMasks, masks: Sequence[Mask], scores: Sequence[float], features: Array) -> list[Sighting]:
    return [Sighting(view.pair, m, s, pooled(features, m)) for m, s in zip(masks, scores)]
