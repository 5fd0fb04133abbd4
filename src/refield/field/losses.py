"""What a field is fitted to: colour (Eq. 2), distortion; gradient scaling (§10.1)."""

from __future__ import annotations

from torch import Tensor

from refield.field import kernels
from refield.field.kernels.reference import scale_gradient
from refield.field.volrend import Samples


def colour_loss(errors: Tensor, trust: Tensor | None = None) -> Tensor:
    """Eq. 2 as a mean: what is seen less what the photos show (N, 3), and how much each ray counts (N,) -> ()."""
    return (errors.square() if trust is None else trust[:, None] * errors.square()).mean()


def scale_gradients(sigmas: Tensor, rgbs: Tensor, samples: Samples, unit: float) -> tuple[Tensor, Tensor]:
    """Gradients times min((t / unit)^2, 1): few rays cross what is near a camera; it must not grow floaters (§10.1)."""
    mid = (samples.t_starts + samples.t_ends) / 2
    scale = (mid / unit).square().clamp(max=1.0)
    return scale_gradient(sigmas, scale), scale_gradient(rgbs, scale)


def distortion_loss(w: Tensor, edges: Tensor, samples: Samples) -> Tensor:
    """Mean of mip-NeRF 360's Eq. 15 over N rays, in s, so that far haze counts as near haze does.

    Weights (N * K,) of the ``samples`` between edges (N, K + 1) -> ().
    """
    starts, ends = edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1)
    return kernels.distortion(w, starts, ends, samples.ray_offsets).mean()
