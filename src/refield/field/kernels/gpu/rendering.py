"""Pictures from the kernels beside this."""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field.kernels.gpu.marching import march_visible
from refield.field.kernels.gpu.networks import hash_field
from refield.field.kernels.gpu.rays import accumulate, contract, ray_ids, weights
from refield.field.kernels.reference import Lattice, Networks, Rays3, Space, seen, to_be_seen, truncated_exp


def render(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    stop: float,
    fine: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.render`."""
    tables, resolutions, networks = field
    with torch.no_grad():
        net = (tables, resolutions, networks[0], networks[1][0])
        t0, t1, offsets = march_visible(rays, space, grid, lattice, net, stop, fine)
        ids, mid = ray_ids(offsets, len(t0)), (t0 + t1) / 2
        d = rays[1][ids]
        raw, rgbs = hash_field((contract(rays[0][ids] + d * mid[:, None], *space) + 2) / 4, d, *field)
        sigmas = truncated_exp(raw) / space[1]
        w = weights(sigmas, t0, t1, offsets)
        return seen(accumulate(w, to_be_seen(w, sigmas, rgbs, t0, t1), offsets))
