"""``refield export``: each file is opened by another program's reader, and what it holds is compared with the world."""

import gzip
import json
import math
import shutil
import struct
import subprocess
import sys
from dataclasses import replace

import gsply
import numpy as np
import pygltflib
import pytest
import torch
import trimesh

from refield.artefacts import LOCK, locked
from refield.cli import main
from refield.export.gltf import ROOT, quaternion, upright
from refield.export.recipe import ExportConfig, export
from refield.export.surface import Points, _depth_near, cells_of
from refield.field.render import render_camera
from refield.scene.change import PlacedPhoto, SceneChange
from refield.scene.colmap import load_colmap
from refield.scene.images import read_image
from refield.scene.pose import exp, invert, transform
from refield.scene.transforms_json import load_transforms
from refield.scene.world import World
from refield.workspace import Workspace
from tests.export.drawn import draw
from tests.export.solid import (
    BOX,
    CAMERA,
    NEW_FROM_OLD,
    SLAB,
    WORLD,
    corners,
    distance,
    make_workspace,
    moved_corners,
    solid_field,
)
from tests.folders import contents

DC = 0.28209479177387814


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """``data``, ``work`` and ``out``, the whole export with its objects."""
    folder = tmp_path_factory.mktemp("solid")
    make_workspace(folder)
    before = contents(folder / "work")
    assert main(["export", str(folder / "work"), "--out", str(folder / "out"), "--objects"]) == 0
    assert contents(folder / "work") == before
    return folder


def cloud(path):
    """Points, normals and colours in [0, 1] of a PLY, as trimesh reads them."""
    read = trimesh.load(path, process=False)
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.stack([data[k] for k in ("nx", "ny", "nz")], -1)
    return torch.tensor(read.vertices), torch.from_numpy(normals).double(), torch.tensor(read.colors)[:, :3] / 255


def outward(x):
    """Directions (P, 3) in which the distance to the true surfaces grows."""
    x = x.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(distance(x).sum(), x)
    return gradient


def on_tops(box, step=0.05):
    """Points (P, 3) on the upper side of a box."""
    low, high = box.tolist()
    x, y = (torch.arange(a + step, b - step, step) for a, b in zip(low[:2], high[:2]))
    return torch.cartesian_prod(x, y, torch.tensor([high[2]])).double()


def test_points_lie_on_the_surfaces(made):
    points, normals, colours = cloud(made / "out/points.ply")
    off = distance(points).abs()
    assert len(points) > 2000 and off.quantile(0.95) < 0.02 and off.median() < 0.01
    # and everywhere on what can be seen
    floor = on_tops(SLAB)
    seen = torch.cat([floor[(floor[:, :2].abs() > BOX[1, :2] + 0.1).any(-1)], on_tops(BOX)])
    assert torch.cdist(seen, points).amin(1).max() < 0.08
    # normals look outwards, where the surface is flat
    flat = (distance(points + 0.05 * outward(points)) - 0.05).abs() < 0.01
    assert ((normals * outward(points)).sum(-1)[flat] > 0.9).float().mean() > 0.85
    # colours are those of the photos that show the point
    frame = load_transforms(made / "data").frames[0]
    pixels, _ = frame.camera.project(transform(invert(frame.world_from_cam), points))
    picture = read_image(frame.path) / 255
    top = (points[:, 2] > BOX[1, 2] - 0.02) & (points[:, :2].abs() < 0.2).all(-1)
    u, v = pixels[top].long().T
    assert top.sum() > 50 and (picture[v, u] - colours[top]).abs().mean() < 0.05


