"""States in the browser: points or splats under one name, so that a later one takes the place of an earlier one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from refield.export.splats import Splats
from refield.scene.world import World
from refield.view.cast import Glimpse
from refield.view.stage import Stage

if TYPE_CHECKING:
    from viser import SceneApi

STATE, POINTS = "/state/splats", "/state/points"
_POINT = 0.012  # units of the stage
_THINNEST = 1e-3  # units of the stage: half floats hold no thinner disc


def draw_glimpse(scene: SceneApi, stage: Stage, glimpse: Glimpse) -> None:
    """Points in place of what was drawn of another state."""
    scene.add_point_cloud(
        POINTS,
        stage.points(glimpse.xyz),
        _bytes(glimpse.rgb),
        point_size=_POINT,
        point_shape="circle",
        point_shading="flat",
    )
    scene.remove_by_name(STATE)


def draw_splats(scene: SceneApi, stage: Stage, splats: Splats, name: str = STATE, **pose: Any) -> None:
    """Splats, by default in place of what was drawn of another state; ``pose``: of the node, viser's words."""
    # from afar first: a browser that has not sorted them yet draws them in this order
    splats = splats[(splats.means.double() - stage.middle).norm(dim=1).argsort(descending=True)]
    scene.add_gaussian_splats(
        name,
        stage.points(splats.means),
        covariances(splats, stage.scale),
        _bytes(splats.rgb),
        splats.opacities[:, None].numpy(),
        **pose,
    )
    if name == STATE:
        scene.remove_by_name(POINTS)


def covariances(splats: Splats, scale: float) -> np.ndarray:
    """(G, 3, 3) of splats drawn ``scale`` times as large."""
    w, x, y, z = splats.quaternions.unbind(-1)
    columns = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1),
        torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1),
        torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    axes = torch.stack(columns, -1) * (splats.scales * scale).clamp_min(_THINNEST)[:, None, :]
    return (axes @ axes.transpose(-1, -2)).numpy()


def look_from_afar(scene: SceneApi, world: World) -> None:
    """What is the same for every state: which way is up."""
    scene.set_up_direction(world.up)


def _bytes(rgb: Tensor) -> np.ndarray:
    return (rgb * 255).round().clamp(0, 255).to(torch.uint8).numpy()
