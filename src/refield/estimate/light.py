"""Light that changed on surfaces that did not: shadows that moved along with their object.

Such a pixel's photo-to-field ratio is near grey and even around it. Either the photo's fine detail around it is still
the field's, which nothing that came or left shares with what was there; or every other view that sees the same surface
point sees the same ratio. What stands in front of the surface fails the latter, what is gone usually the first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from refield.estimate.detect import Changed, DetectConfig, Mask, blur_sigma
from refield.estimate.look import Array, View
from refield.scene.planes import Plane
from refield.scene.srgb import to_linear, to_srgb
from refield.vision import pixels

DARK = 0.03
"""linear light, summed over the channels; below it a ratio is noise"""
LARGEST = 5.0
"""times that light makes a surface brighter or darker, at most"""
_EVEN = 0.15  # log units, standard deviation among a pixel and its neighbours
_GREY = 0.10  # log units by which light changes one channel more than another, however bright it is
_TINT = 0.5  # and of how much brighter or darker it makes them: half of what leaves one channel as it was
_AGREE = 0.12  # log units between two views' ratios of the same surface point
SAME_PLACE = 0.02
"""of the distance to a point; so near to it a surface is the one that it is on"""
_AROUND = 4.0  # blurs; the window in which a photo's detail is compared with the field's
_ALIKE = 0.5  # of that detail's variance the field's must account for: surfaces of their own share none


def set_light_aside(changed: Sequence[Changed], planes: Sequence[Plane], config: DetectConfig) -> list[Changed]:
    """The same views with the light changes moved from ``mask`` to ``light``.

    A surface known by its detail needs no other view: the photographer's shadow and what a phone does to parts of a
    picture are in one photo only. Of the others, on a support plane one other view that sees the same ratio at the
    same point is enough, if none shows that point unchanged; elsewhere most of the views must, since an object's own
    side can look like a shadow.
    """
    ratios = [Ratio.of(c.view, c.view.rgb, config) for c in changed]
    out = []
    for i, c in enumerate(changed):
        agrees, denies, asked = _agreement(i, changed, ratios)
        flat = _on_planes(c.view, planes) & (denies == 0) & (agrees >= 1)
        there = flat | (agrees >= np.maximum(2, 0.6 * asked)) | same_detail(c.view, c.mask, config)
        light = c.mask & ratios[i].even_and_grey & there
        light = cv2.medianBlur(light.astype(np.uint8), 5).astype(bool) & c.mask
        smallest = max(6, config.smallest * light.size)
        rest = c.mask & ~pixels.keep_components(light, 2 * smallest)
        # the rim of a shadow is neither even nor quite grey: give it to the shadow it touches
        core = pixels.keep_components(pixels.dilate(pixels.erode(rest, 1), 1) & rest, smallest)
        out.append(replace(c, mask=core, light=c.mask & ~core))
    return out


def _on_planes(view: View, planes: Sequence[Plane]) -> Mask:
    """Pixels whose surface lies on one of the planes."""
    points = np.nan_to_num(view.surface, posinf=1e9, neginf=-1e9)
    slack = 2 * view.pixel_angle * np.nan_to_num(view.depth, posinf=0)
    out = np.zeros(view.shape, bool)
    for plane in planes:
        out |= np.abs(plane.above(points)) < np.maximum(slack, 3 * plane.noise)
    return out


@dataclass(frozen=True)
class Ratio:
    """How much more light a photo shows than the field, log units."""

    each: Array
    """(H, W, 3) of each channel, drawn towards none where there is hardly any light"""
    mean: Array
    """(H, W) of all channels"""
    tint: Array
    """(H, W, 3) by how much each differs from what it were if all changed alike"""

    @staticmethod
    def of(view: View, rgb: Array, config: DetectConfig) -> Ratio:
        """That of a view's photo to ``rgb``, what the field shows there, (H, W, 3)."""
        sigma = blur_sigma(view, config)
        photo, shown = (pixels.blur(to_linear(im), sigma) for im in (view.photo, rgb))
        alike = shown * (photo.sum(-1) / np.maximum(shown.sum(-1), 1e-6))[..., None]
        each, grey = (np.log((light + DARK / 3) / (shown + DARK / 3)) for light in (photo, alike))
        tint = each - grey
        return Ratio(*(a.astype(np.float32) for a in (each, each.mean(-1), tint - tint.mean(-1, keepdims=True))))

    @property
    def even_and_grey(self) -> Mask:
        """Pixels whose ratio is near grey, much the same around, and within reason."""
        spread = cv2.blur(self.mean**2, (3, 3)) - cv2.blur(self.mean, (3, 3)) ** 2
        even = np.sqrt(np.maximum(spread, 0)) < _EVEN
        return even & (np.abs(self.tint).max(-1) < tint(self.mean)) & (np.abs(self.mean) < np.log(LARGEST))