def test_the_mesh_follows_the_surfaces(made):
    read = trimesh.load(made / "out/mesh.ply", process=False)
    points = torch.tensor(read.sample(4000, seed=0))
    assert distance(points).abs().mean() < 0.01
    assert torch.cdist(on_tops(BOX), points).amin(1).mean() < 0.04
    middles, normals = torch.tensor(read.triangles_center), torch.tensor(read.face_normals)
    right = (normals * outward(middles)).sum(-1) > 0.7
    assert torch.tensor(read.area_faces)[right].sum() / read.area > 0.85  # all but the rims of what is open
    # the same in glTF: below the node that turns it upright its numbers are the world's
    scene = trimesh.load(made / "out/mesh.glb", process=False)
    (shape,) = scene.geometry.values()
    assert np.allclose(shape.vertices, read.vertices, atol=1e-6) and np.array_equal(shape.faces, read.faces)
    turned, _ = scene.graph.get(scene.graph.nodes_geometry[0])
    assert np.allclose(turned, [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], atol=1e-7)
    file = pygltflib.GLTF2().load(str(made / "out/mesh.glb"))
    accessor = file.accessors[file.meshes[0].primitives[0].attributes.COLOR_0]
    view = file.bufferViews[accessor.bufferView]
    raw = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    light = np.frombuffer(raw, "<u2").reshape(-1, 4)[:, :3] / 65535
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert accessor.normalized and np.abs(srgb * 255 - read.visual.vertex_colors[:, :3]).max() < 0.6


def test_a_mesh_has_no_more_faces_than_asked(made, tmp_path):
    argv = ["export", str(made / "work"), "--out", str(tmp_path), "--what", "mesh", "--faces", "3000"]
    assert main(argv) == 0
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert 1000 < len(read.faces) <= 3000
    assert distance(torch.tensor(read.sample(4000, seed=0))).abs().mean() < 0.02
    assert {p.name for p in tmp_path.iterdir()} == {"mesh.ply", "mesh.glb", "export.json"}


def read_spz(path):
    """By the format's own description: one gzip stream of version 3, its sections one after the other."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, _, _ = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, degree) == (0x5053474E, 3, 0)
    sizes = [9, 1, 3, 3, 4]
    starts = np.cumsum([16, *(s * count for s in sizes)])
    assert starts[-1] == len(data)
    parts = [np.frombuffer(data, np.uint8, s * count, int(b)).reshape(count, s) for s, b in zip(sizes, starts)]
    xyz = parts[0].reshape(count, 3, 3).astype(np.int32)
    xyz = xyz[..., 0] | xyz[..., 1] << 8 | (xyz[..., 2] << 16)
    means = np.where(xyz >= 1 << 23, xyz - (1 << 24), xyz) / (1 << bits)
    rgb = ((parts[2] / 255 - 0.5) / 0.15) * DC + 0.5
    return means, np.exp(parts[3] / 16 - 10), _smallest_three(parts[4]), parts[1][:, 0] / 255, rgb


def _smallest_three(packed):
    """Quaternions wxyz from two bits that name the largest of xyzw and ten for each other."""
    word = packed.copy().view("<u4")[:, 0]
    largest, out = word >> 30, np.zeros((len(word), 4))
    for k in range(3, -1, -1):
        here = largest != k
        value = (word & 511) / 511 * math.sqrt(0.5) * np.where(word >> 9 & 1, -1, 1)
        out[here, k] = value[here]
        word = np.where(here, word >> 10, word)
    rows = np.arange(len(out))
    out[rows, largest] = np.sqrt(np.maximum(1 - (out**2).sum(1), 0))
    return np.roll(out, 1, axis=1)


def read_splats(path):
    """A 3DGS PLY, by its own header."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in head.decode().splitlines() if line.startswith("property float")]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))
    column = {name: rows[:, i].astype(float) for i, name in enumerate(names)}

    def stack(*keys):
        return np.stack([column[k] for k in keys], -1)

    rgb = 0.5 + DC * stack("f_dc_0", "f_dc_1", "f_dc_2")
    scales, turn = np.exp(stack("scale_0", "scale_1", "scale_2")), stack("rot_0", "rot_1", "rot_2", "rot_3")
    return stack("x", "y", "z"), scales, turn, 1 / (1 + np.exp(-column["opacity"])), rgb


