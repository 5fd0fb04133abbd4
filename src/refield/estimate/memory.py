"""What old photos saw. Where none of them looked the field is a guess, and a new photo that shows something else there
shows no change: it is new to us.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refield.estimate.carve_kernels import Window, count_on_surface, packed
from refield.estimate.look import Array, View, spread_out, surfaces
from refield.field.radiance import Field
from refield.scene.capture import Frame, camera_rays
from refield.vision import pixels
from refield.vision.pixels import Mask

_RAYS = 200_000  # through the field, for all old photos together
_FEWEST = 1000  # of one photo: with less its pixels are wider than things
_SLACK = 1.5  # pixels' widths that a point may be off a surface; one that is looked at aslant is that far off
_ACROSS = 5  # pixels over which the middle count is taken
_FAR = 100.0  # times the farthest surface: there an empty pixel is asked, and seen where other photos are empty too


@dataclass(frozen=True)
class Memory:
    """The old field's surfaces as each old photo saw them, small."""

    lenses: Array
    """(V, 26), see `carve_kernels`"""
    depths: Array
    """(P,) float32, of all pixels"""
    slack: Array
    """(V,) how far off a surface a point may be, per unit of its distance"""
    far: float
    """world units; farther than all there is"""

    @staticmethod
    def of(field: Field, frames: Sequence[Frame]) -> Memory:
        """What ``frames`` saw of what ``field`` holds; of many those that differ most."""
        frames = spread_out(frames, _RAYS // _FEWEST)
        windows, slack = [], []
        for frame in frames:
            camera = frame.camera.within(_RAYS // len(frames))
            depth = surfaces(field, camera_rays(camera, frame.world_from_cam)).reshape(camera.height, camera.width)
            windows.append(Window(camera, frame.world_from_cam, depth.numpy()))
            slack.append(_SLACK / min(camera.fx, camera.fy))
        lenses, depths = packed(windows)
        finite = depths[np.isfinite(depths)]
        return Memory(lenses, depths, np.array(slack), _FAR * float(finite.max(initial=1.0)))

    def times_seen(self, view: View, depth: Array | None = None, where: Mask | None = None) -> NDArray[np.uint16]:
        """How many old photos saw what is under each pixel at ``depth`` (H, W), the view's own by default. (H, W)

        ``where`` (H, W): the pixels that are asked for; of others nothing is said.
        """
        depth = view.depth if depth is None else depth
        asked = np.ones(view.shape, bool) if where is None else pixels.dilate(where, _ACROSS // 2)
        reach = np.where(np.isfinite(depth), depth, self.far)[asked]
        points = (view.centre + view.directions[asked] * reach[:, None]).astype(np.float32)
        counts = np.zeros(len(points), np.uint16)
        count_on_surface(points, self.lenses, self.depths, self.slack, self.far / 2, counts)
        found = np.zeros(view.shape, np.uint16)
        found[asked] = counts
        # a pixel of an old photo across an edge has one of the two depths
        return np.asarray(cv2.medianBlur(found, _ACROSS), np.uint16)
