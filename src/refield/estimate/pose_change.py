"""An object's pose change T, refined through the field (§4.2.3, §9.3, Eq. 15).

What the photos show is compared with a composite: the object's own samples of the old field, moved by T, over what the
old field shows without the object. Six numbers are improved by damped Gauss–Newton with robust weights, blurred first,
since a hash grid's own gradients oscillate; a rendering's change with T is that its object layer slides over the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from refield.estimate.alone import object_alone
from refield.estimate.explain import Compared, explained
from refield.estimate.look import load_photo, see
from refield.estimate.objects import Old, box_in, patch_rays
from refield.estimate.past import Past
from refield.field.radiance import Field
from refield.scene.camera import Camera
from refield.scene.capture import Rays
from refield.scene.pose import exp, invert, rigid, skew, transform
from refield.vision import pixels


@dataclass(frozen=True)
class RefineConfig:
    """How a pose change is refined through the field."""

    rays: int = 12_000
    """over all new photos; they are scaled down to keep to it"""
    blurs: tuple[float, ...] = (1.2, 0.6)
    """pixels, coarse to fine"""
    steps: int = 6
    """Gauss–Newton steps at each blur (the paper: 500 of Adam)"""
    margin: int = 5
    """pixels around the object that are compared too"""
    outline: float = 0.2
    """weight of the pixels at and beyond the object's outline"""
    shading: float = 0.35
    """colour differences smoother than this part of the object's radius are put down to light"""
    shaded: float = 0.8
    """and taken off to this part; the rest holds objects without texture"""
    robust: float = 0.06
    """colour error, in [0, 1] RGB, beyond which a pixel counts less"""
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


@dataclass(frozen=True)
class _Crop:
    """A rectangle of one new photo around the object's new place."""

    camera: Camera
    world_from_cam: Tensor
    rays: Rays
    shape: tuple[int, int]
    photo: Tensor
    """(n, 3)"""
    behind: Tensor
    """(n, 3) the old field's colour without the objects"""
    depth: Tensor
    """(n,) and its depth"""
    known: Tensor
    """(n,) whether that is what was seen by old photos"""
    unchanged: Tensor
    """(n, 3) the old field's rendering as it was"""
    threshold: Tensor
    """(n,) Lab units"""


@dataclass(frozen=True)
class _Shown:
    rgb: Tensor
    """(n, 3) the composite"""
    layer: Tensor
    """(n, 3) the object's own part of it, premultiplied"""
    opacity: Tensor
    depth: Tensor


@dataclass(frozen=True)
class Linear:
    """Residuals about one pose."""

    error: Tensor
    """(M, 3) blurred colour differences"""
    weight: Tensor
    """(M,) of each pixel"""
    jacobian: Tensor
    """(M, 3, 6) by the twist about the object's centre that left-multiplies"""

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


@dataclass(frozen=True)
class _Even:
    """Takes the smooth part off colour differences inside the object: an object that turned is lit differently."""

    inner: Tensor
    """(H, W) 1 well inside the object"""
    sigma: float
    share: float
    """how much of the smooth part is taken off"""

    def __call__(self, image: Tensor) -> Tensor:
        h, w = self.inner.shape
        inside = self.inner.numpy()
        kept = image.reshape(h, w, 3).numpy() * inside[..., None]
        total = pixels.blur(inside, self.sigma)
        smooth = pixels.blur(kept, self.sigma) / np.maximum(total, 1e-3)[..., None]
        return image - torch.from_numpy((self.share * smooth * inside[..., None]).reshape(-1, 3))


