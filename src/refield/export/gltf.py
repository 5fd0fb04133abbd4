"""glTF 2.0 in one binary file (.glb): meshes with colours, cameras, and nodes that hold poses.

glTF's y points up. All nodes hang on one, ``upright_from_world``, that turns the world by the smallest rotation that
brings its up there, and does nothing else: below it everything is in the world's own coordinates and units.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield import __version__
from refield.scene.camera import Camera
from refield.scene.pose import exp, rotation_log
from refield.scene.srgb import to_linear
from refield.scene.world import World

ROOT = "upright_from_world"
_FLOAT, _UINT32, _UINT16 = 5126, 5125, 5123
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_NEAR = 1e-3  # of the scene's size, from where on a camera sees


class Glb:
    """A file in the making: add what it holds, then take its bytes."""

    def __init__(self, world: World, extras: dict[str, Any]) -> None:
        """``extras``: what the file says of itself, for JSON."""
        self._world = world
        self._data = bytearray()
        self._parts: dict[str, list[dict[str, Any]]] = {}
        root: dict[str, Any] = {"name": ROOT, "rotation": quaternion(upright(world)[:3, :3]), "children": []}
        self._add("nodes", root)
        self._root = root
        facts = {"up": list(world.up), "metres_per_unit": world.metres_per_unit, **extras}
        self._asset = {"version": "2.0", "generator": f"refield {__version__}", "extras": facts}

    def add_node(self, name: str, world_from_node: Tensor | None = None, **what: Any) -> None:
        """A node in the world, by its pose (4, 4); ``what``: glTF's own properties, such as ``mesh``."""
        node: dict[str, Any] = {"name": name, **what}
        if world_from_node is not None:
            node["translation"] = world_from_node[:3, 3].tolist()
            node["rotation"] = quaternion(world_from_node[:3, :3])
        self._root["children"].append(self._add("nodes", node))

    def add_mesh(self, xyz: Tensor, faces: Tensor, *, normals: Tensor, rgb: Tensor) -> int:
        """Triangles (F, 3) between vertices (P, 3) with colours (P, 3) in [0, 1], sRGB as photos have them; its number.

        Colours hold the light already, so the material is one that viewers do not light again.
        """
        attributes = {
            "POSITION": self._array(xyz.numpy().astype("<f4"), _FLOAT, _VERTICES, bounds=True),
            "NORMAL": self._array(normals.numpy().astype("<f4"), _FLOAT, _VERTICES),
            "COLOR_0": self._array(_linear(rgb.numpy()), _UINT16, _VERTICES, normalized=True),
        }
        indices = self._array(faces.numpy().astype("<u4").reshape(-1), _UINT32, _INDICES)
        return self._mesh(attributes, indices, self._unlit([1.0, 1.0, 1.0, 1.0]))

    def add_box(self, size: Sequence[float], colour: Sequence[float]) -> int:
        """A box of these sides around a node's origin, of one translucent colour (linear, with opacity); its number."""
        corner = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3) * torch.tensor(list(size))
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], "<u4")
        position = self._array(corner.numpy().astype("<f4"), _FLOAT, _VERTICES, bounds=True)
        return self._mesh(
            {"POSITION": position}, self._array(faces.reshape(-1), _UINT32, _INDICES), self._unlit(colour)
        )

    def add_camera(self, camera: Camera) -> int:
        """A camera's field of view; its number. glTF knows neither distortion nor an optical axis beside the middle."""
        near = _NEAR * self._world.size or _NEAR
        lens = {"aspectRatio": camera.width / camera.height * camera.fy / camera.fx, "znear": near}
        lens["yfov"] = 2 * math.atan(camera.height / 2 / camera.fy)
        return self._add("cameras", {"type": "perspective", "perspective": lens})

    def to_bytes(self) -> bytes:
        """The whole file."""
        document: dict[str, Any] = {"asset": self._asset, "scene": 0, "scenes": [{"nodes": [0]}], **self._parts}
        if not self._root["children"]:  # glTF wants no empty lists
            self._root.pop("children")
        if self._data:
            document["buffers"] = [{"byteLength": len(self._data)}]
        if "materials" in document:
            document["extensionsUsed"] = ["KHR_materials_unlit"]
        text = json.dumps(document, allow_nan=False).encode()
        chunks = [(_JSON, text + b" " * (-len(text) % 4))]
        if self._data:
            chunks.append((_BIN, bytes(self._data)))
        body = b"".join(struct.pack("<II", len(data), kind) + data for kind, data in chunks)
        return struct.pack("<III", _MAGIC, 2, 12 + len(body)) + body

    def _add(self, kind: str, what: dict[str, Any]) -> int:
        there = self._parts.setdefault(kind, [])
        there.append(what)
        return len(there) - 1

    def _mesh(self, attributes: dict[str, int], indices: int, material: int) -> int:
        return self._add(
            "meshes", {"primitives": [{"attributes": attributes, "indices": indices, "material": material}]}
        )

    def _unlit(self, colour: Sequence[float]) -> int:
        look = {"baseColorFactor": list(colour), "metallicFactor": 0.0, "roughnessFactor": 1.0}
        material: dict[str, Any] = {"pbrMetallicRoughness": look, "extensions": {"KHR_materials_unlit": {}}}
        if colour[3] < 1:
            material["alphaMode"] = "BLEND"
        return self._add("materials", material | {"doubleSided": True})

    def _array(
        self, values: NDArray[Any], component: int, target: int, *, bounds: bool = False, normalized: bool = False
    ) -> int:
        """Data (N,) or (N, C), four bytes aligned, as an accessor; its number."""
        size = 1 if values.ndim == 1 else values.shape[1]
        raw = values.tobytes()
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(raw), "target": target}
        self._data += raw + b"\0" * (-len(raw) % 4)
        accessor: dict[str, Any] = {
            "bufferView": self._add("bufferViews", view),
            "componentType": component,
            "count": len(values),
            "type": _TYPES[size],
        }
        if bounds:
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        if normalized:
            accessor["normalized"] = True
        return self._add("accessors", accessor)


def upright(world: World) -> Tensor:
    """(4, 4) float64: the smallest rotation that brings the world's up to +y."""
    up = torch.tensor(world.up, dtype=torch.float64)
    up = up / up.norm()
    y = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    axis = torch.linalg.cross(up, y)
    sine, cosine = axis.norm(), up @ y
    if float(sine) < 1e-9:  # along y already, or against it
        axis, sine = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64)
        angle = torch.tensor(0.0 if float(cosine) > 0 else math.pi, dtype=torch.float64)
    else:
        angle = torch.atan2(sine, cosine)
    return exp(torch.cat([torch.zeros(3, dtype=torch.float64), axis / sine * angle]))


def quaternion(rotation: Tensor) -> list[float]:
    """x y z w of a rotation (3, 3), as glTF has it."""
    vector = rotation_log(rotation.double())
    angle = float(vector.norm())
    along = vector * (math.sin(angle / 2) / angle if angle > 1e-12 else 0.5)
    return [*along.tolist(), math.cos(angle / 2)]


def _linear(rgb: NDArray[np.float32]) -> NDArray[np.uint16]:
    """sRGB (P, 3) in [0, 1] as linear light (P, 4) with full opacity, 16 bits: glTF's vertex colours are linear."""
    light = to_linear(rgb)
    opaque = np.ones((len(rgb), 1), light.dtype)
    return np.rint(np.concatenate([light, opaque], 1).clip(0, 1) * 65535).astype("<u2")
