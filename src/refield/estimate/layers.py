"""A moved object as a layer over what the old field shows without it, in every new photo, and how it slides.

The object's own samples of the old field, moved by T, over a background that T does not change. Its change with T is
that the layer slides over the image: a hash grid's own gradients oscillate, those of its pictures do not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from refield.estimate.alone import object_alone, sampler_around
from refield.estimate.carve_kernels import Window
from refield.estimate.detail import Detail
from refield.estimate.drawn import drawn
from refield.estimate.explain import Compared, Explained, explained
from refield.estimate.kept import Kept
from refield.estimate.lattice import grown
from refield.estimate.look import Array, Hidden, Seen, pixel_slopes, see
from refield.estimate.objects import Old, box_in, patch_rays
from refield.estimate.past import Past
from refield.field.radiance import Field
from refield.field.sampling import OccupancySampler
from refield.scene.camera import Camera
from refield.scene.capture import Rays
from refield.scene.pose import exp, invert, rigid, skew, transform

_MARGIN = 5  # pixels around the object that are compared too


@dataclass(frozen=True)
class Sight:
    """An object, and the photos that may show where it is now."""

    field: Field
    old: Old
    past: Sequence[Past]
    olds: Sequence[Old]
    """all objects that are taken out of the old field"""
    detail: Detail | None = None
    """what the field's pictures of the object lack"""


@dataclass(frozen=True)
class Crop:
    """A rectangle of one new photo around the object's new place."""

    photo_index: int
    """which of the photos"""
    camera: Camera
    """the photo's, scaled"""
    box: tuple[int, int, int, int]
    """x0, y0, x1, y1 in pixels of ``camera``"""
    world_from_cam: Tensor
    rays: Rays
    photo: Tensor
    """(n, 3)"""
    known: Tensor
    """(n,) whether what is behind was seen by old photos"""
    threshold: Tensor
    """(n,) Lab units"""
    beyond: Tensor
    """(n,) depth of the old field without the objects that left, no finer than the working size"""
    placed: Tensor
    """(n,) depth of the objects that were placed already, as fine; inf where none is"""

    @property
    def shape(self) -> tuple[int, int]:
        return self.box[3] - self.box[1], self.box[2] - self.box[0]


@dataclass(frozen=True)
class Layer:
    """The composite in one crop."""

    rgb: Tensor
    """(n, 3) the composite"""
    own: Tensor
    """(n, 3) the object's own part of it, premultiplied"""
    opacity: Tensor
    depth: Tensor
    behind: Tensor
    """(n, 3) what the old field shows without the objects"""
    hidden: Tensor
    """(n,) bool: an object that was placed already stands in front, and the photo shows that"""


