"""How far an exported mesh lies from the true surfaces of a known world, both ways: the chamfer distance.

    refield synth cube OUT && refield train OUT/before WORK && refield export WORK --out FILES --what mesh
    python benchmarks/mesh.py FILES/mesh.ply cube OUT/before

From the mesh to the truth: points drawn evenly on its triangles, and the true signed distance there. From the truth to
the mesh: points of the true surfaces that the photos show, one in each cell of `_CELL`, and the nearest of the mesh's
points. The chamfer distance is the mean of the two means. Lengths are metres, as the worlds are.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from refield.scene.capture import Frame, camera_rays
from refield.scene.load import load_capture
from refield.synthetic.state import State
from refield.synthetic.visibility import first_hits
from refield.synthetic.worlds import WORLDS

_CELL = 0.005  # metres: of the true points
_SPACING = 0.0015  # metres: between the mesh's points, about; by half of it the nearest one may be off
_NEAR = 0.03  # metres: from a thing's surface, and what is said of the thing alone


def drawn_on(mesh: trimesh.Trimesh) -> Tensor:
    """Points (P, 3) float64 spread evenly over the triangles."""
    count = int(mesh.area / _SPACING**2)
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
    return torch.from_numpy(np.asarray(points))


def shown(state: State, frames: Sequence[Frame]) -> Tensor:
    """True surface points (P, 3) float64 at the photos' pixel centres, one for each cell."""
    found = []
    for frame in frames:
        rays = camera_rays(frame.camera, frame.world_from_cam)
        depth = first_hits(state, rays).depth.double()
        there = depth.isfinite()
        found.append(rays.origins[there].double() + rays.directions[there].double() * depth[there][:, None])
    points = torch.cat(found)
    _, first = np.unique((points / _CELL).floor().long().numpy(), axis=0, return_index=True)
    return points[torch.from_numpy(first)]


def distances(mesh: trimesh.Trimesh, state: State, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """From the mesh's points (P, 3) to the true surfaces (P,), and from true points to the mesh's; the former too."""
    on_mesh = drawn_on(mesh)
    to_truth = torch.stack([item.distance(on_mesh).abs() for item in state.items]).amin(0)
    to_mesh = torch.from_numpy(cKDTree(on_mesh.numpy()).query(truth.numpy())[0])
    return on_mesh, to_truth, to_mesh


def row(name: str, to_truth: Tensor, to_mesh: Tensor) -> str:
    """Centimetres."""
    chamfer = 100 * (to_truth.mean() + to_mesh.mean()) / 2
    parts = [
        f"{100 * d.mean():.2f} ({100 * d.quantile(0.5):.2f}, {100 * d.quantile(0.95):.2f})"
        for d in _few(to_truth, to_mesh)
    ]
    return f"| {name} | {chamfer:.2f} | {parts[0]} | {parts[1]} |"


def _few(*values: Tensor) -> list[Tensor]:
    """At most a million of each, which is what torch takes quantiles of."""
    return [v[:: max(len(v) // 1_000_000, 1) + (len(v) > 1_000_000)] for v in values]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("world", choices=sorted(WORLDS))
    parser.add_argument("capture", type=Path, help="the photos that the field was trained on")
    parser.add_argument("--after", action="store_true", help="the world after its change")
    asked = parser.parse_args()
    world = WORLDS[asked.world](0)
    state = world.after if asked.after else world.before
    mesh = trimesh.load(asked.mesh, process=False)
    truth = shown(state, load_capture(asked.capture).frames)
    on_mesh, to_truth, to_mesh = distances(mesh, state, truth)
    print("| | chamfer, cm | mesh to truth: mean (median, 95 %) | truth to mesh |\n|---|---|---|---|")
    print(row("all that the photos show", to_truth, to_mesh))
    for item in state.items:
        near, own = (item.distance(points).abs() < _NEAR for points in (on_mesh, truth))
        print(row(item.name, to_truth[near], to_mesh[own]))


if __name__ == "__main__":
    main()
