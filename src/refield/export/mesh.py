"""A triangle mesh through the points of a surface: marching cubes where a smooth field of signed distances is nought.

The distance at a place is the mean of those to the tangent planes of the points around it; it is asked only near
points, so that what nobody has seen stays open.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refield.export.gltf import Glb
from refield.export.surface import Points
from refield.scene.errors import InputError
from refield.scene.files import write_bytes
from refield.scene.ply import write_surface
from refield.scene.world import World

FACES = 200_000
"""of a mesh, at most: more are decimated"""
_CELLS = 40_000_000  # of the lattice, at most
_NEAR, _WIDER = 0.05, 4.0  # of the points at least are what the photos are of; they are no farther apart than so many
# times as they are in its densest parts, and half of those are closer than a cell
_COARSE = 3.0  # cells: points that are farther apart are left out
_REACH = 3.0  # cells, or spacings if these are more, from the nearest point: there a distance is believed
_AMONG = 8  # points whose planes are averaged
_CRUMB = 0.002  # of all faces: what hangs together and is less is left out
_INSIDE = 0.005  # of the points on either side, along each axis, may lie outside of the lattice


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the world."""

    xyz: Tensor
    """(P, 3) float32"""
    faces: Tensor
    """(F, 3) int64, counterclockwise from where the surface is seen"""
    normals: Tensor
    """(P, 3) float32, unit"""
    rgb: Tensor
    """(P, 3) float32 in [0, 1]"""


def mesh_of(points: Points, most: int = FACES) -> Mesh | None:
    """The surface on which ``points`` lie, of ``most`` faces about; None where they are too few to tell."""
    from scipy.spatial import cKDTree
    from skimage.measure import marching_cubes

    if len(points) <= _AMONG:
        return None
    low, cell, shape = _lattice(points)
    points = points[(points.spacing < _COARSE * cell) & _within(points.xyz, low, cell, shape)]
    if len(points) <= _AMONG:
        return None
    tree = cKDTree(points.xyz.numpy())
    distance, sure = _distances(points, tree, low, cell, shape)
    if not (sure.any() and distance[sure].min() < 0 < distance[sure].max()):
        return None
    # "descent" turns faces towards the larger values: the outside
    xyz, faces, _, _ = marching_cubes(distance, 0.0, mask=sure, gradient_direction="descent", allow_degenerate=False)
    xyz, faces = _without_crumbs(xyz * cell + low.numpy(), faces.astype(np.int64))
    if len(faces) > most:
        xyz, faces = _decimated(xyz, faces, most)
    near = tree.query(xyz, 4)
    return _coloured(points, xyz, faces, *near) if len(faces) else None


def _lattice(points: Points) -> tuple[Tensor, float, tuple[int, ...]]:
    """The first node (3,), the distance between nodes and how many there are along each axis."""
    close = points.spacing < _WIDER * float(np.quantile(points.spacing.numpy(), _NEAR))
    cell = float(points.spacing[close].median())
    within = points.xyz[points.spacing < _COARSE * cell].numpy()
    low, high = (torch.from_numpy(np.quantile(within, q, 0)).float() for q in (_INSIDE, 1 - _INSIDE))
    low, high = low - 4 * cell, high + 4 * cell
    cell = max(cell, (float((high - low).prod()) / _CELLS) ** (1 / 3))
    return low, cell, tuple(int(n) for n in ((high - low) / cell).ceil().long() + 1)


def _within(xyz: Tensor, low: Tensor, cell: float, shape: tuple[int, ...]) -> Tensor:
    place = (xyz - low) / cell
    return ((place >= 2) & (place < torch.tensor(shape) - 3)).all(-1)


