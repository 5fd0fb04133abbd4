"""Rays, or a whole view, through any field → Rendering (Eq. 1), in chunks."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from refield.field.radiance import Field, check_field
from refield.field.volrend import Rendering, Samples, composite
from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays, camera_rays
from refield.scene.errors import expect

CHUNK = 16384  # rays; at 20 samples a ray the activations of a chunk take some 100 MB


def visible_samples(field: Field, rays: Rays, jitter: bool = False) -> Samples:
    """Where to evaluate a field: its own choice (``samples``) if it leaves out what is hidden, else its sampler's."""
    own: Callable[[Rays, bool], Samples] | None = getattr(field, "samples", None)
    return field.sampler(rays, jitter) if own is None else own(rays, jitter)


def render_rays(field: Field, rays: Rays, jitter: bool = False) -> Rendering:
    """Eq. 1 for N rays at once. Differentiable with respect to whatever the field is differentiable in."""
    samples = visible_samples(field, rays, jitter)
    x, d = samples.positions(rays)
    sigmas, rgbs = field(x, d)
    return composite(sigmas, rgbs, samples)


def render_many(field: Field, rays: Rays, chunk: int = CHUNK) -> Rendering:
    """:func:`render_rays` without gradients, ``chunk`` rays at once; the field's own way (``rendered``) if it has one.
    Rays that meet nothing of what a field changed in another (``unchanged``) are that other's."""
    whole: Callable[[Rays, int], Rendering] | None = getattr(field, "rendered", None)
    if whole is not None:
        return whole(rays, chunk)
    with torch.no_grad():
        parts = [_rendered(field, rays[i : i + chunk], chunk) for i in range(0, max(len(rays), 1), chunk)]
        return Rendering.joined(parts)


def _rendered(field: Field, rays: Rays, chunk: int) -> Rendering:
    """Of one chunk."""
    unchanged: Callable[[Rays], tuple[Field, Tensor]] | None = getattr(field, "unchanged", None)
    if unchanged is None:
        return render_rays(field, rays)
    return parted(*unchanged(rays), rays, chunk, lambda rest: render_rays(field, rest))


def parted(before: Field, same: Tensor, rays: Rays, chunk: int, otherwise: Callable[[Rays], Rendering]) -> Rendering:
    """N rays, of which those in ``same`` (N,) bool see what they see in the field ``before``."""
    rows, rest = same.nonzero()[:, 0], (~same).nonzero()[:, 0]
    if len(rest) == 0:
        return render_many(before, rays, chunk)
    if len(rows) == 0:
        return otherwise(rays)
    joined = Rendering.joined([render_many(before, rays[rows], chunk), otherwise(rays[rest])])
    order = torch.cat([rows, rest]).argsort()
    return Rendering(joined.rgb[order], joined.depth[order], joined.opacity[order])


def render_camera(field: Field, camera: Camera, world_from_cam: Tensor, chunk: int = CHUNK) -> Rendering:
    """The view of a posed camera; leading shape (height, width)."""
    rays, device = camera_rays(camera, world_from_cam), field.sampler.grid.device
    rendering = render_many(field, Rays(rays.origins.to(device), rays.directions.to(device)), chunk)
    return rendering.reshape(camera.height, camera.width)


def render_frame(field: Field, frame: Frame, chunk: int = CHUNK) -> Rendering:
    """What the field shows from where a photo was taken; leading shape (height, width)."""
    check_field(field)
    expect("the frame to render", frame, Frame, "a Frame, such as capture.frames[0]")
    return render_camera(field, frame.camera, frame.world_from_cam, chunk)
