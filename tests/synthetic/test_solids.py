"""The solids of random worlds: distance, ray hits, atlas coordinates and meshes tell the same story."""

import numpy as np
import pytest
import torch

from refield.synthetic.compound import Compound, Part
from refield.synthetic.shapes import Box, Cylinder
from refield.synthetic.solids import Convex, Ellipsoid, RoundedBox, prism
from refield.synthetic.terrain import Terrain

LEANING = ((0.8, 0.0, -0.6), (0.0, 1.0, 0.0), (0.6, 0.0, 0.8))
SOLIDS = {
    "stone": Convex.of(np.random.default_rng(0).normal(size=(15, 3)) * 0.2),
    "frustum": prism([(0, 0), (0.3, 0), (0.1, 0.2)], 0.4, 0.5),
    "ellipsoid": Ellipsoid((0.3, 0.2, 0.1)),
    "rounded": RoundedBox((0.3, 0.2, 0.1), 0.05),
    "apart": Compound.of(
        [
            Part(Box((0.1, 0.05, 0.15)), (0.0, 0.0, 0.0), LEANING),
            Part(Ellipsoid((0.1, 0.1, 0.2)), (-0.3, 0.1, 0.0)),
            Part(Cylinder(0.05, 0.3), (0.3, 0.0, 0.0)),
        ]
    ),
    "terrain": Terrain(2.0, (0.1, 0.05), (0.2, 0.6), ((2.0, 1.0, 0.3, 0.03),)),
}
ALL = pytest.mark.parametrize("solid", SOLIDS.values(), ids=SOLIDS)
CURVED = 0.004  # metres: how far a flat facet lies from a curved surface here


def rays_at(solid, n=2000, seed=0):
    g = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=torch.float64), dim=-1) * 4
    goals = (torch.rand(n, 3, generator=g, dtype=torch.float64) * 2 - 1) * torch.tensor(solid.half) * 1.2
    return origins, torch.nn.functional.normalize(goals - origins, dim=-1)


def mesh_hits(solid, origins, directions):
    """By every triangle (Möller and Trumbore)."""
    vertices, _, faces = solid.mesh()
    a, b, c = (torch.from_numpy(vertices[faces[:, k]].astype(float)) for k in range(3))
    out = []
    for o, d in zip(origins, directions):
        p = torch.linalg.cross(d.expand_as(a), c - a)
        scale = ((b - a) * p).sum(-1)
        u = ((o - a) * p).sum(-1) / scale
        q = torch.linalg.cross(o - a, b - a)
        v, t = (q @ d) / scale, ((c - a) * q).sum(-1) / scale
        out.append(torch.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, torch.inf).min())
    return torch.stack(out)


@ALL
def test_hits_lie_on_the_surface_and_nothing_is_inside_before_them(solid):
    origins, directions = rays_at(solid)
    t = solid.hit(origins, directions)
    hit = t.isfinite()
    assert 0.1 < hit.double().mean() < 1
    assert solid.distance(origins[hit] + t[hit, None] * directions[hit]).abs().max() < 1e-6
    for part in torch.linspace(0.7, 0.999, 12):
        assert (solid.distance(origins[hit] + part * t[hit, None] * directions[hit]) > -1e-9).all()
    far = torch.linspace(1.5, 6.5, 300, dtype=torch.float64)
    line = origins[~hit][:, None] + far[:, None] * directions[~hit][:, None]
    assert (solid.distance(line) > -1e-9).all()


@ALL
def test_hits_are_those_of_the_mesh(solid):
    origins, directions = rays_at(solid, 150, seed=1)
    ours, theirs = solid.hit(origins, directions), mesh_hits(solid, origins, directions)
    both = ours.isfinite() & theirs.isfinite()
    assert both.sum() > 15 and (ours.isfinite() == theirs.isfinite()).double().mean() > 0.97
    assert (ours - theirs)[both].abs().median() < CURVED
    assert ((ours - theirs)[both].abs() < 20 * CURVED).double().mean() > 0.97  # grazing rays differ by more


@ALL
def test_meshes_are_closed_face_outwards_and_lie_on_the_surface(solid):
    vertices, uv, faces = solid.mesh()
    assert np.abs(solid.distance(torch.from_numpy(vertices.astype(float))).numpy()).max() < 1e-6
    assert np.allclose(np.abs(vertices).max(0), solid.half, atol=0.02 if isinstance(solid, Terrain) else 1e-6) or (
        isinstance(solid, Terrain)
    )
    assert uv.min() >= 0 and uv.max() <= 1
    corners = vertices[faces].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.abs(normals.sum(0)).max() < 1e-4  # a closed surface has as much area each way
    area = np.linalg.norm(normals, axis=-1)
    good = area > 1e-3 * np.median(area)
    out = corners.mean(1)[good] + 0.01 * normals[good] / area[good, None]
    assert (solid.distance(torch.from_numpy(out)) > 0).double().mean() > 0.99


@ALL
def test_a_meshes_atlas_coordinates_are_the_solids_own(solid):
    vertices, uv, faces = solid.mesh()
    inner = np.array([0.5, 0.3, 0.2])
    x = np.einsum("k,fkc->fc", inner, vertices[faces].astype(float))
    meant = np.einsum("k,fkc->fc", inner, uv[faces].astype(float))
    difference = np.abs(solid.uv(torch.from_numpy(x)).numpy() - meant).max(-1)
    assert (difference < 0.01).mean() > 0.97  # but around poles and seams
    assert np.median(difference) < 1e-3


def test_equal_solids_are_equal_and_can_be_keys():
    again = Compound.of([Part(p.solid, p.at, p.turn) for p in SOLIDS["apart"].parts])
    assert again == SOLIDS["apart"] and hash(again) == hash(SOLIDS["apart"])
    assert SOLIDS["stone"] == Convex(SOLIDS["stone"].corners) != SOLIDS["frustum"]


def test_a_frustum_has_its_volume_and_a_box_its_faces():
    vertices, _, faces = prism([(0, 0), (0.3, 0), (0.3, 0.2), (0, 0.2)], 0.4, 0.5).mesh()
    corners = vertices[faces].astype(float)
    volume = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(0.06 * 0.4 * (1 + 0.5 + 0.25) / 3, rel=1e-5)
    assert len(prism([(0, 0), (1, 0), (1, 1), (0, 1)], 1.0).faces) == 6


def test_a_rounded_box_is_a_box_without_its_edges():
    rounded, box = RoundedBox((0.3, 0.2, 0.1), 0.05), Box((0.3, 0.2, 0.1))
    x = torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.0, -0.1], [0.3, 0.2, 0.1]], dtype=torch.float64)
    assert torch.allclose(rounded.distance(x[:2]), box.distance(x[:2]))
    assert float(rounded.distance(x[2])) == pytest.approx(0.05 * (3**0.5 - 1))


def test_terrain_is_as_high_as_it_says_and_its_normals_stand_on_it():
    terrain = SOLIDS["terrain"]
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    for x, y in ((0.0, 0.0), (0.7, -1.1)):
        t = terrain.hit(torch.tensor([[x, y, 3.0]], dtype=torch.float64), down)
        assert 3 - float(t) == pytest.approx(float(terrain.height(torch.tensor(x), torch.tensor(y))), abs=1e-6)
        up, step = terrain.normal(x, y), 1e-4
        for a in ((step, 0.0), (0.0, step)):
            here, there = (float(terrain.height(*torch.tensor(p).double())) for p in ((x, y), (x + a[0], y + a[1])))
            assert abs(np.dot(up, [*a, there - here])) < 1e-6