@dataclass(frozen=True)
class Refiner:
    """Composites of one object over the new photos, as a function of T."""

    field: Field
    old: Old
    crops: tuple[_Crop, ...]
    config: RefineConfig
    pixel: float
    """world size of a pixel at the object"""

    @property
    def apparent(self) -> float:
        """The object's radius in pixels."""
        return self.old.radius / self.pixel

    @cached_property
    def centre(self) -> Tensor:
        return torch.from_numpy(self.old.centre).double()

    def show(self, crop: _Crop, new_from_old: Tensor) -> _Shown:
        """The moved object over the fixed background (Eqs. 1, 3)."""
        alone = object_alone(self.field, self.old, crop.rays, new_from_old)
        seen, depth, opacity = alone.rgb, alone.depth, alone.opacity
        front = ((crop.depth - depth) > -self.pixel * 2) & (opacity > 0.02)
        o = torch.where(front, opacity, torch.zeros_like(opacity))[:, None]
        rgb = torch.where(front[:, None], seen, torch.zeros_like(seen))
        return _Shown(rgb + (1 - o) * crop.behind, rgb, o[:, 0], depth)

    def sides(self, crop: _Crop, shown: _Shown, new_from_old: Tensor) -> NDArray[np.int64]:
        """The side of the object at each pixel (n,); -1 where it is not, or no old photo saw what is there."""
        out = np.full(len(shown.depth), -1)
        solid = (shown.opacity > 0.8) & torch.isfinite(shown.depth)
        x = crop.rays.origins[solid] + crop.rays.directions[solid] * shown.depth[solid, None]
        out[solid.numpy()] = self.old.side_of(transform(invert(new_from_old), x).numpy())
        return out

    def compared(self, crop: _Crop, new_from_old: Tensor) -> Compared:
        """What `explained` asks for."""
        shown = self.show(crop, new_from_old)
        photo, composite, unchanged = (
            t.reshape(*crop.shape, 3).numpy() for t in (crop.photo, shown.rgb, crop.unchanged)
        )
        threshold = crop.threshold.reshape(crop.shape).numpy()
        sides = self.sides(crop, shown, new_from_old).reshape(crop.shape)
        return Compared(photo, composite, unchanged, threshold, sides)

    def residuals(self, new_from_old: Tensor, sigma: float, slopes: bool = True) -> Linear:
        """Blurred colour differences over all crops, and their derivatives by the six numbers of a twist."""
        parts = [self._residuals(crop, new_from_old, sigma, slopes) for crop in self.crops]
        return Linear(*(torch.cat([p[k] for p in parts]).double() for k in range(3)))

    def _residuals(self, crop: _Crop, pose: Tensor, sigma: float, slopes: bool) -> tuple[Tensor, Tensor, Tensor]:
        shown = self.show(crop, pose)
        ok = (crop.known | (shown.opacity > 0.9))[:, None]
        zero = torch.zeros_like(shown.rgb)
        e = _blurred(torch.where(ok, shown.rgb - crop.photo, zero), crop.shape, sigma)
        # an outline is where shape, shadow and haze are wrong together: it counts, but little
        alpha = shown.opacity.reshape(crop.shape).numpy()
        inner = pixels.erode(alpha > 0.9, 1 + int(sigma > 1))
        weight = torch.from_numpy(np.where(inner, 1.0, self.config.outline).reshape(-1))
        bare = (self.sides(crop, shown, pose) < 0) & (alpha.reshape(-1) > 0.8)
        weight[torch.from_numpy(bare)] = 0.0  # a face that nobody saw: its colours are accidents
        even = _Even(
            torch.from_numpy(inner.astype(np.float32)), self.config.shading * self.apparent, self.config.shaded
        )
        e = even(e)
        if not slopes:
            return e, weight, zero[:, :1]
        flow = self._flow(crop, shown, transform(pose, self.centre)) * ok[..., None]
        columns = [even(_blurred(flow[..., k], crop.shape, sigma)) for k in range(6)]
        return e, weight, torch.stack(columns, -1)

    def _flow(self, crop: _Crop, shown: _Shown, centre: Tensor) -> Tensor:
        """Change of the composite with a twist about ``centre``, (n, 3, 6): its object layer slides over the image."""
        h, w = crop.shape
        alpha, layer = shown.opacity.reshape(h, w).numpy(), shown.layer.reshape(h, w, 3).numpy()
        seen = shown.depth.reshape(h, w).numpy()
        # beyond the outline the layer slides along with its nearest pixel
        _, nearest = ndimage.distance_transform_edt(~((alpha > 0.5) & np.isfinite(seen)), return_indices=True)
        depth = torch.from_numpy(seen[nearest[0], nearest[1]].reshape(-1)).double()
        depth = torch.where(torch.isfinite(depth), depth, torch.ones_like(depth))
        x = crop.rays.origins.double() + crop.rays.directions.double() * depth[:, None]
        per_point = _pixel_slopes(crop, x)
        per_twist = torch.cat([per_point, per_point @ -skew(x - centre)], -1)
        dv, du = np.gradient(np.concatenate([layer, alpha[..., None]], -1), axis=(0, 1))
        slope = torch.from_numpy(np.stack([du, dv], -1).reshape(h * w, 4, 2)).double()
        slid = -slope @ per_twist
        return (slid[:, :3] - slid[:, 3:] * crop.behind[:, :, None]).float()

    def moved(self, new_from_old: Tensor, twist: Tensor) -> Tensor:
        """T turned and shifted by a twist about the object's current centre."""
        c = transform(new_from_old, self.centre)
        shift = rigid(torch.eye(3, dtype=torch.float64), c)
        return shift @ exp(twist) @ invert(shift) @ new_from_old


