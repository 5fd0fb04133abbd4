"""Which pixels may teach the helper, and in what colour (Fig. 12, §10.1.3).

New photos: every pixel whose ray meets the region. Old photos: a ring around where the objects were seen, without
what is there now and without the objects' shadow; a photo whose mask is unsure is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refield.field.pixels import PixelBank
from refield.field.radiance import Field
from refield.field.render import render_many
from refield.field.sampling import OccupancySampler
from refield.scene.capture import Frame, Rays, camera_rays
from refield.scene.change import OccupancyGrid, SceneChange
from refield.update.light import Relighting
from refield.update.region import meets
from refield.vision.pixels import dilate, enlarged, fit_colours

_UNTOUCHED_MARGIN = 0.03  # of the width: changed areas grow by this before colours are compared across visits
_PIXELS = 1 << 18  # of a photo; more add time and nothing to learn
_EXPOSURE_PIXELS = 4000  # a photo: enough for six numbers
_BETTER = 1.2, 1e-3  # an exposure is believed that makes the median error so many times less, and so much (of 1) less
_MADE = 20  # of the old photos that an earlier visit put out of date; each takes longer to put right than to learn from
_RING_ASKED = 1 << 20  # of the old photos' pixels, whether their rays meet the region
_RING_RAYS = 40_000  # of the old photos; more add time and nothing to learn


@dataclass(frozen=True)
class SuperviseConfig:
    """Which pixels teach."""

    shadow: float = 0.01
    """Old photos: pixels this near to an object's mask, in image widths, may hold its shadow."""  # §10.1.3
    far: float = 0.15
    """Old photos: pixels further away than this, in image widths, do not teach."""  # §10.1.3
    held_out: int = 20
    """every so-many-th pixel of the new photos is kept to judge by: nothing is fitted to it"""
    exposure: bool = True
    """bring the new photos to the old ones' exposure; the paper's helper has an appearance embedding"""


@dataclass(frozen=True)
class Lessons:
    """Pixels that training may draw, as rays and the colours they should show."""

    rays: Rays
    rgb: Tensor
    """(N, 3) float32, in the old photos' exposure"""
    photo: Tensor
    """(N,) int64: index of the new photo, or -1 for an old one"""
    place: Tensor
    """(N,) int64: the pixel's place in its photo, row by row"""
    held: Tensor
    """(N,) bool: kept to judge by; nothing is ever fitted to it"""

    def __len__(self) -> int:
        return len(self.rgb)

    def __getitem__(self, chosen: Tensor | slice) -> Lessons:
        parts = (part[chosen] for part in (self.rgb, self.photo, self.place, self.held))
        return Lessons(self.rays[chosen], *parts)

    @property
    def taught(self) -> Lessons:
        """Those that something may be fitted to."""
        return self[(~self.held).nonzero()[:, 0]]

    @property
    def judging(self) -> Lessons:
        """Those that are kept to judge by."""
        return self[self.held.nonzero()[:, 0]]

    def followed_by(self, more: Lessons) -> Lessons:
        """These and then more."""
        origins = torch.cat([self.rays.origins, more.rays.origins])
        directions = torch.cat([self.rays.directions, more.rays.directions])
        mine, others = ((s.rgb, s.photo, s.place, s.held) for s in (self, more))
        return Lessons(Rays(origins, directions), *(torch.cat(parts) for parts in zip(mine, others)))

    def within(self, masks: Sequence[np.ndarray]) -> Tensor:
        """Which pixels are in the mask (H, W) bool of their new photo, (N,) bool."""
        out = torch.zeros(len(self), dtype=torch.bool)
        for i, mask in enumerate(masks):
            mine = (self.photo == i).nonzero()[:, 0]
            out[mine] = torch.from_numpy(mask.reshape(-1))[self.place[mine]]
        return out


