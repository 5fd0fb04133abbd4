"""An object's pose change T from matched features (§4.2.3, §9.2, §10.2.3).

Every rendering that shows the object where it was is matched with every photo that shows it where it is: 16 pairs for 4
views. Letters: i a view whose rendering, j one whose photo is looked at, K matched features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.detect import Mask
from refield.estimate.look import Array, View
from refield.estimate.matched import CutOut, camera_from_object, matched_on
from refield.estimate.paper.associate import Sighting, Thing
from refield.scene.capture import camera_rays
from refield.scene.pose import transform
from refield.vision import pixels
from refield.vision.matcher import Matcher

Points = NDArray[np.float64]


@dataclass(frozen=True)
class PoseConfig:
    """How features on the object are matched, and which answer is believed."""

    least: int = 8
    """features that must agree on a pose"""
    error: float = 2.0
    """pixels within which a feature agrees"""
    margin: int = 4
    """pixels around the object that the matcher sees too"""
    crop: int = 160
    """pixels; what is smaller is enlarged to this for the matcher, up to three times"""
    lands: float = 0.5
    """part of the object's points that must fall into the masks of its new place: a few features agree by chance"""


@dataclass(frozen=True)
class Matches:
    """Features of one pair that lie on the object in both of its pictures."""

    gone: View
    """i, rendered"""
    came: View
    """j, photographed"""
    uv: Points
    """(K, 2) pixels of the photo"""
    xyz: Points
    """(K, 3) world: the object's points at their old place (Eq. 10)"""


@dataclass(frozen=True)
class MatchedPose:
    """T of the pair of which the most features agree, and the features of all pairs."""

    new_from_old: Tensor
    """(4, 4) float64"""
    inliers: int
    """of the best pair, features that agree"""
    share: float
    """part of its features that do"""
    matches: tuple[Matches, ...]
    """of all pairs"""


def matched_pose(gone: Thing, came: Thing, matcher: Matcher, config: PoseConfig) -> MatchedPose | None:
    """T (Eq. 12) of the pair with the most inliers; None if no pair has enough."""
    every = tuple(m for s in gone.sightings for t in came.sightings if len((m := on_object(s, t, matcher, config)).uv))
    best: MatchedPose | None = None
    for m in every:
        pose = camera_from_object(m.uv, m.xyz, m.came.camera, config.least)
        if pose is None:
            continue
        agree = agreeing(m, pose, config.error)
        if agree >= config.least and (best is None or agree > best.inliers):
            best = MatchedPose(m.came.frame.world_from_cam @ pose, agree, agree / len(m.uv), every)
    return best


def on_object(gone: Sighting, came: Sighting, matcher: Matcher, config: PoseConfig) -> Matches:
    """Match the object's part of a rendering with its part of a photo; what falls beside either mask is dropped."""
    i, j = gone.pair.view, came.pair.view
    was = gone.pair.on_render(gone.mask)
    # the rendering as it was rendered, not as it was aligned: that is where its depth is
    pictures = (pixels.to_bytes(i.rgb), was), (came.pair.capture, came.mask)
    a, b = (CutOut.of(picture, mask, config.margin, config.crop) for picture, mask in pictures)
    if a is None or b is None:
        return Matches(i, j, np.zeros((0, 2)), np.zeros((0, 3)))
    uv_a, uv_b = matched_on(a, b, matcher)
    xyz = points_under(i, uv_a)
    kept = np.isfinite(xyz).all(-1)
    return Matches(i, j, uv_b[kept], xyz[kept])


def points_under(view: View, uv: Points) -> Points:
    """World points (K, 3) float64 under pixels (K, 2) of a rendering (Eq. 10); not finite where the field is empty.

    The depth is the nearest pixel's: between two pixels of an object's outline lies no surface.
    """
    rays = camera_rays(view.camera, view.frame.world_from_cam, torch.from_numpy(uv))
    h, w = view.shape
    i, j = (np.clip(uv[:, k].astype(int), 0, n - 1) for k, n in ((1, h), (0, w)))
    with np.errstate(invalid="ignore"):
        points = rays.origins.numpy() + rays.directions.numpy() * view.depth[i, j][:, None]
    return points.astype(np.float64)


def agreeing(m: Matches, cam_from_old: Tensor, error: float) -> int:
    """How many of a pair's points, placed by ``cam_from_old`` (4, 4), fall on their pixels (Eq. 9)."""
    uv, z = m.came.camera.project(transform(cam_from_old, torch.from_numpy(m.xyz)))
    return int((((uv.numpy() - m.uv) ** 2).sum(-1) < error**2)[z.numpy() > 0].sum())


def landing(cloud: Array, came: Thing, new_from_old: Tensor) -> float:
    """Part of an object's points (N, 3) that T puts into its masks at its new place, over the photos that see them."""
    there = transform(new_from_old, torch.from_numpy(cloud).double()).numpy()
    hits, seen = 0, 0
    for s in came.sightings:
        uv, _, inside = s.pair.view.project(there)
        hits += int((s.pair.view.lookup(s.mask, uv, inside) & inside).sum())
        seen += int(inside.sum())
    return hits / seen if seen else 0.0


def matched_pixels(matches: Sequence[Matches]) -> list[tuple[View, Mask]]:
    """Per photo that takes part, (H, W) bool: pixels with a matched feature on the object."""
    found: dict[str, tuple[View, Mask]] = {}
    for m in matches:
        _, mask = found.setdefault(m.came.frame.name, (m.came, np.zeros(m.came.shape, bool)))
        mask[m.uv[:, 1].astype(int), m.uv[:, 0].astype(int)] = True
    return list(found.values())