def refiner(
    field: Field, old: Old, past: Sequence[Past], olds: Sequence[Old], start: Tensor, config: RefineConfig
) -> Refiner:
    """Prepare the photos around the place where ``start`` puts the object."""
    corners = transform(start, torch.cartesian_prod(*old.grid.tight_aabb().T.double())).numpy()
    boxes = []
    for p in past:
        box = box_in(p.view.frame.camera, p.view.frame, corners, config.margin)
        if box is not None:
            boxes.append((p, box))
    total = sum((b[2] - b[0]) * (b[3] - b[1]) for _, b in boxes)
    shrink = min(1.0, (config.rays / max(total, 1)) ** 0.5)
    crops, footprint = [], []
    for p, _ in boxes:
        c = p.view.frame.camera
        camera = c if shrink == 1 else c.scaled(round(c.width * shrink), round(c.height * shrink))
        box = box_in(camera, p.view.frame, corners, config.margin)
        if box is not None:
            crops.append(_crop(field, p, olds, camera, box))
            distance = float(np.linalg.norm(corners.mean(0) - p.view.centre))
            footprint.append(distance / camera.fx)
    return Refiner(field, old, tuple(crops), config, float(np.median(footprint)) if footprint else 1e-3)


def _crop(field: Field, p: Past, olds: Sequence[Old], camera: Camera, box: tuple[int, int, int, int]) -> _Crop:
    x0, y0, x1, y1 = box
    rays = patch_rays(camera, p.view.frame, box)
    fit = p.view.colour_fit
    photo = np.clip(load_photo(p.view.frame, camera)[y0:y1, x0:x1] * fit[0] + fit[1], 0, 1).astype(np.float32)
    tests = [o.hidden() for o in olds]
    hidden = (lambda x: torch.stack([t(x) for t in tests]).any(0)) if tests else None
    seen = see(field, rays, hidden)
    same = (camera.height, camera.width) == p.view.shape
    unchanged = p.view.rgb[y0:y1, x0:x1] if same else see(field, rays).rgb.numpy().reshape(y1 - y0, x1 - x0, 3)
    h, w = p.view.shape
    rows = ((np.arange(y0, y1) + 0.5) * h / camera.height).astype(int)
    cols = ((np.arange(x0, x1) + 0.5) * w / camera.width).astype(int)
    pick = np.ix_(rows, cols)
    return _Crop(
        camera,
        p.view.frame.world_from_cam,
        rays,
        (y1 - y0, x1 - x0),
        torch.from_numpy(photo.reshape(-1, 3)),
        seen.rgb,
        seen.depth,
        torch.from_numpy(p.known[pick].reshape(-1)),
        torch.from_numpy(np.ascontiguousarray(unchanged).reshape(-1, 3)),
        torch.from_numpy(p.changed.threshold[pick].reshape(-1)),
    )


