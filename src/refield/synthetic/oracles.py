"""Exact stand-ins at each seam: a field, a segmenter and a matcher that know the world.

They need no renderer. Colours are the textures themselves, without light.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from refield.field.encoding import Contraction
from refield.field.sampling import OccupancySampler
from refield.scene.camera import Camera
from refield.scene.capture import Rays
from refield.scene.pose import invert, transform
from refield.synthetic.placing import FLOOR_HALF
from refield.synthetic.state import Item, State
from refield.synthetic.visibility import Hits, first_hits, view_hits


class AnalyticField:
    """A state as a Field: density rises from 0 on each surface to its full value ``depth`` inside it.

    Nothing leaks outside the solids, so a solid's grid holds all of its density. The light is none: an object
    looks the same wherever it is, which makes the commuting square exact.
    """

    def __init__(self, state: State, *, depth: float = 0.01, sigma: float = 600.0, resolution: int = 192) -> None:
        """``depth`` in metres, ``sigma`` per metre; ``resolution`` of the sampler's grid, a side."""
        self._items, self._depth, self._sigma = state.items, depth, sigma
        self._poses = [invert(item.world_from_item) for item in state.items]
        self._textures = [torch.from_numpy(item.texture).permute(2, 0, 1)[None] for item in state.items]
        middle = (state.items[0].box().mean(0) + torch.tensor([0, 0, 0.4])).float()
        space = Contraction(middle, 1.1 * FLOOR_HALF)
        empty = torch.zeros(resolution, resolution, resolution, dtype=torch.uint8)
        sampler = OccupancySampler(space, empty, depth / 2)
        self._sampler = OccupancySampler(space, self._occupancy(sampler), depth / 2)

    @property
    def sampler(self) -> OccupancySampler:
        return self._sampler

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per metre."""
        return self._density(self._distances(x).amin(0))

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3), unit directions (..., 3) -> sigma (...,), rgb (..., 3) sRGB in [0, 1]."""
        nearest, owner = self._distances(x).min(0)
        rgb = torch.zeros_like(x)
        for i, item in enumerate(self._items):
            mine = owner == i
            if bool(mine.any()):
                uv = item.solid.uv(transform(self._poses[i], x[mine]))
                rgb = rgb.masked_scatter(mine[..., None].expand_as(x), looked_up(self._textures[i], uv))
        return self._density(nearest), rgb

    def _distances(self, x: Tensor) -> Tensor:
        """(items, ...) signed distances."""
        pairs = zip(self._items, self._poses)
        return torch.stack([item.solid.distance(transform(pose, x)) for item, pose in pairs])

    def _density(self, distance: Tensor) -> Tensor:
        return self._sigma * (-distance / self._depth).clamp(0, 1)

    def _occupancy(self, sampler: OccupancySampler) -> Tensor:
        """Exact: the cells whose circumscribed sphere reaches a solid. The solids lie in the core cube."""
        r = sampler.resolution
        reach = 3**0.5 / 2 * sampler.contraction.radius * 4 / r
        near = [
            self._distances(sampler.points_in(cells, jitter=False)).amin(0) <= reach
            for cells in torch.arange(r**3).split(1 << 19)
        ]
        return torch.cat(near).to(torch.uint8).reshape(r, r, r)