def test_both_files_hold_the_same_splats(made):
    ply, spz = read_splats(made / "out/splats.ply"), read_spz(made / "out/splats.spz")
    library = gsply.plyread(made / "out/splats.ply")
    assert np.array_equal(library.means, ply[0].astype(np.float32)) and np.allclose(np.exp(library.scales), ply[1])
    assert np.abs(ply[0] - spz[0]).max() < 1e-4
    assert np.abs(np.log(ply[1] / spz[1])).max() < 1 / 16 and np.abs(ply[3] - spz[3]).max() < 0.01
    # a step of SPZ's colours is 1/153 of the harmonic's coefficient
    assert np.abs(ply[4] - spz[4]).max() < 0.01
    same = np.abs((ply[2] * spz[2]).sum(1)) / np.linalg.norm(ply[2], axis=1)
    assert same.min() > 0.9999


def test_splats_are_discs_on_the_surfaces(made):
    means, scales, turn, opacities, _ = read_splats(made / "out/splats.ply")
    near = np.linalg.norm(means, axis=1) < 2
    assert near.sum() > 2000 and (~near).sum() > 1000  # and the sky
    assert distance(torch.from_numpy(means[near])).abs().quantile(0.95) < 0.02
    assert np.allclose(scales[:, 2] / scales[:, 0], 0.1, atol=1e-3) and np.allclose(scales[:, 0], scales[:, 1])
    assert (opacities > 0.95).all() and np.median(scales[near, 0]) == pytest.approx(0.012, rel=0.5)
    w, x, y, z = turn[near].T
    normals = torch.from_numpy(np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1))
    assert ((normals * outward(torch.from_numpy(means[near]))).sum(-1) > 0.8).float().mean() > 0.8


@pytest.mark.parametrize("name", ["splats.ply", "splats.spz"])
def test_splats_look_like_the_field(made, name):
    """From between the photos' places; a pinhole camera, because that is what viewers draw."""
    splats = (read_splats if name.endswith("ply") else read_spz)(made / "out" / name)
    pinhole, field = replace(CAMERA, k1=0.0, k2=0.0, p1=0.0, p2=0.0), solid_field()
    for frame in load_transforms(made / "work/visits/001/photos", decode=False).frames:
        truth = render_camera(field, pinhole, frame.world_from_cam).rgb.numpy()
        picture = draw(splats, pinhole, invert(frame.world_from_cam).numpy())
        assert -10 * np.log10(((picture - truth) ** 2).mean()) > 26


def test_cameras_are_the_captures(made):
    given = load_transforms(made / "data").frames
    for folder, frames in (("capture", given), ("visit_1", load_transforms(made / "work/visits/001/photos").frames)):
        out = made / "out/cameras" / folder
        nerfstudio, colmap = load_transforms(out), load_colmap(out)
        cameras = trimesh_cameras(out / "cameras.glb")
        assert len(frames) == len(nerfstudio.frames) == len(colmap.frames) == len(cameras)
        for a, b, c, (pose, yfov) in zip(frames, nerfstudio.frames, colmap.frames, cameras):
            assert a.camera == b.camera == c.camera
            assert torch.allclose(a.world_from_cam, b.world_from_cam, atol=1e-9)
            assert torch.allclose(a.world_from_cam, c.world_from_cam, atol=1e-9)
            assert torch.equal(read_image(a.path), read_image(b.path)) and c.path == b.path
            assert torch.allclose(
                pose @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double(), a.world_from_cam, atol=1e-6
            )
            assert yfov == pytest.approx(2 * math.atan(36 / 110))
    assert torch.allclose(load_colmap(made / "out/cameras/capture").points, torch.tensor([[0.1, 0.2, 0.25]]))


def trimesh_cameras(path):
    """Poses in the world and fields of view of the cameras of a glTF file."""
    file = pygltflib.GLTF2().load(str(path))
    nodes = [file.nodes[i] for i in file.nodes[0].children]
    assert file.nodes[0].name == ROOT
    return [(pose_of(n), file.cameras[n.camera].perspective.yfov) for n in nodes]


