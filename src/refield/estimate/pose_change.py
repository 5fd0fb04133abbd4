"""An object's pose change T, refined through the field (§4.2.3, §9.3, Eq. 15).

What the photos show is compared with a composite: the object's own samples of the old field, moved by T, over what the
old field shows without the object. Six numbers are improved by damped Gauss–Newton with robust weights, coarse to fine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.correlated import pixels_as_one
from refield.estimate.explain import explained
from refield.estimate.layers import Crop, Layer, Layers, Sight, layers_at
from refield.vision import pixels

FEW = 4
"""new photos, from which on more rays are taken"""
ALL, COARSEST, FINER = slice(None), slice(0, 1), slice(1, None)
"""levels of the refinement"""

_SURE = 1e-3  # of a colour; no picture is more exact
_DARK = 0.02  # what is as dark as this says little about its light
_BRIGHTER = 2.5  # times, at most, that the object may be at its new place
SIDE = 0.35  # of the radius; light on a side is even over this much when a pose is judged


@dataclass(frozen=True)
class RefineConfig:
    """How a pose change is refined through the field."""

    rays: tuple[int, ...] = (8_000, 60_000)
    """over all new photos, coarse to fine; they are scaled down to keep to it. From `FEW` photos on, as many times more
    as there are more of them"""
    blurs: tuple[float, ...] = (1.2, 0.5)
    """pixels, coarse to fine"""
    steps: tuple[int, ...] = (8, 4)
    """Gauss–Newton steps, coarse to fine (the paper: 500 of Adam)"""
    outline: float = 0.4
    """weight of the pixels at and beyond the object's outline"""
    shading: float = 0.12
    """light on the object is even over this part of its radius"""
    shaded: float = 0.8
    """this part of what light may explain is put down to it; the rest holds objects without texture"""
    robust: float = 0.1
    """colour error, in [0, 1] RGB, beyond which a pixel counts less"""
    detail: int = 3
    """old photos that each new one takes texture from that the field has not learnt, from the finest refinement on"""
    detail_rays: int = 80_000
    """over those old photos; they are scaled down to keep to it. More for more new photos, as above"""
    unseen: float = 0.02
    """a turn is unobservable if the photos hold it this much less than a shift of the same size"""


@dataclass(frozen=True)
class PoseChange:
    """T and how well it is known."""

    new_from_old: Tensor
    """(4, 4) float64"""
    covariance: Tensor
    """(6, 6) float64 of the twist about the object's new centre that left-multiplies"""
    residual: float
    """rms colour error of the object's pixels, robust"""
    explained: float
    """part of the object's visible pixels at which the photo shows what the composite does"""
    before: float
    """the same for the old field's unchanged rendering"""
    pixels: int
    """visible pixels of the object, over all photos"""
    pixel: float
    """world size of a pixel at the object"""
    note: str = ""

    @property
    def net(self) -> float:
        """Pixels at which the photos show the object, less those at which they should and do not."""
        return (2 * self.explained - 1) * self.pixels


@dataclass(frozen=True)
class Linear:
    """Residuals about one pose."""

    error: Tensor
    """(M, 3) blurred colour differences"""
    weight: Tensor
    """(M,) of each pixel"""
    slopes: Callable[[], Tensor]
    """what makes the `jacobian`"""

    @cached_property
    def jacobian(self) -> Tensor:
        """(M, 3, 6) by the twist about the object's centre that left-multiplies; most poses are never asked for it."""
        return self.slopes()

    def normal(self, robust: float, unit: Tensor) -> tuple[Tensor, Tensor]:
        """Gauss–Newton's matrix (6, 6) and gradient (6,), in twists measured in ``unit``."""
        w = self.weight / (1 + (self.error**2).sum(-1) / robust**2) ** 2
        j = self.jacobian * unit
        weighted = j * w[:, None, None]
        flat = j.reshape(-1, 6)
        return flat.T @ weighted.reshape(-1, 6), weighted.reshape(-1, 6).T @ self.error.reshape(-1)

    def cost(self, robust: float) -> float:
        """Geman–McClure."""
        q = (self.error**2).sum(-1) / robust**2
        return float((self.weight * q / (1 + q)).sum())


