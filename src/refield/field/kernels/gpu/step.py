"""A whole training step from the kernels beside this: of fixed shapes, and silent, if it is given a capacity."""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field.kernels.gpu.marching import march_visible
from refield.field.kernels.gpu.networks import hash_field
from refield.field.kernels.gpu.rays import accumulate, contract, distortion, heaviest, ray_ids, weights
from refield.field.kernels.reference import (
    Aim,
    Batch,
    Lattice,
    Networks,
    Space,
    Stepped,
    compared,
    scale_gradient,
    truncated_exp,
)


def train_step(
    batch: Batch,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    aim: Aim,
    into: list[Tensor],
    fine: Tensor | None = None,
    *,
    capacity: int | None = None,
) -> Stepped:
    """See `reference.train_step`.

    With a ``capacity`` nothing is asked of the device: cells, weights and sigmas are (capacity,), the latter two -1
    where there is no sample; rays that found no room are left out of the means; and the loss is a tensor ().
    """
    tables, resolutions, networks = field
    origins, directions, _ = batch.rays
    net = (tables.detach(), resolutions, networks[0].detach(), networks[1][0].detach())
    t0, t1, offsets = march_visible(batch.rays, space, grid, lattice, net, aim.stop, fine, capacity=capacity)
    ids, mid = ray_ids(offsets, len(t0)), (t0 + t1) / 2
    d = directions[ids]
    whole = torch.ones_like(offsets[1:]) if capacity is None else offsets[1:] < capacity
    share = whole / whole.sum().clamp_min(1)
    leaves = [p.detach().requires_grad_() for p in (tables, *networks)]
    ways = [r.detach().requires_grad_(batch.moving > 0) for r in (origins, directions)]
    with torch.enable_grad():
        unit = (contract(ways[0][ids] + ways[1][ids] * mid[:, None], *space) + 2) / 4
        raw, rgbs = hash_field(unit, d, leaves[0], resolutions, tuple(leaves[1:]))  # type: ignore[arg-type]
        sigmas = truncated_exp(raw) / space[1]
        near = (mid / aim.gradient_unit).square().clamp(max=1)
        w = weights(scale_gradient(sigmas, near), t0, t1, offsets)
        shown = accumulate(w, torch.cat([scale_gradient(rgbs, near), torch.ones_like(w)[:, None]], -1), offsets)
        errors = compared(shown, batch)
        s0, s1 = (t / (t + space[1]) for t in (t0, t1))
        off = errors.square().mean(-1)
        spread = distortion(w, s0, s1, offsets)
        if torch.is_tensor(aim.nearness) or aim.nearness:  # most steps ask for none; a graph's is not known here
            spread = spread + aim.nearness * accumulate(w, (1 - (s0 + s1) / 2)[:, None], offsets)[:, 0]
        each = (off if batch.trust is None else batch.trust * off) + aim.distortion * spread
        loss = (share * each).sum()
    grads = torch.autograd.grad(loss, leaves + (ways if batch.moving else []))
    for total, grad in zip(into, grads):
        total += grad
    side = grid.shape[0]
    ijk = (unit.detach() * side).long().clamp_(0, side - 1)
    cells = (ijk[:, 0] * side + ijk[:, 1]) * side + ijk[:, 2]
    w, sigmas, loss = w.detach(), sigmas.detach(), loss.detach()
    to_rays = (grads[-2][: batch.moving], grads[-1][: batch.moving]) if batch.moving else None
    real = torch.arange(len(w), device=w.device) < offsets[-1]
    told = None, shown[:, :3].detach(), errors.detach(), torch.where(whole > 0, heaviest(w, offsets), -1), to_rays
    if capacity is None:
        return Stepped(float(loss), cells, w, sigmas, len(offsets) - 1, *told)
    w, sigmas = torch.where(real, w, -1.0), torch.where(real, sigmas, -1.0)
    return Stepped(loss, cells, w, sigmas, len(offsets) - 1, *told)  # type: ignore[arg-type]