def pose_of(node):
    """(4, 4) float64 of a glTF node."""
    x, y, z, w = node.rotation
    out = torch.from_numpy(trimesh.transformations.quaternion_matrix([w, x, y, z]))
    out[:3, 3] = torch.tensor(node.translation, dtype=torch.float64)
    return out


def test_changes_say_what_happened(made):
    data = json.loads((made / "out/changes.json").read_text())
    moved, added, removed = data["objects"]
    assert data["world"]["metres_per_unit"] == 0.5 and data["visit"] == 1
    assert [o["kind"] for o in data["objects"]] == ["moved", "added", "removed"]
    assert [o["confidence"] for o in data["objects"]] == pytest.approx([0.8, 0.6, 0.4])
    assert torch.allclose(torch.tensor(moved["new_from_old"]).double(), NEW_FROM_OLD, atol=1e-6)
    both = torch.tensor(moved["new_from_old"]) @ torch.tensor(moved["old_from_new"])
    assert torch.allclose(both, torch.eye(4), atol=1e-6)
    assert moved["turned_deg"] == pytest.approx(math.degrees(0.5)) and np.shape(moved["covariance"]) == (6, 6)
    assert added["world_from_box_old"] is None and removed["world_from_box_new"] is None
    # the boxes are the true ones, give or take a cell of their grids
    for place in (moved["world_from_box_new"], added["world_from_box_new"], removed["world_from_box_old"]):
        told = moved_corners(place, (moved if place is moved["world_from_box_new"] else added)["box_size"])
        assert torch.cdist(corners(BOX).double(), told).amin(1).max() < 0.08
    old = moved_corners(moved["world_from_box_old"], moved["box_size"])
    assert torch.cdist(transform(invert(NEW_FROM_OLD), corners(BOX).double()), old).amin(1).max() < 0.08
    # glTF's nodes stand where the same boxes do
    file = pygltflib.GLTF2().load(str(made / "out/changes.glb"))
    nodes = {file.nodes[i].name: file.nodes[i] for i in file.nodes[0].children}
    assert set(nodes) == {f"visit_1_object_{i}" for i in ("1_old", "1_new", "2_new", "3_old")}
    for o in data["objects"]:
        for word in ("old", "new"):
            if o[f"world_from_box_{word}"] is not None:
                node = nodes[f"{o['id']}_{word}"]
                assert np.allclose(pose_of(node), o[f"world_from_box_{word}"], atol=1e-6)
                assert node.extras["confidence"] == o["confidence"]
    scene = trimesh.load(made / "out/changes.glb")
    turned, name = scene.graph.get("visit_1_object_2_new")
    box = trimesh.transform_points(scene.geometry[name].vertices, np.linalg.inv(scene.graph.get(ROOT)[0]) @ turned)
    assert torch.cdist(corners(BOX).double(), torch.from_numpy(box)).amin(1).max() < 0.08


def test_objects_by_themselves(made):
    for index in (1, 2, 3):
        points, _, _ = cloud(made / f"out/objects/visit_1_object_{index}_points.ply")
        assert (points > BOX[0] - 0.06).all() and (points < BOX[1] + 0.06).all()
        assert torch.cdist(on_tops(BOX), points).amin(1).max() < 0.09
        assert len(read_splats(made / f"out/objects/visit_1_object_{index}_splats.ply")[0]) == len(points)
        assert len(trimesh.load(made / f"out/objects/visit_1_object_{index}_mesh.glb").geometry) == 1


def test_the_manifest_names_every_file(made):
    manifest = json.loads((made / "out/export.json").read_text())
    there = {p.relative_to(made / "out").as_posix(): p.stat().st_size for p in (made / "out").rglob("*") if p.is_file()}
    there.pop("export.json")
    assert {name: facts["bytes"] for name, facts in manifest["files"].items()} == there
    assert manifest["metres_per_unit"] == WORLD.metres_per_unit and manifest["up"] == [0, 0, 1]