def relit(shown: Layer, crop: Crop, sigma: float, share: float) -> Layer:
    """The object in the smooth light, per channel, in which the photo shows it: what turned is lit differently.

    ``sigma``: pixels over which light is even; ``share``: how much of its change is taken over.
    """
    h, w = crop.shape
    inner = pixels.erode(shown.opacity.reshape(h, w).numpy() > 0.9, 1).astype(np.float32)[..., None]
    seen, own = (pixels.blur(t.reshape(h, w, 3).numpy() * inner, sigma) for t in (crop.photo, shown.own))
    weight = pixels.blur(inner[..., 0], sigma)[..., None]
    gain = np.clip((seen + _DARK * weight) / (own + _DARK * weight + 1e-6), 1 / _BRIGHTER, _BRIGHTER) ** share
    gain = np.where(weight > 0.02, gain, 1).astype(np.float32)
    lit = shown.own * torch.from_numpy(gain.reshape(-1, 3))
    return replace(shown, own=lit, rgb=shown.rgb - shown.own + lit)


def _evened(images: Tensor, inner: NDArray[np.float32], sigma: float) -> Tensor:
    """Colour differences (n, K) without their mean over ``sigma`` pixels inside the object (H, W)."""
    h, w = inner.shape
    smooth = pixels.blur(images.reshape(h, w, -1).numpy() * inner[..., None], sigma)
    smooth = smooth / np.maximum(pixels.blur(inner, sigma), 1e-3)[..., None] * inner[..., None]
    return torch.from_numpy(smooth.reshape(h * w, -1))


def residuals(ready: Layers, new_from_old: Tensor, sigma: float, config: RefineConfig) -> Linear:
    """Blurred colour differences over all crops, and what their derivatives by the six numbers of a twist are."""
    parts = [
        _residuals(ready, crop, shown, new_from_old, sigma, config)
        for crop, shown in zip(ready.crops, ready.show(new_from_old))
    ]
    errors, weights, slopes = zip(*parts)
    return Linear(
        torch.cat(errors).double(), torch.cat(weights).double(), lambda: torch.cat([s() for s in slopes]).double()
    )


def _residuals(
    ready: Layers, crop: Crop, shown: Layer, pose: Tensor, sigma: float, c: RefineConfig
) -> tuple[Tensor, Tensor, Callable[[], Tensor]]:
    shading = c.shading * ready.apparent
    shown = relit(shown, crop, shading, c.shaded)
    ok = ((crop.known | (shown.opacity > 0.9)) & ~shown.hidden)[:, None]
    # an outline is where shape, shadow and haze are wrong together: it counts, but little
    alpha = shown.opacity.reshape(crop.shape).numpy()
    inner = pixels.erode(alpha > 0.9, 1 + int(sigma > 1))
    weight = torch.from_numpy(np.where(inner, 1.0, c.outline).reshape(-1))
    bare = (ready.sides(crop, shown, pose) < 0) & (alpha.reshape(-1) > 0.8)
    weight[torch.from_numpy(bare)] = 0.0  # a face that nobody saw: its colours are accidents
    within = inner.astype(np.float32)

    def compared(images: Tensor) -> Tensor:
        blurred = _blurred(images, crop.shape, sigma)
        return blurred - c.shaded * _evened(blurred, within, shading)

    def slopes() -> Tensor:
        flow = ready.flow(crop, shown, pose) * ok[..., None]
        return compared(flow.reshape(len(flow), -1)).reshape(-1, 3, 6)

    return compared(torch.where(ok, shown.rgb - crop.photo, 0.0)), weight, slopes


def shared_out(rays: int, photos: int) -> int:
    """Rays in all for so many new photos: what each shows is not made coarser by having more of them."""
    return round(rays * max(1.0, photos / FEW))