def looked_up(texture: Tensor, uv: Tensor) -> Tensor:
    """Bilinear, texel centres at (i + 0.5) / size. texture (1, 3, H, W), uv (K, 2) -> (K, 3)."""
    grid = (uv * 2 - 1)[None, None].to(texture.dtype)
    found = functional.grid_sample(texture, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return found[0, :, 0].T.to(uv.dtype)


@dataclass(frozen=True)
class KnownView:
    """An image of which we know what it shows."""

    image: NDArray[np.uint8]
    """(H, W, 3)"""
    state: State
    camera: Camera
    world_from_cam: Tensor
    """(4, 4) float64"""

    @cached_property
    def hits(self) -> Hits:
        """What each pixel shows, (H, W)."""
        return view_hits(self.state, self.camera, self.world_from_cam)


class _Album:
    """Finds the view that an image belongs to, by its pixels."""

    def __init__(self, views: Iterable[KnownView]) -> None:
        self._views = {_key(view.image): view for view in views}

    def __getitem__(self, image: NDArray[np.uint8] | Tensor) -> KnownView:
        view = self._views.get(_key(np.asarray(image)))
        if view is None:
            raise KeyError("the oracle was not told of this image")
        return view


def _key(image: NDArray[np.uint8]) -> bytes:
    return hashlib.sha256(repr(image.shape).encode() + np.ascontiguousarray(image).tobytes()).digest()


class OracleSegmenter:
    """A Segmenter that looks up which item each pixel shows."""

    sure = 0.5  # IoU of the item's box with the one that was asked about

    def __init__(self, views: Iterable[KnownView]) -> None:
        self._album = _Album(views)

    def features(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(H, W, 3) -> (H, W, C): one channel an item, the last for the background."""
        view = self._album[image]
        count = len(view.state.items)
        channel = torch.where(view.hits.item < 0, count, view.hits.item)
        return functional.one_hot(channel, count + 1).float().numpy()

    def masks(
        self, image: NDArray[np.uint8], boxes: NDArray[np.float64], hint: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Boxes (B, 4) px xyxy -> the item whose box fits best, (B, H, W) bool, and how well (IoU), (B,)."""
        item = self._album[image].hits.item
        shown = [item == i for i in torch.unique(item).tolist() if i > 0]
        blank = torch.zeros_like(item, dtype=torch.bool)
        masks, scores = [], []
        for box in np.asarray(boxes, np.float64).reshape(-1, 4):
            score, mask = max(((_box_iou(_box(m), box), m) for m in shown), key=lambda p: p[0], default=(0.0, blank))
            masks.append(mask.numpy() if score > 0 else blank.numpy())
            scores.append(score)
        return np.array(masks, bool).reshape(-1, *item.shape), np.array(scores)


def _box(mask: Tensor) -> NDArray[np.float64]:
    rows, columns = mask.nonzero().T
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], np.float64)


def _box_iou(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    both = np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None).prod()
    return float(both / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - both))


class OracleMatcher:
    """A Matcher that follows surface points from one state and view to the other."""

    def __init__(self, views: Iterable[KnownView], *, every: int = 2, noise: float = 0.0, seed: int = 0) -> None:
        """Every so-many-th pixel of image_a is a keypoint; ``noise`` in pixels is added to image_b's side."""
        self._album, self._every, self._noise = _Album(views), every, noise
        self._rng = np.random.default_rng(seed)

    def match(
        self, image_a: NDArray[np.uint8], image_b: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(H, W, 3) uint8 each -> (K, 2) px, (K, 2) px, (K,) score; points hidden in image_b are left out."""
        a, b = self._album[image_a], self._album[image_b]
        px_a, px_b = [np.zeros((0, 2))], [np.zeros((0, 2))]
        for i, item in enumerate(a.state.items):
            there = b.state.named(item.name)
            if there is not None:
                pixels, world = self._surface(a, i)
                seen, at = _seen(b, there, transform(there.world_from_item @ invert(item.world_from_item), world))
                px_a.append(pixels[seen].numpy())
                px_b.append(at[seen].numpy())
        found = np.concatenate(px_b)
        found = found + self._rng.normal(0, 1, found.shape) * self._noise
        return np.concatenate(px_a), found, np.ones(len(found))

    def _surface(self, view: KnownView, item: int) -> tuple[Tensor, Tensor]:
        """Pixels (K, 2) that show an item, and the world points they show (K, 3), float64."""
        chosen = torch.zeros_like(view.hits.item, dtype=torch.bool)
        chosen[:: self._every, :: self._every] = True
        rows, columns = (chosen & (view.hits.item == item)).nonzero().T
        pixels = torch.stack([columns, rows], -1).double() + 0.5
        depth = view.hits.depth[rows, columns].double()
        return pixels, transform(view.world_from_cam, view.camera.unproject(pixels) * depth[:, None])


def _seen(view: KnownView, item: Item, world: Tensor) -> tuple[Tensor, Tensor]:
    """Which world points (K, 3) on an item a view sees (K,), and where (K, 2)."""
    at, z = view.camera.project(transform(invert(view.world_from_cam), world))
    size = at.new_tensor([view.camera.width, view.camera.height])
    inside = (z > 0) & (at > 0).all(-1) & (at < size).all(-1)
    centre = view.world_from_cam[:3, 3]
    along = world - centre
    distance = along.norm(dim=-1)
    rays = Rays(centre.expand_as(along), along / distance[:, None])
    hit = first_hits(view.state, rays)
    same = hit.item == [i.name for i in view.state.items].index(item.name)
    return inside & same & ((hit.depth - distance).abs() < 1e-3), at
