"""Solids: distance, ray hits, atlas coordinates and meshes tell the same story."""

import numpy as np
import pytest
import torch

from refield.synthetic.shapes import Box, Cone, Cylinder, Sphere

SOLIDS = [Box((0.3, 0.2, 0.1)), Sphere(0.2), Cylinder(0.15, 0.4), Cone(0.2, 0.5), Box((1.2, 1.2, 0.04))]
ROUND = [s for s in SOLIDS if not isinstance(s, Box)]


def rays_at(solid, n=4000, seed=0):
    """Rays from around towards points near the solid."""
    g = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=torch.float64), dim=-1) * 3
    goals = (torch.rand(n, 3, generator=g, dtype=torch.float64) * 2 - 1) * torch.tensor(solid.half) * 1.3
    return origins, torch.nn.functional.normalize(goals - origins, dim=-1)


@pytest.mark.parametrize("solid", SOLIDS, ids=repr)
def test_hits_lie_on_the_surface_and_nothing_is_inside_before_them(solid):
    origins, directions = rays_at(solid)
    t = solid.hit(origins, directions)
    hit = t.isfinite()
    assert 0.3 < hit.double().mean() < 1
    at = origins[hit] + t[hit, None] * directions[hit]
    assert solid.distance(at).abs().max() < 1e-6
    for part in torch.linspace(0.5, 0.999, 12):
        assert (solid.distance(origins[hit] + part * t[hit, None] * directions[hit]) > -1e-9).all()
    # a ray that misses never comes inside
    far = torch.linspace(1.5, 4.5, 400, dtype=torch.float64)
    line = origins[~hit][:, None] + far[:, None] * directions[~hit][:, None]
    assert (solid.distance(line) > -1e-9).all()


@pytest.mark.parametrize("solid", SOLIDS, ids=repr)
def test_distance_is_a_distance(solid):
    g = torch.Generator().manual_seed(1)
    x = (torch.rand(3000, 3, generator=g, dtype=torch.float64) * 4 - 2) * torch.tensor(solid.half)
    x.requires_grad_(True)
    d = solid.distance(x)
    (slope,) = torch.autograd.grad(d.sum(), x)
    assert torch.allclose(slope.norm(dim=-1), torch.ones(len(x), dtype=torch.float64), atol=1e-6)
    # walking the distance along the slope ends on the surface, outside the solid always
    outside = d > 1e-3
    foot = (x - d[:, None] * slope)[outside].detach()
    assert solid.distance(foot).abs().max() < 1e-6


@pytest.mark.parametrize("solid", SOLIDS, ids=repr)
def test_meshes_are_closed_and_lie_on_the_surface(solid):
    vertices, uv, faces = solid.mesh()
    assert np.abs(solid.distance(torch.from_numpy(vertices.astype(float))).numpy()).max() < 1e-6
    assert uv.min() >= 0 and uv.max() <= 1
    corners = vertices[faces].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = corners.mean(1)
    assert ((normals * middle).sum(-1) > -1e-9).all()  # outward
    volume = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum(-1).sum() / 6
    expected = {
        Box: lambda s: 8 * np.prod(s.half),
        Sphere: lambda s: 4 / 3 * np.pi * s.radius**3,
        Cylinder: lambda s: np.pi * s.radius**2 * s.height,
        Cone: lambda s: np.pi * s.radius**2 * s.height / 3,
    }[type(solid)](solid)
    assert volume == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("solid", ROUND, ids=repr)
def test_atlas_coordinates_and_points_are_inverse(solid):
    origins, directions = rays_at(solid, seed=3)
    t = solid.hit(origins, directions)
    x = (origins + t[:, None] * directions)[t.isfinite()]
    uv = solid.uv(x)
    assert torch.allclose(solid.at(uv), x, atol=1e-5)


def test_the_faces_of_a_box_have_their_own_atlas_cells():
    solid = Box((1.2, 1.2, 0.04))
    top = torch.tensor([[1.19, -1.19, 0.04], [0.0, 0.0, 0.039], [1.19, 0.0, 0.035]], dtype=torch.float64)
    uv = solid.uv(top)
    assert ((uv[:, 0] > 2 / 3) & (uv[:, 1] > 1 / 2)).all()
    cells = set()
    for axis in range(3):
        for sign in (-1.0, 1.0):
            x = torch.zeros(3, dtype=torch.float64)
            x[axis] = sign * solid.half[axis]
            u, v = solid.uv(x).tolist()
            cells.add((int(u * 3), int(v * 2)))
    assert len(cells) == 6


@pytest.mark.parametrize("solid", SOLIDS, ids=repr)
def test_a_meshes_atlas_coordinates_are_the_solids_own(solid):
    """What the renderer interpolates is what the closed form says."""
    vertices, uv, faces = solid.mesh()
    inner = np.array([0.5, 0.3, 0.2])
    x = np.einsum("k,fkc->fc", inner, vertices[faces].astype(float))
    meant = np.einsum("k,fkc->fc", inner, uv[faces].astype(float))
    got = solid.uv(torch.from_numpy(x)).numpy()
    difference = np.abs(got - meant)
    difference[:, 0] = np.minimum(difference[:, 0], 1 - difference[:, 0])
    on_axis = np.linalg.norm(x[:, :2], axis=-1) < 0.02 * solid.half[0]
    assert difference[~on_axis].max() < 0.012