def test_before_any_visit(made, tmp_path, capsys):
    argv = ["export", str(made / "work"), "--out", str(tmp_path / "o"), "--what", "changes", "cameras", "--visit", "0"]
    assert main(argv) == 0
    assert json.loads((tmp_path / "o/changes.json").read_text())["objects"] == []
    assert not (tmp_path / "o/cameras/visit_1").exists()
    assert "changes.json" in capsys.readouterr().out
    pygltflib.GLTF2().load(str(tmp_path / "o/changes.glb"))


@pytest.mark.parametrize(
    ("argv", "told"),
    [
        (["--visit", "2"], "there is no visit 2"),
        (["--points", "3"], "too few"),
        (["--out", "work/capture/out"], "belongs to the workspace"),
        (["--out", "data/transforms.json"], "is a file"),
        (["--out", "work"], "is a workspace"),
        (["--what"], "names nothing"),
    ],
)
def test_what_cannot_be_is_one_line(made, monkeypatch, capsys, argv, told):
    monkeypatch.chdir(made)
    before = contents(made / "work")
    out = [] if "--out" in argv else ["--out", "elsewhere"]
    assert main(["export", "work", *out, *argv]) == 2
    assert told in capsys.readouterr().err
    assert not (made / "elsewhere").exists() and contents(made / "work") == before


@pytest.mark.parametrize(
    ("kind", "module", "package"),
    [
        ("splats", "gsply", "gsply"),
        ("mesh", "skimage", "scikit-image"),
        ("mesh", "fast_simplification", "fast-simplification"),
    ],
)
def test_what_is_not_installed_is_named(made, tmp_path, monkeypatch, capsys, kind, module, package):
    monkeypatch.setitem(sys.modules, module, None)
    assert main(["export", str(made / "work"), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in (f"--what {kind}", package, "pip install 'refield[export]'"))
    assert not (tmp_path / "out").exists()


def test_files_of_others_are_kept(made, tmp_path, capsys):
    (tmp_path / "changes.json").write_text("mine")
    argv = ["export", str(made / "work"), "--out", str(tmp_path), "--what", "changes"]
    assert main(argv) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (tmp_path / "changes.json").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1
    assert main([*argv, "--overwrite"]) == 0
    assert main(argv) == 0  # now it is ours
    assert main([*argv[:-1], "cameras"]) == 0
    assert {"changes.glb", "cameras/capture/transforms.json"} <= json.loads((tmp_path / "export.json").read_text())[
        "files"
    ].keys()


def test_a_list_of_others_is_kept(made, tmp_path, capsys):
    (tmp_path / "export.json").write_text('{"mine": 1}')
    argv = ["export", str(made / "work"), "--out", str(tmp_path), "--what", "changes"]
    assert main(argv) == 2
    assert "export.json" in capsys.readouterr().err and (tmp_path / "export.json").read_text() == '{"mine": 1}'


def test_a_lock_of_others_is_kept(made, tmp_path, capsys):
    with locked(tmp_path):
        assert main(["export", str(made / "work"), "--out", str(tmp_path), "--what", "changes"]) == 2
        assert "being written" in capsys.readouterr().err and (tmp_path / LOCK).exists()


def test_after_a_visit_that_found_nothing(made, tmp_path):
    """Such a visit keeps no photos."""
    shutil.copytree(made / "work", tmp_path / "work")
    workspace = Workspace.open(tmp_path / "work")
    frames = workspace.capture().frames[:2]
    nothing = SceneChange(photos=tuple(PlacedPhoto(f.name, "used", frame=f) for f in frames), why="nothing changed")
    with workspace.writing(), workspace.new_visit() as folder:
        workspace.keep_change(folder, nothing)
    out = tmp_path / "out"
    assert main(["export", str(tmp_path / "work"), "--out", str(out), "--what", "cameras", "changes"]) == 0
    assert (out / "cameras/visit_1").is_dir() and not (out / "cameras/visit_2").exists()


@pytest.mark.parametrize("there", [False, True])
def test_an_interrupted_export_leaves_nothing(made, tmp_path, there):
    out = tmp_path / "out"
    if there:
        out.mkdir()
        (out / "mine.txt").write_text("mine")

    def stop(stage):
        if stage == "surface":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(Workspace.open(made / "work"), out, ExportConfig(("cameras", "points")), on_stage=stop)
    assert out.exists() == there and [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["mine.txt"] * there


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (0.6, 0, -0.8), (1, 2, 3)])
def test_up_becomes_y(up):
    turn = upright(World(up, 1.0))
    unit = torch.tensor(up, dtype=torch.float64) / torch.tensor(up, dtype=torch.float64).norm()
    assert torch.allclose(turn[:3, :3] @ unit, torch.tensor([0.0, 1, 0]).double(), atol=1e-12)
    assert torch.linalg.det(turn) == pytest.approx(1)


