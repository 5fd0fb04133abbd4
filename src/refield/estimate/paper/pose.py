"""An object's pose change T from matched features (§4.2.3, §9.2, §10.2.3).

Every rendering that shows the object where it was is matched with every photo that shows it where it is: 16 pairs for 4
views. Few features show on a small object, and those of one pair lie on a side or two of it, so that noise tips the
pose over. The features of all pairs are solved for at once: the photos are a rig of cameras in the world, and what
moves against it is the object. Letters: i a view whose rendering, j one whose photo is looked at, K matched features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.detect import Mask
from refield.estimate.look import Array, View
from refield.estimate.matched import CutOut, camera_from_object, matched_on
from refield.estimate.paper.align import Picture
from refield.estimate.paper.associate import Sighting, Thing
from refield.scene.capture import camera_rays
from refield.scene.colmap import colmap_camera, quiet_pycolmap
from refield.scene.pose import invert, rigid, transform
from refield.vision import pixels
from refield.vision.matcher import Matcher

Points = NDArray[np.float64]


@dataclass(frozen=True)
class PoseConfig:
    """How features on the object are matched, and which answer is believed."""

    least: int = 8
    """features that must agree on a pose"""
    pairs: Literal["all", "best"] = "all"
    """solve for the features of all pairs at once, or, as the paper does for simplicity, for those of the pair with the
    most inliers"""
    error: float = 4.0
    """pixels within which a feature agrees: SIFT finds one on a field's rendering to a pixel or two"""
    blur: float = 0.003
    """of the width: the sigma of a Gaussian that the photo is seen through, as a field shows no finer detail"""
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
    """T, and the features of all pairs."""

    new_from_old: Tensor
    """(4, 4) float64"""
    inliers: int
    """features that agree, of the pairs that were solved for"""
    share: float
    """part of the features of the pair with the most inliers that agree"""
    matches: tuple[Matches, ...]
    """of all pairs"""


def matched_pose(gone: Thing, came: Thing, matcher: Matcher, config: PoseConfig) -> MatchedPose | None:
    """T (Eq. 12) from the features of all pairs; None if too few agree."""
    every = tuple(m for s in gone.sightings for t in came.sightings if len((m := on_object(s, t, matcher, config)).uv))
    solved = [every] if config.pairs == "all" else [(m,) for m in every]
    found = [p for pairs in solved if (p := _solved(pairs, every, config)) is not None]
    return max(found, key=lambda p: p.inliers, default=None)


def _solved(pairs: Sequence[Matches], every: tuple[Matches, ...], config: PoseConfig) -> MatchedPose | None:
    if len(pairs) == 1:  # one camera
        (m,) = pairs
        seen = camera_from_object(m.uv, m.xyz, m.came.camera, config.least, config.error)
        pose = None if seen is None else m.came.frame.world_from_cam @ seen
    else:
        pose = world_from_object(pairs, config)
    if pose is None:
        return None
    agree = [agreeing(m, pose, config.error) for m in pairs]
    most, of = max(zip(agree, (len(m.uv) for m in pairs)))
    return MatchedPose(pose, sum(agree), most / of, every) if sum(agree) >= config.least else None


def world_from_object(pairs: Sequence[Matches], config: PoseConfig) -> Tensor | None:
    """Where the object is against where it was, (4, 4) float64, by what several photos show of it; or None.

    Eq. 9 of every pair together. The rig that pycolmap looks for is the world with the new photos' cameras in it, and
    its points are the object's at its old place: the pose it finds is T.
    """
    if sum(len(m.uv) for m in pairs) < config.least:
        return None
    pycolmap = quiet_pycolmap()
    views = list({id(m.came): m.came for m in pairs}.values())
    seats = [invert(v.frame.world_from_cam)[:3].numpy() for v in views]
    which = [k for m in pairs for k, v in enumerate(views) if v is m.came for _ in m.uv]
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = config.error, 0
    answer = pycolmap.estimate_and_refine_generalized_absolute_pose(
        np.concatenate([m.uv for m in pairs]),
        np.concatenate([m.xyz for m in pairs]),
        which,
        [pycolmap.Rigid3d(pycolmap.Rotation3d(seat[:, :3]), seat[:, 3]) for seat in seats],
        [colmap_camera(pycolmap, v.camera, 1) for v in views],
        estimation_options=options,
    )
    if not answer:
        return None
    matrix = torch.from_numpy(np.array(answer["rig_from_world"].matrix(), np.float64))
    return rigid(matrix[:, :3], matrix[:, 3])


def on_object(gone: Sighting, came: Sighting, matcher: Matcher, config: PoseConfig) -> Matches:
    """Match the object's part of a rendering with its part of a photo; what falls beside either mask is dropped."""
    i, j = gone.pair.view, came.pair.view
    was = gone.pair.on_render(gone.mask)
    # the rendering as it was rendered, not as it was aligned: that is where its depth is
    pictures = (pixels.to_bytes(i.rgb), was), (softened(came.pair.capture, config.blur), came.mask)
    a, b = (CutOut.of(picture, mask, config.margin, config.crop) for picture, mask in pictures)
    if a is None or b is None:
        return Matches(i, j, np.zeros((0, 2)), np.zeros((0, 3)))
    uv_a, uv_b = matched_on(a, b, matcher)
    xyz = points_under(i, uv_a)
    kept = np.isfinite(xyz).all(-1)
    return Matches(i, j, uv_b[kept], xyz[kept])


def softened(picture: Picture, share: float) -> Picture:
    """A photo (H, W, 3) through a Gaussian whose sigma is this share of its width."""
    sigma = share * picture.shape[1]
    return picture if sigma <= 0 else np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma), np.uint8)


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


def agreeing(m: Matches, new_from_old: Tensor, error: float) -> int:
    """How many of a pair's points, moved by T (4, 4), fall on their pixels (Eq. 9)."""
    cam_from_old = invert(m.came.frame.world_from_cam) @ new_from_old
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
