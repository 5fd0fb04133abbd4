"""What proposal networks learn: never to say less than the field does (mip-NeRF 360, Sec. 3).

Letters: N rays, K intervals of the field, P intervals of a proposal.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from refield.field.proposal import Histogram

_TINY = 1e-7  # keeps the quotient finite where the field has no weight


def bounds(edges: Tensor, proposal: Histogram) -> Tensor:
    """Sum of the proposal's weights over all its intervals that overlap each of the field's (mip-NeRF 360, Eq. 12).

    Edges (N, K + 1) in s -> (N, K), differentiable in the proposal's weights.
    """
    own = proposal.edges.contiguous()
    last = own.shape[1] - 1
    summed = torch.cat([torch.zeros_like(proposal.weights[:, :1]), proposal.weights.cumsum(-1)], -1)
    first = (torch.searchsorted(own, edges[:, :-1].contiguous(), right=True) - 1).clamp(0, last)
    end = torch.searchsorted(own, edges[:, 1:].contiguous()).clamp(0, last)
    return summed.gather(1, end) - summed.gather(1, torch.minimum(first, end))


def interlevel_loss(field: Histogram, proposals: Sequence[Histogram]) -> Tensor:
    """Mean over rays and intervals of max(0, w - bound)^2 / w, summed over the proposals (mip-NeRF 360, Eq. 13).

    The field's weights are the target: they get no gradient, or it would learn to be easy to propose.
    """
    w = field.weights.detach()
    terms = [(w - bounds(field.edges, p)).clamp_min(0).square() / (w + _TINY) for p in proposals]
    return torch.stack([t.mean() for t in terms]).sum()