def test_quaternions_are_gltfs():
    for vector in ([0.0, 0, 0], [0.3, -0.5, 1.2], [math.pi, 0, 0], [0, 3.0, 0.5]):
        turn = exp(torch.tensor([0.0, 0, 0, *vector], dtype=torch.float64))
        x, y, z, w = quaternion(turn[:3, :3])
        assert np.allclose(trimesh.transformations.quaternion_matrix([w, x, y, z]), turn, atol=1e-9)


def test_cells_have_numbers_of_their_own():
    xyz = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0))
    places = (xyz / 2**-4 + 0.37).floor()
    exact = torch.unique(places, dim=0, return_inverse=True)[1]
    cells = cells_of(xyz, torch.full((len(xyz),), 2**-4))
    pairs = torch.unique(torch.stack([exact, cells], 1), dim=0)
    assert len(pairs) == int(exact.max()) + 1 == int(cells.max()) + 1


def test_a_point_is_where_the_light_ends():
    """In a half space of constant density light goes in by the density's inverse on the mean."""

    class Half:
        def density(self, x):
            return torch.where(x[..., 2] < 0, 50.0, 0.0)

    xyz = torch.tensor([[0.0, 0.0, 0.03], [1.0, 0.0, -0.05]])
    same = torch.full((2,), 0.05)
    points = Points(xyz, xyz, same, xyz, xyz, same, xyz)
    behind, opacity = _depth_near(Half(), points, torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3))
    assert torch.allclose(behind, xyz[:, 2] + 1 / 50, atol=0.006)  # half a step
    assert (opacity > 0.99).all()


@pytest.mark.chain
def test_splats_are_read_by_splat_transform(made, tmp_path):
    """PlayCanvas' converter, which opens what SuperSplat does; it is no library for Python, so npm fetches it."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("npm is not installed")
    fetched = subprocess.run(
        [npm, "install", "--silent", "--prefix", tmp_path, "@playcanvas/splat-transform@2"], timeout=300
    )
    if fetched.returncode != 0:
        pytest.skip("npm could not fetch splat-transform")
    for name in ("splats.ply", "splats.spz"):
        told = tmp_path / f"{name}.csv"
        tool = tmp_path / "node_modules/.bin/splat-transform"
        subprocess.run([tool, "-w", made / "out" / name, told], check=True, timeout=300, capture_output=True)
        columns, *rows = told.read_text().splitlines()
        at = [columns.split(",").index(axis) for axis in "xyz"]
        means = np.array([[float(v) for v in row.split(",")] for row in rows])[:, at]
        known = read_splats(made / "out/splats.ply")[0]
        # it takes an SPZ for one whose y points up and turns it about x; Niantic's own converter turns nothing
        means *= np.sign((means * known).sum(0))
        assert len(means) == len(known) and np.abs(means - known).max() < 1e-3
