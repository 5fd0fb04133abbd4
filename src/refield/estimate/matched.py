"""Pose change candidates from matched features (§4.2.3, §9.2, Eq. 12).

A feature on the object in an old picture has a 3-D point, by the old field's depth; matched to a new photo it has a
pixel there. All old pictures' matches to one photo together are one perspective-n-point problem, whose answer is the
photo's pose against the object where it was: ``cam_from_old``. With the photo's true pose that is T.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.detect import Mask
from refield.estimate.look import Array, View
from refield.estimate.objects import Old
from refield.estimate.past import Past, silhouette
from refield.scene.camera import Camera
from refield.vision import pixels
from refield.vision.matcher import SiftMatcher

Features = tuple[NDArray[np.float64], NDArray[np.float32]]

_MATCHER = SiftMatcher()
_MARGIN = 4  # pixels around the object that features are looked for in
_CROP = 160  # pixels; what is smaller is enlarged to this before features are looked for


def matched_poses(
    old: Old, past: Sequence[Past], survey: Sequence[View], least: int = 8, matcher: SiftMatcher = _MATCHER
) -> list[Tensor]:
    """``new_from_old`` (4, 4) float64 guesses, at most one a photo, each with ``least`` or more inliers."""
    sources = [(p.view.rgb, p.view) for p in past] + [(v.photo, v) for v in survey]
    known = [_object_features(image, view, silhouette(view, old), matcher) for image, view in sources]
    known = [k for k in known if len(k[1])]
    out = []
    for p in past:
        there = _features_in(p.view.photo, pixels.dilate(p.changed.mask, 1), matcher)
        uv, xyz = [], []
        for descriptors, points in known:
            a, b, _ = matcher.match_features((points, descriptors), there)
            xyz += list(a[:, 2:])
            uv += list(b)
        pose = camera_from_object(np.array(uv), np.array(xyz), p.view.camera, least)
        if pose is not None:
            out.append(p.view.frame.world_from_cam @ pose)
    return out


def _object_features(
    image: Array, view: View, mask: Mask, matcher: SiftMatcher
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Descriptors (K, 128) and (K, 5): pixel and world point, of features on the object."""
    xy, descriptors = _features_in(image, mask, matcher)
    if len(xy) == 0:
        return descriptors, np.zeros((0, 5))
    points = view.surface[xy[:, 1].astype(int), xy[:, 0].astype(int)].astype(np.float64)
    fine = np.isfinite(points).all(-1)
    return descriptors[fine], np.concatenate([xy, points], -1)[fine]


def _features_in(image: Array, mask: Mask, matcher: SiftMatcher) -> Features:
    """Features of the part of an image in (H, W) bool ``mask``."""
    box = pixels.bounding_box(mask, _MARGIN)
    if box is None or mask.sum() < 30:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    x0, y0, x1, y1 = box
    crop = pixels.to_bytes(image[y0:y1, x0:x1])
    scale = float(np.clip(_CROP / max(crop.shape[:2]), 1, 3))
    if scale > 1:
        crop = np.asarray(cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC), np.uint8)
    xy, descriptors = matcher.features(crop)
    xy = xy / scale + (x0, y0)
    h, w = mask.shape
    inside = mask[np.clip(xy[:, 1].astype(int), 0, h - 1), np.clip(xy[:, 0].astype(int), 0, w - 1)]
    return xy[inside], descriptors[inside]


def camera_from_object(uv: NDArray[np.float64], xyz: NDArray[np.float64], camera: Camera, least: int) -> Tensor | None:
    """cam_from_old (4, 4) of one photo (Eq. 8), or None."""
    if len(uv) < least:
        return None
    lens = [camera.fx, camera.fy, camera.cx, camera.cy, camera.k1, camera.k2, camera.p1, camera.p2]
    model = pycolmap.Camera(model="OPENCV", width=camera.width, height=camera.height, params=lens)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = 2.0
    options.ransac.random_seed = 0
    answer = pycolmap.estimate_and_refine_absolute_pose(uv, xyz, model, estimation_options=options)
    if not answer or answer["num_inliers"] < least:
        return None
    out = torch.eye(4, dtype=torch.float64)
    out[:3] = torch.from_numpy(answer["cam_from_world"].matrix())
    return out
