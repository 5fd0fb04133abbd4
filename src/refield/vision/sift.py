"""SIFT descriptors (Lowe 2004), as compact as a capture of hundreds of photos needs them, and their matching.

Pixels: the top-left pixel's centre is (0.5, 0.5). Descriptors are root-SIFT (Arandjelović & Zisserman 2012) in bytes,
as COLMAP keeps them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

DIM = 128
_ROWS = 1 << 22  # entries of a table of similarities at a time


@dataclass(frozen=True)
class Features:
    """What is found in one photo."""

    xy: NDArray[np.float32]
    """(N, 2) pixels"""
    descriptors: NDArray[np.uint8]
    """(N, 128)"""

    def __len__(self) -> int:
        return len(self.xy)


def unit(descriptors: NDArray[np.uint8] | Tensor) -> Tensor:
    """Descriptors (N, 128) as unit vectors, float32."""
    rows = torch.tensor(descriptors) if isinstance(descriptors, np.ndarray) else descriptors
    return torch.nn.functional.normalize(rows.float(), dim=1)


def match_mutual(a: Tensor, b: Tensor, ratio: float = 0.8) -> NDArray[np.uint32]:
    """Pairs (K, 2) of rows of ``a`` and ``b``, unit vectors: mutual nearest neighbours that pass Lowe's ratio test."""
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.uint32)
    similar = a @ b.T
    best, at = similar.max(1)
    back = similar.argmax(0)
    rows = torch.arange(len(a))
    similar[rows, at] = -1
    second = similar.max(1).values
    keep = (back[at] == rows) & (1 - best < ratio**2 * (1 - second))
    return torch.stack([rows[keep], at[keep]], 1).numpy().astype(np.uint32)


def match_landmarks(query: Tensor, known: Tensor, owner: Tensor, ratio: float = 0.85) -> tuple[Tensor, Tensor, Tensor]:
    """For each query the landmark it shows, where that is clear.

    Args:
        query: (Q, 128) unit vectors.
        known: (M, 128) unit vectors of landmarks as several photos saw them.
        owner: (M,) which landmark each belongs to: the second nearest of the ratio test is that of another one.

    Returns:
        rows (K,) of ``query``, landmarks (K,), similarity (K,); a landmark that several claim goes to the most similar.
    """
    rows, owners, scores = [], [], []
    for start in range(0, len(query) if len(known) > 1 else 0, max(_ROWS // len(known), 1)):
        similar = query[start : start + max(_ROWS // len(known), 1)] @ known.T
        top, at = similar.topk(min(12, len(known)), dim=1)
        who = owner[at]
        other = torch.where(who != who[:, :1], top, top.new_full((), -1.0)).max(1).values
        keep = (1 - top[:, 0] < ratio**2 * (1 - other)).nonzero()[:, 0]
        rows.append(keep + start)
        owners.append(who[keep, 0])
        scores.append(top[keep, 0])
    if not rows:
        none = torch.zeros(0, dtype=torch.long)
        return none, none, torch.zeros(0)
    return _one_each(torch.cat(rows), torch.cat(owners), torch.cat(scores))


def _one_each(rows: Tensor, owners: Tensor, scores: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    order = scores.argsort(descending=True, stable=True)
    _, first = np.unique(owners[order].numpy(), return_index=True)
    pick = order[torch.from_numpy(np.sort(first))]
    return rows[pick], owners[pick], scores[pick]