def refine(
    sight: Sight, start: Tensor, config: RefineConfig = RefineConfig(), levels: slice = ALL
) -> PoseChange | None:
    """Improve T from ``start`` on some of the levels, coarse to fine; None if no photo shows the place."""
    unit = torch.tensor([1.0] * 3 + [1 / max(sight.old.radius, 1e-6)] * 3, dtype=torch.float64)
    pose = start
    for rays, sigma, steps in list(zip(config.rays, config.blurs, config.steps))[levels]:
        ready = layers_at(sight, pose, shared_out(rays, len(sight.past)))
        if not ready.crops:
            return None
        pose, now = _descend(ready, pose, (sigma, steps), unit, config)
    return _described(ready, pose, now, unit, config)


def _descend(
    ready: Layers, pose: Tensor, level: tuple[float, int], unit: Tensor, c: RefineConfig
) -> tuple[Tensor, Linear]:
    """Damped Gauss–Newton at one level; in units in which a turn and a shift move the surface alike."""
    sigma, steps = level
    damping = 1e-3
    now = residuals(ready, pose, sigma, c)
    for _ in range(steps):
        hessian, gradient = now.normal(c.robust, unit)
        if not hessian.trace() > 0:  # the object is behind other things in every photo
            break
        cost, better = now.cost(c.robust), False
        for _ in range(3):
            damped = hessian + torch.diag(damping * hessian.diagonal() + 1e-6 * hessian.trace())
            step = -torch.linalg.solve(damped, gradient)
            step = step * min(1.0, 3 * ready.pixel / float(step.norm().clamp_min(1e-12)))
            trial = ready.moved(pose, step * unit)
            then = residuals(ready, trial, sigma, c)
            better = then.cost(c.robust) < cost
            if better:
                pose, now, damping = trial, then, max(damping / 5, 1e-5)
                break
            damping = max(damping, 1e-2) * 8
        if not better or float(step.norm()) < 0.01 * ready.pixel:
            break
    return pose, now


def _blurred(images: Tensor, shape: tuple[int, int], sigma: float) -> Tensor:
    """(n, K) -> (n, K)."""
    return torch.from_numpy(pixels.blur(images.reshape(*shape, -1).numpy(), sigma).reshape(images.shape))


def _variance(ready: Layers, at: Linear, c: RefineConfig) -> float:
    """Of a pixel's colour error per channel, times how many pixels err as one."""
    weight = at.weight / (1 + (at.error**2).sum(-1) / c.robust**2) ** 2
    told = (at.error * weight.sqrt()[:, None]).split([len(crop.rays) for crop in ready.crops])
    shared = pixels_as_one([e.reshape(*crop.shape, 3).numpy() for e, crop in zip(told, ready.crops)])
    variance = float((at.error**2 * weight[:, None]).sum() / (3 * weight.sum()).clamp_min(1e-9))
    return shared * (variance + _SURE**2)


def _described(ready: Layers, pose: Tensor, now: Linear, unit: Tensor, c: RefineConfig) -> PoseChange:
    """Covariance, what cannot be seen, and how much the composite explains."""
    hessian, _ = now.normal(c.robust, unit)
    size = (now.error**2).sum(-1).sqrt()[now.weight > 0.5]
    noise = (float(size.median()) if len(size) else 1.0) * 1.2 + _SURE
    values, vectors = torch.linalg.eigh(hessian)
    values = values.clamp_min(1e-9 * float(values.max().clamp_min(1e-9)))
    held = torch.linalg.eigvalsh(hessian[3:, 3:]) / torch.linalg.eigvalsh(hessian[:3, :3]).median().clamp_min(1e-9)
    covariance = vectors @ torch.diag(_variance(ready, now, c) / values) @ vectors.T
    covariance = unit[:, None] * covariance * unit[None]
    free = int((held < c.unseen).sum())
    note = f"the photos do not show its turn about {'any axis' if free == 3 else f'{free} of 3 axes'}" if free else ""
    part, before, count = explained(ready.compared(pose), SIDE * ready.apparent)
    return PoseChange(pose, covariance, noise, part, before, count, ready.pixel, note)