@dataclass(frozen=True)
class Place:
    """Where an object was or is."""

    masks: tuple[Tensor | None, ...]
    """What the estimate saw of it in the old training photos; may be empty"""
    grid: OccupancyGrid
    """The object, there"""
    arrived_only: bool
    """An added object's: nothing stood there before"""

    def mask(self, index: int | None, frame: Frame) -> np.ndarray | None:
        """In an old photo, (H, W) bool; None if the estimate was unsure. ``index`` is its own among the training
        photos; of others (None) the estimate knows nothing."""
        if index is not None and index < len(self.masks):
            mask = self.masks[index]
            return None if mask is None else mask.numpy()
        return self.silhouette(frame)

    def silhouette(self, frame: Frame) -> np.ndarray:
        """Where the object projects in a photo, hidden or not, (H, W) bool."""
        return silhouette((self.grid,), frame)


def silhouette(grids: Sequence[OccupancyGrid], frame: Frame) -> np.ndarray:
    """Where what any of the grids holds projects in a photo, hidden or not, (H, W) bool."""
    camera = frame.camera.within(_PIXELS)
    rays = camera_rays(camera, frame.world_from_cam)
    hit = torch.zeros(len(rays), dtype=torch.bool)
    for grid in grids:
        hit |= grid.met_by(rays)
    return enlarged(hit.reshape(camera.height, camera.width).numpy(), (frame.camera.height, frame.camera.width))


@dataclass(frozen=True)
class Places:
    """All objects' old and new places."""

    was: tuple[Place, ...]
    now: tuple[Place, ...]


def places_of(change: SceneChange) -> Places:
    """The old and the new places of a change's objects."""
    was = [Place(o.masks, o.grid, False) for o in change.objects if o.kind != "added"]
    now = [Place(o.masks_in, g, o.kind == "added") for o in change.objects if (g := o.grid_now) is not None]
    return Places(tuple(was), tuple(now))


def old_ring(places: Places, index: int, frame: Frame, shadow: float, far: float) -> Tensor | None:
    """Pixels of an old training photo that may teach, (H, W) bool; None if a mask of it is unsure (§10.1.3).

    ``shadow`` and ``far`` are the reach of the two dilations in image widths: around the objects' old masks, pixels
    beyond the first and within the second, where nothing moved in. An added object has its ring around its new place.
    """
    was, now = (united(p, index, frame) for p in (places.was, places.now))
    added = united(tuple(p for p in places.now if p.arrived_only), index, frame)
    if was is None or now is None or added is None:
        return None
    width = frame.camera.width
    blocked = dilate(was, math.ceil(shadow * width)) | dilate(now, 1)
    return torch.from_numpy(dilate(was | added, math.ceil(far * width)) & ~blocked)


def united(places: tuple[Place, ...], index: int | None, frame: Frame) -> np.ndarray | None:
    """All the objects' masks in an old photo, (H, W), as of `Place.mask`; None if one is unsure."""
    total = np.zeros((frame.camera.height, frame.camera.width), bool)
    for place in places:
        mask = place.mask(index, frame)
        if mask is None:
            return None
        total |= mask
    return total


def changed_pixels(change: SceneChange, places: Places, index: int, frame: Frame) -> np.ndarray:
    """Pixels of a used new photo that show what arrived or what left, (H, W) bool."""
    total = np.zeros((frame.camera.height, frame.camera.width), bool)
    for place in places.was + places.now:
        total |= place.silhouette(frame)
    shrunk = frame.camera.width / frame.camera.within(_PIXELS).width
    total = dilate(total, math.ceil(shrunk) - 1)  # the edge of what was drawn smaller is not exact
    for masks in (change.masks_in, change.masks_out):
        if index < len(masks):
            total |= masks[index].numpy()
    return total


