"""What the old field shows from a camera, beside what was photographed there.

Unlike a plain rendering the depth here is the *median* along the ray, where half of the light is stopped: at an
object's edge it belongs to the object or to what is behind, never in between. Everything is in the world frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.field.kernels.reference import EVERYWHERE, Within
from refield.field.radiance import Field
from refield.field.render import CHUNK, visible_samples
from refield.field.sampling import STOP, OccupancySampler
from refield.field.volrend import Samples, composite, weights
from refield.field.warp import crosses, outline
from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays, camera_rays
from refield.scene.change import OccupancyGrid
from refield.scene.images import frame_image, scaled_image
from refield.vision import pixels

Array = NDArray[Any]
Directed = Callable[[Tensor, Tensor], Tensor]
"""World points and directions (S, 3) -> the directions along which to ask for colours, (S, 3)."""

_AT_ONCE = 12  # samples of a ray
_NEGLIGIBLE = 1e-3  # weight of a sample whose colour is not asked for; the sum of what is lost stays below a grey level


@dataclass(frozen=True)
class Hidden:
    """Samples to leave out: what some grids contain."""

    grids: tuple[OccupancyGrid, ...]

    @cached_property
    def _boxes(self) -> list[Tensor]:
        return [outline(g) for g in self.grids]

    def meets(self, rays: Rays) -> Tensor:
        """Whether each ray crosses a box around what is hidden, (N,) bool."""
        return crosses(rays, self._boxes)


@dataclass(frozen=True)
class Seen:
    """What N rays meet."""

    rgb: Tensor
    """(N, 3) float32"""
    depth: Tensor
    """(N,) float32 median distance along the unit direction; inf where less than half the light is stopped"""
    opacity: Tensor
    """(N,) float32"""

    def with_rows(self, rows: Tensor, other: Seen) -> Seen:
        """The same, but for some rays (K,) int64."""
        mine = (self.rgb, self.depth, self.opacity)
        return Seen(*(a.index_copy(0, rows, b) for a, b in zip(mine, (other.rgb, other.depth, other.opacity))))


def see(field: Field, rays: Rays, hidden: Hidden | None = None) -> Seen:
    """Colour, median depth and opacity of rays through the field, without the samples that are ``hidden``."""
    if hidden is None or not hidden.grids:
        return _see_all(field, rays, None)
    near = hidden.meets(rays)
    if near.all():
        return _see_all(field, rays, hidden)
    # what is hidden may uncover what the field's own choice of samples leaves out; other rays need no such care
    rows = (~near).nonzero()[:, 0], near.nonzero()[:, 0]
    parts = [_see_all(field, rays[r], h) for r, h in zip(rows, (None, hidden))]
    order = torch.argsort(torch.cat(rows))
    return Seen(*(torch.cat([getattr(p, n) for p in parts])[order] for n in ("rgb", "depth", "opacity")))


def _see_all(field: Field, rays: Rays, hidden: Hidden | None) -> Seen:
    with torch.no_grad():
        parts = [_see(field, rays[i : i + CHUNK], hidden) for i in range(0, max(len(rays), 1), CHUNK)]
    return Seen(
        torch.cat([p.rgb for p in parts]), torch.cat([p.depth for p in parts]), torch.cat([p.opacity for p in parts])
    )


def _see(field: Field, rays: Rays, hidden: Hidden | None) -> Seen:
    samples, sigmas = _reaching(field, rays, hidden)
    return shaded(field, samples.positions(rays), sigmas, samples)


def surfaces(field: Field, rays: Rays) -> Tensor:
    """The median depth of rays alone, (N,); as `see` finds it."""
    with torch.no_grad():
        parts = [rays[i : i + CHUNK] for i in range(0, max(len(rays), 1), CHUNK)]
        return torch.cat([median_depth(sigmas, samples) for samples, sigmas in (_reaching(field, p) for p in parts)])


def _reaching(field: Field, rays: Rays, hidden: Hidden | None = None) -> tuple[Samples, Tensor]:
    """Samples that light reaches, without those that are ``hidden``, and their densities (S,)."""
    if hidden is None and not hasattr(field, "samples_within"):
        samples = visible_samples(field, rays)
        return samples, field.density(samples.positions(rays)[0])
    return reached(field, field.sampler, rays, () if hidden is None else hidden.grids, inside=False)


def reached(
    field: Field, sampler: OccupancySampler, rays: Rays, grids: Sequence[OccupancyGrid], inside: bool
) -> tuple[Samples, Tensor]:
    """Those of a field's samples that light reaches if there are only those in every one of some grids, or in none of
    them, where ``sampler`` looks; and their densities (S,)."""
    own: Callable[..., tuple[Samples, Tensor]] | None = getattr(field, "samples_within", None)
    if own is not None:
        return own(sampler, rays, _masks(grids, inside))

    def density(x: Tensor) -> Tensor:
        meant = torch.ones(len(x), dtype=torch.bool)
        for grid in grids:
            meant &= grid.contains(x) == inside
        rows = meant.nonzero()[:, 0]
        return x.new_zeros(len(x)).index_copy(0, rows, field.density(x[rows]))

    return _near_to_far(density, sampler(rays), rays)


def _masks(grids: Sequence[OccupancyGrid], inside: bool) -> Within:
    if not grids:
        return EVERYWHERE
    sizes = torch.tensor([g.values.numel() for g in grids])
    return Within(
        torch.stack([g.aabb for g in grids]).float(),
        torch.tensor([tuple(g.values.shape) for g in grids]),
        sizes.cumsum(0) - sizes,
        torch.cat([g.values.flatten() for g in grids]).float(),
        inside,
    )


def _near_to_far(density: Callable[[Tensor], Tensor], every: Samples, rays: Rays) -> tuple[Samples, Tensor]:
    """Those of the samples that light reaches, and their densities (S,); asked for some at a time, until a ray has
    ended: most of what a field holds lies behind its surfaces."""
    first, count = every.ray_offsets[:-1], every.ray_offsets.diff()
    sigmas, depth = torch.zeros(len(every.t_starts)), torch.zeros(len(rays))
    asked = torch.zeros(len(sigmas), dtype=torch.bool)
    ray, begin = (count > 0).nonzero()[:, 0], 0
    while len(ray):
        some = begin + torch.arange(_AT_ONCE)
        there = some < count[ray, None]
        rows, of = (first[ray, None] + some)[there], ray[:, None].expand(-1, _AT_ONCE)[there]
        t0, t1 = every.t_starts[rows], every.t_ends[rows]
        sigmas[rows] = density(rays.origins[of] + rays.directions[of] * ((t0 + t1) / 2)[:, None])
        asked[rows] = True
        depth.index_add_(0, of, sigmas[rows] * (t1 - t0))
        begin += _AT_ONCE
        ray = ray[(count[ray] > begin) & (depth[ray] < STOP)]
    return every.only(asked), sigmas[asked]


def shaded(
    field: Field, at: tuple[Tensor, Tensor], sigmas: Tensor, samples: Samples, along: Directed | None = None
) -> Seen:
    """Composite samples whose densities are known; colours are asked for only where they count."""
    w = weights(sigmas, samples)
    count = (w > _NEGLIGIBLE).nonzero()[:, 0]
    rgbs = torch.zeros(len(w), 3)
    if len(count):
        x, d = at[0][count], at[1][count]
        rgbs[count] = field(x, d if along is None else along(x, d))[1]
    rendering = composite(sigmas, rgbs, samples)
    return Seen(rendering.rgb, median_depth(sigmas, samples), rendering.opacity)


def median_depth(sigmas: Tensor, samples: Samples) -> Tensor:
    """Distance at which the transmittance falls below one half, linear in optical depth within the sample; (N,)."""
    n = len(samples.ray_offsets) - 1
    out = torch.full((n,), torch.inf)
    if len(samples) == 0:
        return out
    delta = samples.t_ends - samples.t_starts
    optical = (sigmas * delta).double()
    after = optical.cumsum(0)
    start = torch.cat([after.new_zeros(1), after])[samples.ray_offsets[:-1]]
    goal = start + float(np.log(2.0))
    index = torch.searchsorted(after, goal).clamp_max(len(samples) - 1)
    found = (index < samples.ray_offsets[1:]) & (after[index] >= goal)
    before = after[index] - optical[index]
    part = ((goal - before) / optical[index].clamp_min(1e-12)).clamp(0, 1).float()
    return torch.where(found, samples.t_starts[index] + part * delta[index], out)


def pixel_slopes(camera: Camera, local: Tensor) -> Tensor:
    """d(u, v) / d(point) of points (N, 3) in the camera's frame, (N, 2, 3), the lens' distortion left out."""
    z = local[:, 2].clamp_min(1e-6)
    zero = torch.zeros_like(z)
    u = torch.stack([camera.fx / z, zero, -camera.fx * local[:, 0] / z**2], -1)
    v = torch.stack([zero, camera.fy / z, -camera.fy * local[:, 1] / z**2], -1)
    return torch.stack([u, v], 1)


@dataclass(frozen=True)
class View:
    """One posed photo beside the old field's rendering of it, at working resolution."""

    frame: Frame
    camera: Camera
    """the frame's, scaled to the working resolution"""
    photo: Array
    """(H, W, 3) as taken, until `detect` carries its colours to the field's"""
    rgb: Array
    """(H, W, 3) the field's"""
    depth: Array
    """(H, W) median distance; inf where the field is empty"""
    opacity: Array
    """(H, W)"""
    colour_fit: NDArray[np.float64] = field(default_factory=lambda: np.stack([np.ones(3), np.zeros(3)]))
    """(2, 3) gain and offset that carried the photo's colours to the field's"""

    @property
    def shape(self) -> tuple[int, int]:
        return self.camera.height, self.camera.width

    @cached_property
    def centre(self) -> Array:
        """Camera centre (3,)."""
        return self.frame.world_from_cam[:3, 3].numpy().astype(np.float32)

    @cached_property
    def rays(self) -> Rays:
        """One ray a pixel, row by row."""
        return camera_rays(self.camera, self.frame.world_from_cam)

    @cached_property
    def directions(self) -> Array:
        """(H, W, 3) unit."""
        return self.rays.directions.numpy().reshape(*self.shape, 3)

    @cached_property
    def surface(self) -> Array:
        """World point under each pixel, (H, W, 3); not finite where the field is empty."""
        with np.errstate(invalid="ignore"):
            return self.centre + self.directions * self.depth[..., None]

    @cached_property
    def _taken(self) -> Array:
        """The photo as its frame has it, (H, W, 3) uint8."""
        return frame_image(self.frame).numpy()

    def photo_at(self, camera: Camera, box: tuple[int, int, int, int]) -> Array:
        """A rectangle (x0, y0, x1, y1) of the photo as ``camera``, the frame's own scaled down, would take it,
        (h, w, 3); its colours as `photo` has them."""
        photo, (x0, y0, x1, y1) = self._taken, box
        if photo.shape[:2] != (camera.height, camera.width):
            photo = cv2.resize(photo, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        gain, offset = self.colour_fit
        return np.clip(photo[y0:y1, x0:x1].astype(np.float32) / 255 * gain + offset, 0, 1).astype(np.float32)

    @cached_property
    def pixel_angle(self) -> float:
        """Width of a pixel in radians, at the middle of the image."""
        return 1.0 / self.camera.fx

    def project(self, points: Array) -> tuple[Array, Array, Array]:
        """World (..., 3) -> pixels (..., 2), distances (...,) along the ray, and whether inside the image."""
        m = self.frame.world_from_cam
        x = torch.from_numpy(np.ascontiguousarray(points, np.float32))
        local = (x - m[:3, 3].float()) @ m[:3, :3].float()
        uv, z = self.camera.project(local)
        h, w = self.shape
        inside = (z > 1e-6) & (uv >= 0).all(-1) & (uv[..., 0] < w) & (uv[..., 1] < h)
        return uv.numpy(), local.norm(dim=-1).numpy(), inside.numpy()

    def shows(self, points: Array, within: float) -> tuple[Array, Array]:
        """World (..., 3) -> pixels (..., 2), and whether the old surface there is the points', (...,): no further from
        them than this part of their distance."""
        uv, distance, inside = self.project(points)
        return uv, inside & (np.abs(self.lookup(self.depth, uv, inside) - distance) < within * distance)

    def lookup(self, image: Array, uv: Array, inside: Array) -> Array:
        """Nearest pixel's value at ``uv`` (..., 2); that of pixel (0, 0) outside the image."""
        j = np.where(inside, uv[..., 0], 0).astype(np.int64)
        i = np.where(inside, uv[..., 1], 0).astype(np.int64)
        return image[i, j]


def view_of(radiance: Field, frame: Frame, max_pixels: int) -> View:
    """Load one photo and render the old field beside it.

    A photo that is not there yet shows what ``radiance`` does where a thing has another shape since, and elsewhere,
    light included, is as it was taken; so is the picture beside it.
    """
    camera, made = frame.camera.within(max_pixels), frame.made
    rays, shape = camera_rays(camera, frame.world_from_cam), (camera.height, camera.width)
    if made is None:
        seen = see(radiance, rays)
        photo = scaled_image(frame, camera)
    else:  # the field that a photo was taken for is the faster one
        was, near = see(made.before, rays), made.near(rays).nonzero()[:, 0]
        seen = was.with_rows(near, see(radiance, rays[near]))
        photo = made.at(camera, *(s.rgb.reshape(*shape, 3).clamp(0, 1) for s in (was, seen)))
    return View(
        frame,
        camera,
        photo.numpy(),
        seen.rgb.reshape(*shape, 3).clamp(0, 1).numpy(),
        seen.depth.reshape(shape).numpy(),
        seen.opacity.reshape(shape).numpy(),
    )


def full_size(mask: Array, frame: Frame) -> Tensor:
    """A mask (h, w) at the size of its photo, (H, W) bool."""
    return torch.from_numpy(pixels.enlarged(mask, (frame.camera.height, frame.camera.width)))


def spread_out(frames: Sequence[Frame], count: int) -> list[Frame]:
    """``count`` frames that differ most in where they stand and look, by farthest-point choice."""
    if len(frames) <= count:
        return list(frames)
    centres = torch.stack([f.centre for f in frames])
    scale = (centres - centres.mean(0)).norm(dim=-1).mean().clamp_min(1e-9)
    signature = torch.cat([centres / scale, torch.stack([f.world_from_cam[:3, 2] for f in frames])], -1)
    chosen = [0]
    nearest = (signature - signature[0]).norm(dim=-1)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (signature - signature[chosen[-1]]).norm(dim=-1))
    return [frames[i] for i in sorted(chosen)]
