"""Outlines that hold more than one thing: where a coloured surface is most likely two.

Things that touch are one to whoever carves them. Where they meet the surface is hollow or its colour changes, and the
border is short beside what it parts: the normalised cut (Shi and Malik 2000) of the graph of neighbouring points. A
thing of one piece has such a cut too, so both sides are guesses, for the photos to judge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.spatial import cKDTree

from refield.estimate.lattice import some_of
from refield.estimate.objects import Cloud, Old
from refield.estimate.outline import FEWEST_POINTS, ObjectConfig, restricted
from refield.vision import pixels

_NEIGHBOURS = 8
_LOOSE = 1e-6  # weight between neighbours that are nothing alike: the graph stays in one piece


def halves(old: Old, config: ObjectConfig) -> list[tuple[Old, Old]]:
    """Each side of the best cut through an object, with the other; none if one of them could not be found again."""
    if len(old.cloud.points) < 2 * FEWEST_POINTS:
        return []
    side = _best_cut(alike(old.cloud))
    nearest = cKDTree(old.cloud.points).query(old.lattice.centres[old.voxels])[1]
    one, other = (restricted(old, some_of(old.voxels, mine[nearest]), config) for mine in (side, ~side))
    enough = min(len(o.cloud.points) for o in (one, other)) >= FEWEST_POINTS
    return [(one, other), (other, one)] if enough else []


def alike(cloud: Cloud) -> csc_matrix:
    """(N, N) how alike neighbouring points are: near, alike in colour and not across a hollow, each beside what
    is usual on this surface."""
    count = len(cloud.points)
    apart, to = (a[:, 1:].ravel() for a in cKDTree(cloud.points).query(cloud.points, _NEIGHBOURS + 1))
    at = np.repeat(np.arange(count), _NEIGHBOURS)
    along = (cloud.points[to] - cloud.points[at]) / np.maximum(apart, 1e-12)[:, None]
    hollow = np.maximum(-((cloud.normals[to] - cloud.normals[at]) * along).sum(-1), 0)
    lab = pixels.to_lab(cloud.colours[None])[0]
    unlike = np.linalg.norm(lab[to] - lab[at], axis=-1)
    cost = sum(d / max(float(d.mean()), 1e-12) for d in (apart, hollow, unlike))
    weights = coo_matrix((np.exp(-cost) + _LOOSE, (at, to)), (count, count)).tocsc()
    return weights.maximum(weights.T)


def _best_cut(weights: csc_matrix) -> NDArray[np.bool_]:
    """(N,) one side of the least normalised cut along the second eigenvector."""
    degree = np.asarray(weights.sum(1)).ravel()
    scale = diags(degree**-0.5)
    alike = (scale @ weights @ scale).toarray()  # a sparse solver does not converge where pieces hardly hang together
    second = eigh(alike, subset_by_index=[len(degree) - 2, len(degree) - 2])[1][:, 0]
    order = np.argsort(second / np.sqrt(degree))
    # going along the order, a point that changes sides takes its weights to the others across the border
    rows = weights[order][:, order].tocoo()
    later = rows.col > rows.row
    border = np.cumsum(
        np.bincount(rows.row, rows.data * later, len(order)) - np.bincount(rows.row, rows.data * ~later, len(order))
    )[:-1]
    inside = np.cumsum(degree[order])
    cost = border / inside[:-1] + border / (inside[-1] - inside[:-1])
    least = len(order) // 12
    first = least + int(cost[least : len(order) - least].argmin())
    side = np.zeros(len(order), bool)
    side[order[: first + 1]] = True
    return side
