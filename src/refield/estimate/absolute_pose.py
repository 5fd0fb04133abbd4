"""A camera's pose from points that it recognised (Eq. 7), most of which may be wrong or lie on things that moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.estimate.intrinsics import Guess
from refield.estimate.own_camera import ENOUGH, refined
from refield.scene.camera import Camera
from refield.scene.colmap import camera_of, colmap_camera, quiet_pycolmap
from refield.scene.errors import InputError
from refield.scene.pose import invert, rigid

_F64 = NDArray[np.float64]
_CELLS = 8  # a side, that the picture is divided into to see how far inliers spread
_RIVAL = 0.5  # of the inliers: a second pose with so many is looked at
_OWN_GAIN = 1.2  # times the inliers that a camera of its own must have to be preferred to the old photos'
_FEW = 6
_ROUNDS = 3  # of refining a camera of its own: each finds more inliers


@dataclass(frozen=True)
class Solved:
    """A pose, and what speaks for it."""

    world_from_cam: Tensor
    """(4, 4) float64"""
    camera: Camera
    inliers: NDArray[np.bool_]
    """(N,) of the matches"""
    error: float
    """median of the inliers' distances, pixels"""
    spread: int
    """cells of the picture, of 64, that inliers lie in"""
    how: str
    """where the intrinsics come from"""

    @property
    def count(self) -> int:
        return int(self.inliers.sum())


def solve(xy: _F64, xyz: _F64, guesses: Sequence[Guess], most_error: float) -> Solved | None:
    """The pose from pixels (N, 2) of world points (N, 3), with the intrinsics that explain most of them.

    Where two poses each explain many (things that moved together are explained by one of their own), it is the one
    whose points are spread more widely over the picture: what stands still surrounds what moves.
    """
    best: Solved | None = None
    for guess in guesses:
        found = _ransac(xy, xyz, guess, most_error)
        if found is not None and (best is None or found.count > _OWN_GAIN * best.count):
            best = found
            used = guess
    if best is None:
        return None
    rest = ~best.inliers
    rival = _ransac(xy[rest], xyz[rest], used, most_error)
    if rival is not None and rival.count >= _RIVAL * best.count and rival.spread > 1.3 * best.spread:
        inliers = rest.copy()
        inliers[rest] = rival.inliers
        return replace(rival, inliers=inliers)
    return best


def _ransac(xy: _F64, xyz: _F64, guess: Guess, most_error: float) -> Solved | None:
    if len(xy) < _FEW:
        return None
    pycolmap = quiet_pycolmap()
    camera = _camera(pycolmap, guess)
    how = pycolmap.AbsolutePoseEstimationOptions()
    how.estimate_focal_length = guess.search
    how.ransac.max_error, how.ransac.random_seed = most_error, 0
    how.ransac.min_inlier_ratio = 0.05
    then = pycolmap.AbsolutePoseRefinementOptions()
    then.refine_focal_length = then.refine_extra_params = guess.refine
    found = pycolmap.estimate_and_refine_absolute_pose(xy, xyz, camera, how, then)
    if not found or found["num_inliers"] < _FEW:
        return None
    matrix = torch.from_numpy(np.array(found["cam_from_world"].matrix(), np.float64))
    pose = invert(rigid(matrix[:, :3], matrix[:, 3]))
    try:
        used = camera_of(camera, "a new photo") if guess.refine else guess.camera
    except InputError:  # refined into what is no camera: a few wrong matches can do that
        return None
    best = _judged(xy, xyz, (pose, used, guess.how), most_error)
    for _ in range(_ROUNDS if guess.search else 0):
        if best is None or best.count < ENOUGH:
            break
        pose, used = refined(best.world_from_cam, best.camera, xy[best.inliers], xyz[best.inliers])
        again = _judged(xy, xyz, (pose, used, guess.how), most_error)
        if again is None or again.count < best.count:
            break
        best = again
    return best


def _camera(pycolmap: Any, guess: Guess) -> Any:
    """A COLMAP camera that refinement can change; a camera of its own has one radial term to be found."""
    c = guess.camera
    if not guess.refine or c.is_distorted:
        return colmap_camera(pycolmap, c, 1)
    return pycolmap.Camera(model="SIMPLE_RADIAL", width=c.width, height=c.height, params=[c.fx, c.cx, c.cy, 0.0])


def _judged(xy: _F64, xyz: _F64, found: tuple[Tensor, Camera, str], most_error: float) -> Solved | None:
    """Inliers by our own camera, so that what is said is true of what is used."""
    pose, camera, how = found
    local = (torch.from_numpy(xyz) - pose[:3, 3]) @ pose[:3, :3]
    seen, depth = camera.project(local)
    off = np.linalg.norm(seen.numpy() - xy, axis=1)
    inliers = (off < most_error) & (depth.numpy() > 0)
    if inliers.sum() < _FEW or not 0.2 < camera.fx / max(camera.width, camera.height) < 20:
        return None
    cells = np.floor(xy[inliers] / [camera.width, camera.height] * _CELLS).clip(0, _CELLS - 1)
    return Solved(pose, camera, inliers, float(np.median(off[inliers])), len(np.unique(cells, axis=0)), how)