@dataclass(frozen=True)
class Layers:
    """Composites of one object over the new photos, as a function of T."""

    sight: Sight
    crops: tuple[Crop, ...]
    pixel: float
    """world size of a pixel at the object"""
    by_points: bool = False
    """the object is drawn by its surface points, not looked up in the field"""

    @property
    def old(self) -> Old:
        return self.sight.old

    @property
    def apparent(self) -> float:
        """The object's radius in pixels."""
        return self.old.radius / self.pixel

    @cached_property
    def centre(self) -> Tensor:
        return torch.from_numpy(self.old.centre).double()

    @cached_property
    def _sizes(self) -> list[int]:
        return [len(c.rays) for c in self.crops]

    @cached_property
    def _rays(self) -> Rays:
        return Rays(*(torch.cat([getattr(c.rays, n) for c in self.crops]) for n in ("origins", "directions")))

    @cached_property
    def _sampler(self) -> OccupancySampler:
        return sampler_around(self.sight.field, self.old)

    @cached_property
    def _known(self) -> bool:
        """Whether the field was rendered at the same size already, or a larger one."""
        return all(c.camera.width <= self.sight.past[c.photo_index].view.camera.width for c in self.crops)

    def _cut(self, image_of: Callable[[Past], Array]) -> Tensor:
        """The crops' part of pictures (H, W, 3) that are known, (N, 3)."""
        parts = []
        for c in self.crops:
            x0, y0, x1, y1 = c.box
            image: Array = image_of(self.sight.past[c.photo_index])
            if image.shape[:2] != (c.camera.height, c.camera.width):  # as the photo is scaled down
                image = cv2.resize(image, (c.camera.width, c.camera.height), interpolation=cv2.INTER_AREA)
            parts.append(image[y0:y1, x0:x1].reshape(-1, 3))
        return torch.from_numpy(np.concatenate(parts))

    @cached_property
    def _plain(self) -> Seen:
        """What the old field shows."""
        return see(self.sight.field, self._rays)

    @cached_property
    def _before(self) -> Tensor:
        """(N, 3) its colours."""
        return self._cut(lambda p: p.view.rgb) if self._known else self._plain.rgb

    @cached_property
    def _behind(self) -> tuple[Tensor, Tensor]:
        """Colour (N, 3) and depth (N,) without the objects."""
        if self._known:
            return self._cut(lambda p: p.rgb), torch.cat([c.beyond for c in self.crops])
        hidden = Hidden(tuple(o.haze for o in self.sight.olds))
        near = hidden.meets(self._rays).nonzero()[:, 0]
        seen = self._plain.with_rows(near, see(self.sight.field, self._rays[near], hidden))
        return seen.rgb, seen.depth

    @cached_property
    def _placed(self) -> Tensor:
        """(N,) depth of the objects that were placed already."""
        return torch.cat([c.placed for c in self.crops])

    def show(self, new_from_old: Tensor) -> list[Layer]:
        """The moved object over the fixed background, per crop (Eqs. 1, 3)."""
        return self._shown.get((new_from_old,), partial(self._show, new_from_old))

    @cached_property
    def _shown(self) -> Kept[list[Layer]]:
        """The pose that is improved, and those that are tried beside it."""
        return Kept(4)

    def _show(self, new_from_old: Tensor) -> list[Layer]:
        alone = self._alone(new_from_old)
        behind, beyond = self._behind
        hidden = self._placed < alone.depth
        front = self._in_front(alone, beyond) & ~hidden
        opacity = torch.where(front, alone.opacity, torch.zeros_like(alone.opacity))
        own = torch.where(front[:, None], alone.rgb, torch.zeros_like(alone.rgb))
        if self.sight.detail is not None:
            own = own + self._lacking(self.sight.detail, opacity, alone.depth, new_from_old)
        rgb = own + (1 - opacity)[:, None] * behind
        parts = (t.split(self._sizes) for t in (rgb, own, opacity, alone.depth, behind, hidden))
        return [Layer(*p) for p in zip(*parts)]

    def cover(self, new_from_old: Tensor) -> list[Tensor]:
        """The moved object's opacity (n,) per crop, where it is in front; nothing but the object is rendered."""
        alone = self._alone(new_from_old)
        front = self._in_front(alone, torch.cat([c.beyond for c in self.crops]))
        return list(torch.where(front, alone.opacity, 0.0).split(self._sizes))

    def _alone(self, new_from_old: Tensor) -> Seen:
        if self.by_points:
            return drawn(self.old.cloud, new_from_old, self._windows, 2 * self.pixel)
        return object_alone(self.sight.field, self.old, self._rays, new_from_old, self._sampler)

    @cached_property
    def _windows(self) -> list[Window]:
        depths = [c.beyond.reshape(c.shape).numpy() for c in self.crops]
        return [Window(c.camera, c.world_from_cam, d, c.box[:2]) for c, d in zip(self.crops, depths)]

    def _in_front(self, alone: Seen, beyond: Tensor) -> Tensor:
        return ((beyond - alone.depth) > -self.pixel * 2) & (alone.opacity > 0.02)

    def _lacking(self, detail: Detail, opacity: Tensor, depth: Tensor, new_from_old: Tensor) -> Tensor:
        """The detail at each pixel (N, 3), premultiplied, as each new photo sees it."""
        out, start = torch.zeros(len(depth), 3), 0
        back = invert(new_from_old)
        for crop in self.crops:
            at = slice(start, start + len(crop.rays))
            start = at.stop
            solid = ((opacity[at] > 0.5) & torch.isfinite(depth[at])).nonzero()[:, 0]
            x = crop.rays.origins[solid] + crop.rays.directions[solid] * depth[at][solid, None]
            lacking = detail.at(transform(back, x), transform(back, crop.world_from_cam[:3, 3]))
            out[at][solid] = lacking * opacity[at][solid, None]
        return out

    def sides(self, crop: Crop, shown: Layer, new_from_old: Tensor) -> NDArray[np.int64]:
        """The side of the object at each pixel (n,); -1 where it is not, or no old photo saw what is there."""
        out = np.full(len(shown.depth), -1)
        solid, x = self.places(crop, shown, new_from_old)
        out[solid] = self.old.side_of(x)
        return out

    def places(self, crop: Crop, shown: Layer, new_from_old: Tensor) -> tuple[NDArray[np.bool_], Array]:
        """Which pixels (n,) show the object, and the points (K, 3) of it, at its old place, that these show."""
        solid = (shown.opacity > 0.8) & torch.isfinite(shown.depth)
        x = crop.rays.origins[solid] + crop.rays.directions[solid] * shown.depth[solid, None]
        return solid.numpy(), transform(invert(new_from_old), x).numpy()

    def explained_of(self, parts: Sequence[Old], new_from_old: Tensor, sigma: float) -> list[Explained]:
        """`explained`, asked of each of some parts of the object by itself: of the pixels alone that show it, in a
        light of their own."""
        told = self.compared(new_from_old)
        seen = [self.places(crop, shown, new_from_old) for crop, shown in zip(self.crops, self.show(new_from_old))]
        out = []
        for part in parts:
            asked, body = [], grown(part.voxels, 1)
            for photo, (solid, x) in zip(told, seen):
                mine = np.zeros(photo.sides.size, bool)
                mine[solid] = part.lattice.holds(body, x)
                asked.append(replace(photo, sides=np.where(mine.reshape(photo.sides.shape), photo.sides, -1)))
            out.append(explained(asked, sigma))
        return out

    def compared(self, new_from_old: Tensor) -> list[Compared]:
        """What `explained` asks for, per crop."""
        before = self._before.split(self._sizes)
        out = []
        for crop, shown, old in zip(self.crops, self.show(new_from_old), before):
            photo, composite, unchanged = (t.reshape(*crop.shape, 3).numpy() for t in (crop.photo, shown.rgb, old))
            sides = self.sides(crop, shown, new_from_old).reshape(crop.shape)
            threshold = crop.threshold.reshape(crop.shape).numpy()
            out.append(Compared(photo, composite, unchanged, threshold, sides))
        return out

    def flow(self, crop: Crop, shown: Layer, new_from_old: Tensor) -> Tensor:
        """Change of the composite with a twist about its centre, (n, 3, 6): its layer slides over the photo."""
        h, w = crop.shape
        alpha, layer = shown.opacity.reshape(h, w).numpy(), shown.own.reshape(h, w, 3).numpy()
        seen = shown.depth.reshape(h, w).numpy()
        # beyond the outline the layer slides along with its nearest pixel
        _, nearest = ndimage.distance_transform_edt(~((alpha > 0.5) & np.isfinite(seen)), return_indices=True)
        depth = torch.from_numpy(seen[nearest[0], nearest[1]].reshape(-1)).double()
        depth = torch.where(torch.isfinite(depth), depth, torch.ones_like(depth))
        x = crop.rays.origins.double() + crop.rays.directions.double() * depth[:, None]
        m = crop.world_from_cam
        per_point = pixel_slopes(crop.camera, (x - m[:3, 3]) @ m[:3, :3]) @ m[:3, :3].T
        per_twist = torch.cat([per_point, per_point @ -skew(x - transform(new_from_old, self.centre))], -1)
        dv, du = np.gradient(np.concatenate([layer, alpha[..., None]], -1), axis=(0, 1))
        slope = torch.from_numpy(np.stack([du, dv], -1).reshape(h * w, 4, 2)).double()
        slid = -slope @ per_twist
        return (slid[:, :3] - slid[:, 3:] * shown.behind[:, :, None]).float()

    def moved(self, new_from_old: Tensor, twist: Tensor) -> Tensor:
        """T turned and shifted by a twist about the object's current centre."""
        c = transform(new_from_old, self.centre)
        shift = rigid(torch.eye(3, dtype=torch.float64), c)
        return shift @ exp(twist) @ invert(shift) @ new_from_old