def refine(r: Refiner, start: Tensor) -> PoseChange:
    """Improve T from ``start``; the best state at the finest blur is kept."""
    c = r.config
    pose = start
    scale = max(r.old.radius, 1e-6)
    unit = torch.tensor([1.0, 1.0, 1.0, 1 / scale, 1 / scale, 1 / scale], dtype=torch.float64)
    hessian = torch.eye(6, dtype=torch.float64)
    for sigma in c.blurs:
        pose, hessian = _descend(r, pose, sigma, unit)
    return _described(r, pose, hessian, unit)


def _descend(r: Refiner, pose: Tensor, sigma: float, unit: Tensor) -> tuple[Tensor, Tensor]:
    """Damped Gauss–Newton at one blur; in units in which a turn and a shift move the surface alike."""
    c, damping = r.config, 1e-3
    now = r.residuals(pose, sigma)
    for _ in range(c.steps):
        hessian, gradient = now.normal(c.robust, unit)
        cost, better = now.cost(c.robust), False
        for _ in range(3):
            damped = hessian + torch.diag(damping * hessian.diagonal() + 1e-6 * hessian.trace())
            step = -torch.linalg.solve(damped, gradient)
            step = step * min(1.0, 3 * r.pixel / float(step.norm().clamp_min(1e-12)))
            trial = r.moved(pose, step * unit)
            then = r.residuals(trial, sigma)
            better = then.cost(c.robust) < cost
            if better:
                pose, now, damping = trial, then, max(damping / 5, 1e-5)
                break
            damping = max(damping, 1e-2) * 8
        if not better or float(step.norm()) < 0.01 * r.pixel:
            break
    return pose, now.normal(c.robust, unit)[0]


def _blurred(image: Tensor, shape: tuple[int, int], sigma: float) -> Tensor:
    """(n, 3) -> (n, 3)."""
    return torch.from_numpy(pixels.blur(image.reshape(*shape, 3).numpy(), sigma).reshape(-1, 3))


def _pixel_slopes(crop: _Crop, x: Tensor) -> Tensor:
    """d(u, v) / d(world point), (n, 2, 3), the lens' distortion left out."""
    m = crop.world_from_cam
    p = (x - m[:3, 3]) @ m[:3, :3]
    z = p[:, 2].clamp_min(1e-6)
    zero = torch.zeros_like(z)
    u = torch.stack([crop.camera.fx / z, zero, -crop.camera.fx * p[:, 0] / z**2], -1)
    v = torch.stack([zero, crop.camera.fy / z, -crop.camera.fy * p[:, 1] / z**2], -1)
    return torch.stack([u, v], 1) @ m[:3, :3].T


def _described(r: Refiner, pose: Tensor, hessian: Tensor, unit: Tensor) -> PoseChange:
    """Covariance, what cannot be seen, and how much the composite explains."""
    c = r.config
    now = r.residuals(pose, c.blurs[-1], slopes=False)
    size = (now.error**2).sum(-1).sqrt()[now.weight > 0.5]
    noise = (float(size.median()) if len(size) else 1.0) * 1.2 + 1e-3
    values, vectors = torch.linalg.eigh(hessian)
    values = values.clamp_min(1e-9 * float(values.max().clamp_min(1e-9)))
    held = torch.linalg.eigvalsh(hessian[3:, 3:]) / torch.linalg.eigvalsh(hessian[:3, :3]).median().clamp_min(1e-9)
    # neighbouring pixels share their error: about this many count as one
    shared = 4 * np.pi * max(c.blurs[-1], 0.5) ** 2 + 4
    covariance = vectors @ torch.diag(noise**2 * shared / values) @ vectors.T
    covariance = unit[:, None] * covariance * unit[None]
    free = int((held < c.unseen).sum())
    note = f"the photos do not show its turn about {'any axis' if free == 3 else f'{free} of 3 axes'}" if free else ""
    part, before, count = explained([r.compared(crop, pose) for crop in r.crops], c.shading * r.apparent)
    return PoseChange(pose, covariance, noise, part, before, count, r.pixel, note)
