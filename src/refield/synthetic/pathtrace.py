"""Mitsuba 3 renders a world: photographs with global light. Needs the extra ``refield[synth]``."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.errors import InputError
from refield.scene.srgb import to_linear, to_srgb
from refield.synthetic.state import Item, Lamp, State

_SEEDS = 2**32  # that the renderer knows
_OLDEST_LLVM = 19  # an older one aborts the whole process on the first kernel
_DEPTH = 5  # light path segments
_PROBE = "import drjit; print(drjit.detail.llvm_version()[0])"


@cache
def variant() -> str:
    """``llvm_ad_rgb`` where a usable LLVM is found by asking in another process, else ``scalar_rgb``."""
    try:
        done = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=120, check=True)
        return "llvm_ad_rgb" if int(done.stdout) >= _OLDEST_LLVM else "scalar_rgb"
    except (subprocess.SubprocessError, OSError, ValueError):
        return "scalar_rgb"


@cache
def mitsuba() -> Any:
    """The module, with its variant chosen.

    Raises:
        InputError: Mitsuba is not installed.
    """
    try:
        import mitsuba as mi
    except ImportError:
        raise InputError("synth", "the renderer Mitsuba 3 is not installed", "pip install 'refield[synth]'") from None
    mi.set_variant(variant())
    mi.set_log_level(mi.LogLevel.Error)
    return mi


class PathTracer:
    """A state, loaded into the renderer."""

    def __init__(self, state: State) -> None:
        self._mi = mitsuba()
        self._scene = self._mi.load_dict(_scene(self._mi, state))

    def photo(self, camera: Camera, world_from_cam: Tensor, spp: int, seed: int) -> Tensor:
        """What an undistorted camera sees: (H, W, 3) float32 sRGB in [0, 1], ``spp`` paths a pixel."""
        sensor = self._mi.load_dict(_sensor(self._mi, camera, world_from_cam))
        linear = np.array(self._mi.render(self._scene, sensor=sensor, spp=spp, seed=seed % _SEEDS))[..., :3]
        return torch.from_numpy(to_srgb(linear))


def _scene(mi: Any, state: State) -> dict[str, Any]:
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)  # the map's own up is y
    out: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": _DEPTH},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(state.surroundings), "to_world": upright},
    }
    if state.sun is not None:
        light = {"type": "rgb", "value": list(state.sun)}
        out["sun"] = {"type": "directional", "direction": list(state.sun_direction), "irradiance": light}
    out |= {f"lamp_{i}": _lamp(mi, lamp) for i, lamp in enumerate(state.lamps)}
    return out | {f"item_{i}": _mesh(mi, item) for i, item in enumerate(state.items)}


def _lamp(mi: Any, lamp: Lamp) -> dict[str, Any]:
    light = {"type": "rgb", "value": list(lamp.light)}
    if lamp.half is None:
        return {"type": "point", "position": list(lamp.at), "intensity": light}
    # a rectangle shines along +z
    down = mi.ScalarTransform4f().translate(list(lamp.at)).rotate([1, 0, 0], 180).scale([*lamp.half, 1])
    return {"type": "rectangle", "to_world": down, "emitter": {"type": "area", "radiance": light}}


def _mesh(mi: Any, item: Item) -> Any:
    vertices, uv, faces = item.solid.mesh()
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(_surface(mi, item))
    mesh = mi.Mesh(item.name, len(vertices), len(faces), has_vertex_texcoords=True, props=props)
    parameters = mi.traverse(mesh)
    placed = vertices @ item.world_from_item[:3, :3].numpy().T + item.world_from_item[:3, 3].numpy()
    parameters["vertex_positions"] = placed.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = uv.ravel()
    parameters["faces"] = faces.ravel()
    parameters.update()
    return mesh


def _surface(mi: Any, item: Item) -> dict[str, Any]:
    paint = {"type": "bitmap", "bitmap": mi.Bitmap(to_linear(item.texture)), "raw": True}
    if item.metal:
        return {"type": "roughconductor", "material": "none", "specular_reflectance": paint, "alpha": item.roughness}
    if item.glossy:
        return {"type": "roughplastic", "diffuse_reflectance": paint, "alpha": item.roughness}
    return {"type": "diffuse", "reflectance": paint}


def _sensor(mi: Any, camera: Camera, world_from_cam: Tensor) -> dict[str, Any]:
    if camera.is_distorted:
        raise ValueError("the path tracer has no lens distortion")
    # Mitsuba's camera looks along +z with x to the left and y up
    flip = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    fov = float(2 * np.degrees(np.arctan(camera.width / 2 / camera.fx)))
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "component_format": "float32"}
    return {
        "type": "perspective",
        "fov": fov,
        "fov_axis": "x",
        "principal_point_offset_x": camera.cx / camera.width - 0.5,
        "principal_point_offset_y": camera.cy / camera.height - 0.5,
        "to_world": mi.ScalarTransform4f((world_from_cam @ flip).numpy()),
        "film": film | {"rfilter": {"type": "gaussian", "stddev": 0.45}},
        "sampler": {"type": "independent"},
    }
