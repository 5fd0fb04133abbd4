"""Pose change candidates from matched features (§4.2.3, §9.2, Eq. 12).

A feature on the object in an old picture has a 3-D point, by the old field's depth; matched to a new photo it has a
pixel there. All old pictures' matches to one photo together are one perspective-n-point problem, whose answer is the
photo's pose against the object where it was: ``cam_from_old``. With the photo's true pose that is T.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.detect import Mask
from refield.estimate.look import View
from refield.estimate.objects import Old
from refield.estimate.past import Past, silhouette
from refield.scene.camera import Camera
from refield.scene.colmap import colmap_camera
from refield.vision import pixels
from refield.vision.matcher import Matcher

Points = NDArray[np.float64]

_CROP = 160  # pixels; what is smaller is enlarged to this for the matcher
_ENLARGE = 3.0  # but no more than so many times
_LEAST_PIXELS = 30  # of the object in a picture, for it to be looked at


@dataclass(frozen=True)
class CutOut:
    """The part of a picture around a mask, enlarged if it is small."""

    picture: NDArray[np.uint8]
    """(h, w, 3)"""
    mask: Mask
    """(H, W) of the whole picture"""
    corner: tuple[int, int]
    scale: float

    @staticmethod
    def of(picture: NDArray[np.uint8], mask: Mask, margin: int = 4, least: int = _CROP) -> CutOut | None:
        """None for an empty mask. ``margin``: pixels around it that the matcher sees too; ``least``: pixels to which
        the part's longer side is enlarged."""
        box = pixels.bounding_box(mask, margin)
        if box is None:
            return None
        x0, y0, x1, y1 = box
        part = np.ascontiguousarray(picture[y0:y1, x0:x1])
        scale = float(np.clip(least / max(part.shape[:2]), 1, _ENLARGE))
        if scale > 1:
            size = (round(part.shape[1] * scale), round(part.shape[0] * scale))
            part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_CUBIC), np.uint8)
        return CutOut(part, mask, (x0, y0), scale)

    def whole(self, uv: Points) -> Points:
        """Pixels (K, 2) of the part, in the whole picture."""
        return np.asarray(uv, np.float64) / self.scale + self.corner

    def holds(self, uv: Points) -> NDArray[np.bool_]:
        """Whether pixels (K, 2) of the whole picture lie in the mask."""
        h, w = self.mask.shape
        i, j = uv[:, 1].astype(int), uv[:, 0].astype(int)
        within = (uv >= 0).all(-1) & (i < h) & (j < w)
        return within & self.mask[np.clip(i, 0, h - 1), np.clip(j, 0, w - 1)]


def matched_on(a: CutOut, b: CutOut, matcher: Matcher) -> tuple[Points, Points]:
    """Corresponding pixels (K, 2) of two whole pictures that lie in both masks."""
    uv_a, uv_b, _ = matcher.match(a.picture, b.picture)
    uv_a, uv_b = a.whole(uv_a), b.whole(uv_b)
    kept = a.holds(uv_a) & b.holds(uv_b)
    return uv_a[kept], uv_b[kept]


def matched_poses(
    old: Old, past: Sequence[Past], survey: Sequence[View], matcher: Matcher, least: int = 8
) -> list[Tensor]:
    """``new_from_old`` (4, 4) float64 guesses, at most one a photo, each with ``least`` or more inliers."""
    sources = [(p.view.rgb, p.view) for p in past] + [(v.photo, v) for v in survey]
    shown = [(silhouette(view, old), image, view) for image, view in sources]
    known = [(CutOut.of(pixels.to_bytes(image), m), v) for m, image, v in shown if m.sum() >= _LEAST_PIXELS]
    out = []
    for p in past:
        mask = pixels.dilate(p.changed.mask, 1)
        there = CutOut.of(pixels.to_bytes(p.view.photo), mask) if mask.sum() >= _LEAST_PIXELS else None
        if there is None:
            continue
        uv, xyz = [np.zeros((0, 2))], [np.zeros((0, 3))]
        for cut, view in known:
            if cut is None:
                continue
            a, b = matched_on(cut, there, matcher)
            points = view.surface[a[:, 1].astype(int), a[:, 0].astype(int)].astype(np.float64)
            fine = np.isfinite(points).all(-1)
            uv.append(b[fine])
            xyz.append(points[fine])
        pose = camera_from_object(np.concatenate(uv), np.concatenate(xyz), p.view.camera, least)
        if pose is not None:
            out.append(p.view.frame.world_from_cam @ pose)
    return out


def camera_from_object(
    uv: NDArray[np.float64], xyz: NDArray[np.float64], camera: Camera, least: int, most_error: float = 2.0
) -> Tensor | None:
    """cam_from_old (4, 4) of one photo (Eq. 8), or None. ``most_error``: pixels within which a point agrees."""
    if len(uv) < least:
        return None
    model = colmap_camera(pycolmap, camera, 1)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = most_error
    options.ransac.random_seed = 0
    answer = pycolmap.estimate_and_refine_absolute_pose(uv, xyz, model, estimation_options=options)
    if not answer or answer["num_inliers"] < least:
        return None
    out = torch.eye(4, dtype=torch.float64)
    out[:3] = torch.from_numpy(answer["cam_from_world"].matrix())
    return out
