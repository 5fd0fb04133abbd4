"""Point clouds and meshes in the PLY format. Read: only what SfM tools write (vertex x y z, ASCII or little-endian)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.scene.errors import InputError
from refield.scene.files import write_bytes

MAX_POINTS = 50_000_000
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4",
    "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip


def write_points(path: Path, points: Tensor) -> None:
    """Write (P, 3) points as a little-endian PLY, at once."""
    write_surface(path, points)


def write_surface(
    path: Path,
    points: Tensor,
    *,
    normals: Tensor | None = None,
    rgb: Tensor | None = None,
    faces: Tensor | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write (P, 3) points, if given with their normals (P, 3), colours (P, 3) in [0, 1] and triangles (F, 3), as a
    little-endian PLY, at once. ``comments``: ASCII lines for its header."""
    kinds = [(axis, "<f4", "float") for axis in "xyz"]
    columns = list(_rows(points).T)
    if normals is not None:
        kinds += [(f"n{axis}", "<f4", "float") for axis in "xyz"]
        columns += list(_rows(normals).T)
    if rgb is not None:
        kinds += [(name, "u1", "uchar") for name in ("red", "green", "blue")]
        columns += list(np.rint(_rows(rgb).clip(0, 1) * 255).T)
    vertices = np.zeros(len(points), [(name, dtype) for name, dtype, _ in kinds])
    for (name, _, _), column in zip(kinds, columns):
        vertices[name] = column
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    lines += [f"element vertex {len(vertices)}", *(f"property {word} {name}" for name, _, word in kinds)]
    data = vertices.tobytes()
    if faces is not None:
        triangles = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
        triangles["count"], triangles["corners"] = 3, faces.cpu().numpy()
        lines += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        data += triangles.tobytes()
    write_bytes(path, "\n".join([*lines, "end_header\n"]).encode("ascii") + data)


def _rows(values: Tensor) -> NDArray[np.float32]:
    return values.detach().cpu().numpy().astype("<f4")


def read_points(path: Path) -> Tensor:
    """The vertices' positions, (P, 3) float32; colours and normals are passed over.

    Raises:
        InputError: not a PLY, big-endian, lists before the vertices, truncated, or not finite.
    """
    try:
        raw = path.read_bytes()
        head, body = raw.split(b"end_header\n", 1)
        lines = [line.split() for line in head.decode("ascii").splitlines()]
        binary = {"binary_little_endian": True, "ascii": False}[_after(lines, "format")[0]]
        name, count = _after(lines, "element")[:2]
        dtype = np.dtype(_vertex_properties(lines))
        if name != "vertex" or not 0 <= int(count) <= MAX_POINTS:
            raise ValueError(f"first element is {name} x {count}")
        if binary:
            rows = np.frombuffer(body, dtype, int(count))
            xyz = np.stack([rows[axis] for axis in "xyz"], -1).astype("f4")
        else:
            columns = [list(dtype.names or ()).index(axis) for axis in "xyz"]
            text = body.decode("ascii").splitlines()[: int(count)]
            xyz = np.array([[row.split()[c] for c in columns] for row in text], "f4").reshape(int(count), 3)
        if not np.isfinite(xyz).all():
            raise ValueError("positions that are not finite")
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "check the path") from None
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(path, f"is not a usable point cloud ({error})", "write it as x y z PLY or remove it") from None
    return torch.from_numpy(xyz)


def _after(lines: list[list[str]], word: str) -> list[str]:
    return next((line[1:] for line in lines if line[:1] == [word]), [])


def _vertex_properties(lines: list[list[str]]) -> list[tuple[str, str]]:
    """The properties of the first element, as numpy wants them."""
    start = next(i for i, line in enumerate(lines) if line[:1] == ["element"])
    out: list[tuple[str, str]] = []
    for line in lines[start + 1 :]:
        if line[:1] == ["element"]:
            break
        if line[:1] == ["property"]:
            out.append((line[2], _TYPES[line[1]]))
    return out
