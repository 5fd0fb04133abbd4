"""VLAD (Jégou et al. 2010): one vector per photo from its own SIFT descriptors, to find photos of the same place.

It takes the place of NetVLAD (§10.2.1), which needs downloaded weights; the words are learnt from the capture itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

WORDS = 64
_SAMPLE = 40_000
_ROUNDS = 12


def learn_words(descriptors: Sequence[Tensor], words: int = WORDS) -> Tensor:
    """k-means centres (K, D) of a sample of the photos' descriptors (N, D), unit vectors; K is less where N is."""
    everything = torch.cat(list(descriptors))
    pick = torch.from_numpy(np.random.default_rng(0).permutation(len(everything))[:_SAMPLE])
    sample = everything[pick]
    centres = sample[:words].clone()
    for _ in range(_ROUNDS):
        nearest = _nearest(sample, centres)
        total = torch.zeros_like(centres).index_add_(0, nearest, sample)
        count = torch.bincount(nearest, minlength=len(centres))[:, None]
        centres = torch.where(count > 0, total / count.clamp_min(1), centres)
    return centres


def vlad(descriptors: Tensor, words: Tensor) -> Tensor:
    """(N, D) unit vectors, (K, D) -> (K * D,) unit vector: how descriptors lie about their words; zeros without any."""
    if len(descriptors) == 0:
        return torch.zeros(words.numel())
    nearest = _nearest(descriptors, words)
    residual = torch.nn.functional.normalize(descriptors - words[nearest], dim=1)
    total = torch.zeros_like(words).index_add_(0, nearest, residual)
    total = torch.nn.functional.normalize(total, dim=1).flatten()
    return torch.nn.functional.normalize(total, dim=0)


def _nearest(rows: Tensor, centres: Tensor) -> Tensor:
    return (rows @ centres.T - 0.5 * centres.square().sum(1)).argmax(1)