def layers_at(sight: Sight, start: Tensor, rays: int, turning: bool = False) -> Layers:
    """The photos around the place where ``start`` (4, 4) puts the object, scaled down to ``rays`` in all; ``turning``:
    with room for it however it is rotated there."""
    extent = sight.old.grid.tight_aabb().double()
    if turning:
        centre = torch.from_numpy(sight.old.centre)
        reach = (torch.from_numpy(sight.old.lattice.centres[sight.old.voxels]) - centre).norm(dim=-1).max().expand(3)
        extent, start = torch.stack([-reach, reach]), rigid(torch.eye(3).double(), transform(start, centre.double()))
    corners = transform(start, torch.cartesian_prod(*extent.T.double())).numpy()
    boxes = [(p, box_in(p.view.frame.camera, p.view.frame, corners, _MARGIN)) for p in sight.past]
    total = sum((b[2] - b[0]) * (b[3] - b[1]) for _, b in boxes if b is not None)
    shrink = min(1.0, (rays / max(total, 1)) ** 0.5)
    crops, footprint = [], []
    for k, (p, full) in enumerate(boxes):
        if full is None:
            continue
        c = p.view.frame.camera
        camera = c if shrink == 1 else c.shrunk(shrink)
        box = box_in(camera, p.view.frame, corners, _MARGIN)
        if box is not None:
            crops.append(_crop(k, p, camera, box))
            footprint.append(float(np.linalg.norm(corners.mean(0) - p.view.centre)) / camera.fx)
    return Layers(sight, tuple(crops), float(np.median(footprint)) if footprint else 1e-3)


def _crop(index: int, p: Past, camera: Camera, box: tuple[int, int, int, int]) -> Crop:
    x0, y0, x1, y1 = box
    photo = p.view.photo_at(camera, box)
    h, w = p.view.shape
    rows = ((np.arange(y0, y1) + 0.5) * h / camera.height).astype(int)
    cols = ((np.arange(x0, x1) + 0.5) * w / camera.width).astype(int)
    pick = np.ix_(rows, cols)
    return Crop(
        index,
        camera,
        box,
        p.view.frame.world_from_cam,
        patch_rays(camera, p.view.frame, box),
        torch.from_numpy(photo.reshape(-1, 3)),
        torch.from_numpy(p.known[pick].reshape(-1)),
        torch.from_numpy(p.changed.threshold[pick].reshape(-1)),
        torch.from_numpy(p.beyond[pick].reshape(-1)),
        torch.from_numpy(np.where(p.covered, p.depth, np.inf).astype(np.float32)[pick].reshape(-1)),
    )