def _distances(
    points: Points, tree: object, low: Tensor, cell: float, shape: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Signed distances on the lattice, and where they are believed, both ``shape``."""
    from scipy.ndimage import binary_dilation, binary_erosion

    band = np.zeros(shape, bool)
    band[tuple(((points.xyz - low) / cell).round().long().T.numpy())] = True
    cube = np.ones((3, 3, 3), bool)
    band = binary_dilation(band, cube, iterations=math.ceil(_REACH) + 1)
    nodes = np.argwhere(band)
    distance, sure = np.ones(shape, np.float32), np.zeros(shape, bool)
    for part in np.array_split(nodes, max(len(nodes) // 200_000, 1)):
        at = torch.from_numpy(part).float() * cell + low
        far, near = tree.query(at.numpy(), _AMONG)  # type: ignore[attr-defined]
        far = torch.from_numpy(far).float()
        wide = points.spacing[near[:, 0]].clamp_min(cell)
        weight = torch.exp(-((far / wide[:, None]) ** 2) + (far[:, :1] / wide[:, None]) ** 2)
        to_plane = ((at[:, None] - points.xyz[near]) * points.normal[near]).sum(-1)
        place = tuple(part.T)
        distance[place] = ((weight * to_plane).sum(1) / weight.sum(1)).numpy()
        sure[place] = (far[:, 0] < _REACH * wide).numpy()
    return distance, binary_erosion(sure, cube)


def _without_crumbs(
    xyz: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Without what hangs together and is small, and without vertices that no face has."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), bool), tuple(edges.T)), shape=(len(xyz),) * 2)
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    kept = faces[np.bincount(label)[label] >= _CRUMB * len(faces)]
    used, renamed = np.unique(kept, return_inverse=True)
    return xyz[used], renamed.reshape(-1, 3)


def _decimated(
    xyz: NDArray[np.float64], faces: NDArray[np.int64], most: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    from fast_simplification import simplify

    xyz32, faces32 = np.ascontiguousarray(xyz, np.float32), np.ascontiguousarray(faces, np.int32)
    fewer = simplify(xyz32, faces32, target_count=most)
    return fewer[0].astype(np.float64), fewer[1].astype(np.int64)


def _coloured(
    points: Points,
    xyz: NDArray[np.float64],
    faces: NDArray[np.int64],
    far: NDArray[np.float64],
    near: NDArray[np.int64],
) -> Mesh:
    """With the colours of the four points nearest to each vertex, the nearest most, and normals of its faces."""
    weight = torch.from_numpy(1 / (far + 1e-3 * far.mean() + 1e-12)).float()[..., None]
    rgb = (weight * points.rgb[near]).sum(1) / weight.sum(1)
    corners = xyz[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.zeros_like(xyz)
    for k in range(3):
        np.add.at(normal, faces[:, k], area)
    normals = torch.nn.functional.normalize(torch.from_numpy(normal), dim=-1, eps=1e-30).float()
    # a vertex between faces that cancel each other has none: its points' then
    normals = torch.where(normals.norm(dim=-1, keepdim=True) < 0.5, points.normal[near[:, 0]], normals)
    return Mesh(torch.from_numpy(xyz).float(), torch.from_numpy(faces), normals, rgb)


def write_mesh(folder: Path, name: str, mesh: Mesh, world: World, facts: dict[str, object]) -> list[Path]:
    """``name.ply`` in the world's coordinates and ``name.glb``, see `refield.export.gltf`."""
    ply, glb = folder / f"{name}.ply", folder / f"{name}.glb"
    write_surface(ply, mesh.xyz, normals=mesh.normals, rgb=mesh.rgb, faces=mesh.faces, comments=[f"refield {name}"])
    file = Glb(world, facts)
    file.add_node(name, mesh=file.add_mesh(mesh.xyz, mesh.faces, normals=mesh.normals, rgb=mesh.rgb))
    write_bytes(glb, file.to_bytes())
    return [ply, glb]


def need_a_mesh(mesh: Mesh | None, where: Path) -> Mesh:
    """The mesh.

    Raises:
        InputError: there is none.
    """
    if mesh is None:
        raise InputError(where, "shows too few surfaces that its views agree on for a mesh", "leave the mesh out")
    return mesh
