"""States in the browser: points and splats each under one name, so that later ones take the place of earlier ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from refield.export.splats import Splats
from refield.scene.world import World
from refield.view.cast import Cloud
from refield.view.stage import Stage

if TYPE_CHECKING:
    from viser import SceneApi, SceneNodeHandle

STATE, POINTS = "/state/splats", "/state/points"
_COVERS = 0.7  # a point's size in viser, in distances between neighbours: twice as wide it is drawn
_SIZES = 2  # of points, for each doubling
_THINNEST = 1e-3  # units of the stage: half floats hold no thinner disc


def draw_points(scene: SceneApi, stage: Stage, cloud: Cloud) -> SceneNodeHandle:
    """Points in place of those of another state, each so large that they leave no gaps."""
    scene.remove_by_name(POINTS)
    node = scene.add_frame(POINTS, show_axes=False)
    wide = (cloud.apart * stage.scale * _COVERS).clamp_min(_THINNEST)
    # a cloud of viser's has points of one size
    sizes = (_SIZES * wide.log2()).round()
    for size in sizes.unique().tolist():
        own = sizes == size
        scene.add_point_cloud(
            f"{POINTS}/{size:.0f}",
            stage.points(cloud.xyz[own]),
            _bytes(cloud.rgb[own]),
            point_size=2 ** (size / _SIZES),
            point_shape="square",
            point_shading="flat",
            precision="float32",
        )
    return node


def draw_splats(scene: SceneApi, stage: Stage, splats: Splats, name: str = STATE, **pose: Any) -> SceneNodeHandle:
    """Splats, by default in place of those of another state; ``pose``: of the node, viser's words."""
    # from afar first: a browser that has not sorted them yet draws them in this order
    splats = splats[(splats.means.double() - stage.middle).norm(dim=1).argsort(descending=True)]
    return scene.add_gaussian_splats(
        name,
        stage.points(splats.means),
        covariances(splats, stage.scale),
        _bytes(splats.rgb),
        splats.opacities[:, None].numpy(),
        **pose,
    )


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


def set_stage(scene: SceneApi, world: World) -> None:
    """What is the same for every state: which way is up, and that nothing which is drawn casts shadows or mirrors
    anything. Where a processor draws, both would take longer than all else."""
    scene.set_up_direction(world.up)
    scene.configure_default_lights(cast_shadow=False)
    scene.configure_environment_map(None)


def _bytes(rgb: Tensor) -> np.ndarray:
    return (rgb * 255).round().clamp(0, 255).to(torch.uint8).numpy()