def new_lessons(
    frames: Sequence[Frame],
    field: Field,
    changed: Sequence[np.ndarray],
    config: SuperviseConfig,
    draw: torch.Generator,
) -> Lessons:
    """The new photos' pixels, in the old photos' exposure; of large photos some of them. Which are kept to judge
    by is drawn here, once for all that follows.

    ``field`` is the old one with the objects cut out and moved, ``changed`` each photo's `changed_pixels`.
    """
    bank = PixelBank(frames, masks=[_thinned(f) for f in frames])
    everything = torch.arange(len(bank))
    held = torch.rand(len(bank), generator=draw) * max(config.held_out, 2) < 1  # something has to be left to learn from
    out = Lessons(
        bank.rays(everything), bank.colours(everything), bank.frame_of(everything), bank.place_of(everything), held
    )
    if not config.exposure:
        return out
    wide = [dilate(mask, math.ceil(_UNTOUCHED_MARGIN * mask.shape[1])) for mask in changed]
    told = ~out.within(wide) & ~held
    for i in range(len(frames)):
        mine = slice(int(bank.starts[i]), int(bank.starts[i + 1]))
        some = told[mine].nonzero()[:, 0]
        some = mine.start + some[:: max(1, len(some) // _EXPOSURE_PIXELS)]
        affine = exposure(out.rgb[some], render_many(field, out.rays[some]).rgb)
        out.rgb[mine] = (out.rgb[mine] * affine[0] + affine[1]).clamp(0, 1)
    return out


def _thinned(frame: Frame) -> Tensor | None:
    """(H, W) bool, `_PIXELS` of a photo's pixels at random; None if it has no more."""
    h, w = frame.camera.height, frame.camera.width
    if h * w <= _PIXELS:
        return None
    kept = torch.zeros(h * w, dtype=torch.bool)
    kept[torch.randperm(h * w, generator=torch.Generator().manual_seed(0))[:_PIXELS]] = True
    return kept.reshape(h, w)


def exposure(photo: Tensor, rendered: Tensor) -> Tensor:
    """Gain and offset a channel, (2, 3) float32, that bring a new photo to the old photos' colours.

    Unchanged pixels ``photo`` and ``rendered`` (P, 3). Identity where it is within what a field's own error could
    feign.
    """
    affine = torch.from_numpy(fit_colours(photo[None].numpy(), rendered[None].numpy())).float()
    before = (photo - rendered).abs().median()
    after = (photo * affine[0] + affine[1] - rendered).abs().median()
    worth = before > _BETTER[0] * after + _BETTER[1]
    return affine if bool(worth) else torch.tensor([[1.0] * 3, [0.0] * 3])


def old_lessons(
    frames: Sequence[Frame],
    places: Places,
    field: Field,
    region: OccupancySampler,
    config: SuperviseConfig,
    light: Relighting | None,
    draw: torch.Generator,
) -> Lessons:
    """Ring pixels of the old photos whose rays meet the region, in the new light; ``field`` is the old one."""
    asked = _asked(frames)
    bank = PixelBank([frames[i] for i in asked])
    chosen = [torch.zeros(0, dtype=torch.long)]
    for k, i in enumerate(asked):
        ring = old_ring(places, i, frames[i], config.shadow, config.far)
        if ring is not None:
            chosen.append(ring.reshape(-1).nonzero()[:, 0] + bank.starts[k])
    pixels = at_most(torch.cat(chosen), _RING_ASKED, draw)
    pixels = at_most(pixels[meets(region, bank.rays(pixels)).nonzero()[:, 0]], _RING_RAYS, draw)
    rays, rgb = bank.rays(pixels), bank.colours(pixels)
    if light is not None:
        was = render_many(field, rays)
        rgb = light.applied(rays.origins + rays.directions * was.depth[:, None], rgb)
    nothing = torch.zeros(len(pixels), dtype=torch.bool)
    return Lessons(rays, rgb, torch.full_like(pixels, -1), bank.place_of(pixels), held=nothing)


def _asked(frames: Sequence[Frame]) -> list[int]:
    """Indices of the old photos that teach: all of them, but only some of those that have yet to be made."""
    made = [i for i, f in enumerate(frames) if f.made is None]
    unmade = [i for i, f in enumerate(frames) if f.made is not None]
    return sorted(made + unmade[:: -(-len(unmade) // _MADE) or 1])


def at_most_of(lessons: Lessons, which: Tensor, most: int, draw: torch.Generator) -> Lessons:
    """Those of the pixels that ``which`` (N,) bool says, ``most`` of them at random if there are more."""
    return lessons[at_most(which.nonzero()[:, 0], most, draw)]


def at_most(rows: Tensor, most: int, draw: torch.Generator) -> Tensor:
    """``most`` of the rows (K,) at random, in order; all, if there are no more."""
    return rows if len(rows) <= most else rows[torch.randperm(len(rows), generator=draw)[:most].sort().values]