def same_detail(view: View, changed: Mask, config: DetectConfig) -> Mask:
    """Pixels around which the photo's detail is what the field shows, however bright either is, (H, W).

    Around a small thing that left or came, most of what is compared stayed. So the ``changed`` pixels (H, W) are asked
    alone as well: their detail must be the field's, too, or their ratio to it even.
    """
    sigma = blur_sigma(view, config)
    alike, _ = _compared(view, np.ones_like(changed), sigma)
    return alike & np.logical_or(*_compared(view, changed, sigma))


def _compared(view: View, among: Mask, sigma: float) -> tuple[Mask, Mask]:
    """Where the photo's detail is the field's, and where the photo's ratio to the field is even, (H, W) each: around a
    pixel, asked of the pixels ``among`` (H, W) alone."""
    seen, shown = (_detail(im, among, sigma) for im in (view.photo, view.rgb))
    both, one, other = (_mean(product, among, _AROUND * sigma) for product in (seen * shown, seen**2, shown**2))
    return (both > 0) & (both**2 > _ALIKE * one * other), one + other - 2 * both < _EVEN**2


def _detail(image: Array, among: Mask, sigma: float) -> Array:
    """(H, W) log of linear light, beside what it is around."""
    light = np.log(to_linear(_mean(image, among, sigma)).sum(-1) + DARK)
    return (light - _mean(light, among, _AROUND * sigma)).astype(np.float32)


def _mean(image: Array, among: Mask, sigma: float) -> Array:
    """An image (H, W) or (H, W, 3), blurred from the pixels ``among`` (H, W) alone."""
    weight = among.astype(np.float32)
    share = np.maximum(pixels.blur(weight, sigma), 1e-6)
    if image.ndim == 3:
        weight, share = weight[..., None], share[..., None]
    return pixels.blur(weight * image, sigma) / share


def tint(mean: Array) -> Array:
    """How far, in log units, light that makes a surface brighter by exp(``mean``) changes a channel beyond that."""
    return _GREY + _TINT * np.abs(mean)


def brighter(picture: Array, light: Array) -> Array:
    """A picture (H, W, 3) in so much more light, (H, W) log units, within reason."""
    most = np.log(LARGEST)
    return to_srgb(to_linear(picture) * np.exp(np.clip(light, -most, most))[..., None]).astype(np.float32)


def light_of_others(views: Sequence[View], ratios: Sequence[Ratio], hidden: Sequence[Mask]) -> list[Array]:
    """Per view, how much more light the other photos show on the surface under each pixel than the field does there,
    (H, W) log units, the median over those that see it; nan where none does.

    Args:
        views: the photos beside what is known to stand there, colours and depth.
        hidden: (H, W) pixels of each that show something before that.
    """
    out = []
    for i, view in enumerate(views):
        seen = [np.full(view.shape, np.nan, np.float32)]
        for k, uv, shown in _elsewhere(i, views, np.isfinite(view.depth)):
            shown = shown & ~views[k].lookup(hidden[k], uv, shown)
            seen.append(np.where(shown, views[k].lookup(ratios[k].mean, uv, shown), np.nan))
        out.append(pixels.median(np.stack(seen)))
    return out


def _agreement(i: int, changed: Sequence[Changed], ratios: Sequence[Ratio]) -> tuple[Array, Array, Array]:
    """How many other views, at the surface under each pixel, see the same ratio; see no change; see that surface."""
    views = [c.view for c in changed]
    agrees, denies, asked = (np.zeros(views[i].shape, np.float32) for _ in range(3))
    for k, uv, shown in _elsewhere(i, views, changed[i].mask):
        same = np.abs(views[k].lookup(ratios[k].each, uv, shown) - ratios[i].each).max(-1) < _AGREE
        touched = views[k].lookup(pixels.dilate(changed[k].mask, 1), uv, shown)
        asked += shown
        agrees += shown & same
        denies += shown & ~touched
    return agrees, denies, asked


def _elsewhere(i: int, views: Sequence[View], asked: Mask) -> Iterator[tuple[int, Array, Mask]]:
    """Each other view with its pixels (H, W, 2) of the surface under those of view ``i`` that are asked (H, W), and
    which of these it shows, (H, W)."""
    points = views[i].surface
    ok = np.isfinite(points).all(-1) & asked
    points = np.where(ok[..., None], points, 0)
    for k, other in enumerate(views):
        if k != i:
            uv, shown = other.shows(points, SAME_PLACE)
            yield k, uv, ok & shown
