"""`refield import`: what nerfstudio trained is shown as nerfstudio shows it, in the world of the photos."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from refield.cli import main
from refield.field.nerfstudio import NerfstudioField
from refield.field.radiance import Field
from refield.field.render import render_rays
from refield.nerfstudio.run import TAG, read_config
from refield.scene.capture import camera_rays
from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, SceneChange
from refield.scene.images import read_image
from refield.scene.pose import rotation_log
from refield.visits import make
from refield.workspace import Workspace
from tests.nerfstudio.runs import PHOTOS, Theirs, Written, write_checkpoint, write_run

pytest.importorskip("yaml")
COARSE = ["--occupancy", "16"]
KINDS = {"torch": {}, "legacy": {"legacy": True}, "packed": {"packed": True}}


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Written]:
    """A run of each kind, brought into ``work`` beside it."""
    out = {}
    for kind, how in KINDS.items():
        root = tmp_path_factory.mktemp(kind)
        out[kind] = write_run(root, **how)
        assert main(["import", str(out[kind].folder), str(root / "work"), *COARSE]) == 0
    return out


@pytest.fixture
def run(tmp_path, monkeypatch) -> Written:
    monkeypatch.chdir(tmp_path)
    return write_run(tmp_path)


def work_of(run: Written) -> Path:
    return run.folder.parents[3] / "work"


def field_of(run: Written) -> NerfstudioField:
    field = Workspace.open(work_of(run)).field()
    assert isinstance(field, NerfstudioField) and isinstance(field, Field)
    return field


def some_points(run: Written, count: int = 60) -> tuple[np.ndarray, np.ndarray, torch.Tensor, torch.Tensor]:
    """Points and directions in run axes, near and far, and the same in the world."""
    g = np.random.default_rng(0)
    x, d = g.normal(size=(count, 3)) * 0.7, g.normal(size=(count, 3))
    x[count // 2 :] *= 15
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    world_from_run = np.linalg.inv(run.run_from_world)
    scale = np.cbrt(np.linalg.det(run.run_from_world[:3, :3]))
    at, along = x @ world_from_run[:3, :3].T + world_from_run[:3, 3], d @ world_from_run[:3, :3].T * scale
    return x, d, torch.from_numpy(at).float(), torch.from_numpy(along).float()


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_function(runs, kind):
    run = runs[kind]
    theirs, field, scale = Theirs(run.state), field_of(run), np.cbrt(np.linalg.det(run.run_from_world[:3, :3]))
    x, d, at, along = some_points(run)
    sigma, rgb = field(at, along)
    known = np.array([theirs.density(p) for p in x])
    assert known.max() > 5 * known.min()
    assert np.allclose(sigma.numpy() / scale, known, rtol=1e-4)
    assert np.allclose(field.density(at).numpy(), sigma.numpy(), rtol=1e-5)
    colours = np.stack([theirs.colour(p, v) for p, v in zip(x, d)])
    assert colours.std() > 0.02 and np.abs(rgb.numpy() - colours).max() < 1e-4
    for which, density in enumerate(field.densities):
        said = np.array([theirs.proposed(which, p) for p in x])
        assert np.allclose(density(at).numpy() / scale, said, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_pictures(runs, kind):
    """Looked at in the same places, and what is left to see is the last sample's colour."""
    run = runs[kind]
    theirs, field = Theirs(run.state), field_of(run)
    frame = run.capture.frames[3]
    rays = camera_rays(frame.camera, frame.world_from_cam, _pixels())
    shown = render_rays(field, rays)
    m = run.run_from_world
    scale = np.cbrt(np.linalg.det(m[:3, :3]))
    off = []
    for origin, d, rgb in zip(rays.origins.double().numpy(), rays.directions.double().numpy(), shown.rgb.numpy()):
        off.append(np.abs(theirs.pixel(m[:3, :3] @ origin + m[:3, 3], m[:3, :3] @ d / scale) - rgb).max())
    # in single precision far samples come to lie elsewhere in the packed run's noise, by how much differs from machine
    # to machine; rays that begin elsewhere by a thousandth are 1e-3 and 7e-3 off there, 1.3e-5 and 2.8e-5 in the others
    median, most = (4e-4, 3e-3) if kind == "packed" else (5e-6, 2e-5)
    assert np.median(off) < median and max(off) < most
    assert bool((shown.opacity > 0.999).all())
    clear = render_rays(_without_sky(field), rays)
    assert float(clear.opacity.min()) < 0.9, "the last sample has something to say"


def _pixels() -> torch.Tensor:
    return torch.cartesian_prod(torch.tensor([3.5, 16.5, 25.5]), torch.tensor([2.5, 12.5, 20.5]))


def _without_sky(field: NerfstudioField) -> NerfstudioField:
    tensors, facts = field.state()
    return NerfstudioField.from_state(tensors, {**facts, "config": {**facts["config"], "sky": False}})


def test_a_white_sky(runs):
    """Where the background is a colour, it is what is left."""
    field = field_of(runs["torch"])
    tensors, facts = field.state()
    white = NerfstudioField.from_state(tensors, {**facts, "config": {**facts["config"], "sky": [1.0, 1.0, 1.0]}})
    frame = runs["torch"].capture.frames[0]
    rays = camera_rays(frame.camera, frame.world_from_cam)
    clear, shown = render_rays(_without_sky(field), rays), render_rays(white, rays)
    assert torch.allclose(shown.rgb, clear.rgb + (1 - clear.opacity)[:, None], atol=1e-5)


def test_the_world_is_that_of_the_photos(runs):
    run = runs["torch"]
    workspace = Workspace.open(work_of(run))
    given = workspace.given_capture()
    assert len(given.frames) == PHOTOS
    for kept, frame in zip(given.frames, run.capture.frames):
        assert torch.allclose(kept.world_from_cam, frame.world_from_cam, atol=1e-12)


def test_poses_as_the_run_trained_with_them(runs):
    """The camera optimiser's, of the photos that were trained on; the others stay."""
    run = runs["torch"]
    workspace = Workspace.open(work_of(run))
    moved = []
    scale = np.cbrt(np.linalg.det(run.run_from_world[:3, :3]))
    q = torch.from_numpy(run.run_from_world[:3, :3] / scale)
    twists = run.state["camera_optimizer.pose_adjustment"].double()
    for given, found in zip(workspace.given_capture().frames, workspace.capture().frames):
        if torch.equal(given.world_from_cam, found.world_from_cam):
            continue
        twist = twists[len(moved)]
        moved.append(given.name)
        shift = q @ (found.centre - given.centre) * scale
        turn = rotation_log(q @ found.world_from_cam[:3, :3] @ given.world_from_cam[:3, :3].T @ q.T)
        assert torch.allclose(shift, twist[:3], atol=1e-9) and torch.allclose(turn, twist[3:], atol=1e-7)
    assert len(moved) == len(twists) == 12


def test_kept_and_read_again(runs, tmp_path):
    field = field_of(runs["packed"])
    field.save(tmp_path)
    again = NerfstudioField.load(tmp_path)
    _, _, at, along = some_points(runs["packed"])
    assert all(torch.equal(a, b) for a, b in zip(field(at, along), again(at, along)))
    assert again.config == field.config


def test_gradients_reach_positions(runs):
    """Poses are refined through the field."""
    field = field_of(runs["torch"])
    at = some_points(runs["torch"], 40)[2][:20].requires_grad_(True)
    field.density(at).sum().backward()
    step = torch.zeros(20, 3)
    step[:, 0] = 1e-3
    slope = (field.density(at.detach() + step) - field.density(at.detach() - step)) / 2e-3
    assert at.grad is not None and float((at.grad[:, 0] - slope).abs().median() / slope.abs().median()) < 0.05


def test_a_workspace_like_any_other(run, monkeypatch, capsys):
    """Rendered, updated, listed, rendered again, taken back."""
    assert main(["import", str(run.folder), "work", *COARSE]) == 0
    told = capsys.readouterr().err
    assert "dB" in told and "poses moved by" in told
    assert json.loads(Path("work/field/field.json").read_text())["architecture"] == "NerfstudioField"
    assert json.loads(Path("work/refield.json").read_text())["made_by"] == "import"
    cameras = ["--cameras", "photos/transforms.json"]
    assert main(["render", "work", *cameras, "--out", "before"]) == 0
    frame = run.capture.frames[5]
    x, y = 20, 11
    ray = camera_rays(frame.camera, frame.world_from_cam, torch.tensor([[x + 0.5, y + 0.5]]))
    m = run.run_from_world
    scale = np.cbrt(np.linalg.det(m[:3, :3]))
    origin, d = ray.origins[0].double().numpy(), ray.directions[0].double().numpy()
    known = Theirs(run.state).pixel(m[:3, :3] @ origin + m[:3, 3], m[:3, :3] @ d / scale)
    assert np.abs(read_image(Path("before/005.png"))[y, x].numpy() / 255 - known).max() < 1 / 255

    middle = torch.stack([f.centre for f in run.capture.frames]).mean(0).float()
    monkeypatch.setattr(make, "estimate_change", _something_moved(middle))
    shutil.copytree("photos", "new")
    told = json.loads(Path("new/transforms.json").read_text())
    Path("new/transforms.json").write_text(json.dumps({**told, "frames": told["frames"][:4]}))
    few = [
        "--update.fit.steps",
        "2",
        "--update.fit.samples",
        "512",
        "--update.relight.no-still",
        "--update.relight.no-moved",
    ]
    assert main(["update", "work", "new", *few]) == 0
    assert main(["visits", "work"]) == 0
    assert "moved" in capsys.readouterr().out
    assert main(["render", "work", *cameras, "--out", "after"]) == 0
    pictures = [
        torch.stack([read_image(p).float() for p in sorted(Path(f).glob("*.png"))]) for f in ("before", "after")
    ]
    assert float((pictures[0] - pictures[1]).abs().max()) > 2
    assert main(["undo", "work"]) == 0
    assert main(["render", "work", *cameras, "--out", "again"]) == 0
    assert torch.equal(read_image(Path("again/005.png")), read_image(Path("before/005.png")))


def _something_moved(middle: torch.Tensor):
    """An estimate that says so."""

    def estimate(capture, field, frames, config, on_stage=None, models=None, known=(), on_count=None):
        box = torch.stack([middle - 0.5, middle + 0.5])
        shift = torch.eye(4, dtype=torch.float64)
        shift[0, 3] = 1.0
        seen = torch.zeros(24, 32, dtype=torch.bool)
        seen[8:16, 10:20] = True
        masks = (seen,) * len(capture.train)
        objects = (ObjectChange("moved", OccupancyGrid(box, torch.ones(5, 5, 5)), shift, masks=masks, masks_in=masks),)
        photos = tuple(PlacedPhoto(f.name, "used", "", f) for f in frames)
        return SceneChange(objects, photos, "because", (seen,) * 4, (seen,) * 4)

    return estimate


def test_proposals_look_behind_what_left(runs):
    """A ray that has nothing left where it looked is looked at elsewhere."""
    run = runs["torch"]
    field = field_of(run)
    frame = run.capture.frames[0]
    rays = camera_rays(frame.camera, frame.world_from_cam, torch.tensor([[16.5, 12.5]]))
    usual = field.samples(rays)
    gone = usual.positions(rays)[0][2]
    behind = field.samples(rays, without=lambda x: (x - gone).norm(dim=-1) < 1.0)
    assert float((behind.positions(rays)[0] - gone).norm(dim=-1).min()) >= 1.0
    assert len(behind) <= len(usual)


def test_the_photos_are_found_from_elsewhere(run, monkeypatch, tmp_path):
    """A relative path is that of the folder where the run was started, which holds its outputs."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["import", str(run.folder / "config.yml"), "work", *COARSE]) == 0


def test_a_checkpoint_by_its_step(run):
    assert main(["import", str(run.folder), "work", "--step", "100", *COARSE]) == 0
    field = Workspace.open(Path("work")).field()
    assert isinstance(field, NerfstudioField) and not field.trunk.tables.any()


def test_other_photos_are_told(run, capsys):
    assert main(["import", str(run.folder), "work", *COARSE]) == 0
    assert "was it trained on these?" in capsys.readouterr().err  # random weights show nothing of any photo


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"method": "splatfacto", "model": "SplatfactoModel"}, ("splatfacto", "only nerfacto", "refield train")),
        ({"parser": "ColmapDataParserConfig"}, ("ColmapDataParserConfig", "transforms.json")),
        ({"data": "nowhere"}, ("nowhere", "--data")),
    ],
)
def test_runs_that_cannot_be_taken_over(tmp_path, monkeypatch, capsys, how, said):
    monkeypatch.chdir(tmp_path)
    run = write_run(tmp_path, **how)
    assert main(["import", str(run.folder), "work"]) == 2
    told = capsys.readouterr().err
    assert all(s in told for s in ("config.yml", *said)) and not Path("work").exists()


def broken(run: Written, what: str) -> tuple[list[str], str]:
    """Spoils a run; the arguments to import it by, and what is to be said."""
    folder, checkpoint = run.folder, run.folder / "nerfstudio_models" / "step-000000200.ckpt"
    if what == "no run":
        return [str(folder.parents[2])], "such as"
    if what == "nothing":
        return ["nowhere"], "no such folder"
    if what == "step":
        return [str(folder), "--step", "7"], "100, 200"
    if what == "grid":
        return [str(folder), "--occupancy", "0"], "--occupancy"
    if what == "data":
        return [str(folder), "--data", "outputs"], "holds no transforms.json"
    if what == "yaml":
        (folder / "config.yml").write_text("a: [1, 2")
    if what == "text":
        (folder / "config.yml").write_text("- 1\n- 2")
    if what == "nested":
        (folder / "config.yml").write_text("[" * 400)
    if what == "untrained":
        shutil.rmtree(folder / "nerfstudio_models")
    if what == "transform":
        (folder / "dataparser_transforms.json").write_text('{"transform": [[1, 0], [0, 1]], "scale": 1.0}')
    if what == "sheared":
        told = {"transform": [[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1.0}
        (folder / "dataparser_transforms.json").write_text(json.dumps(told))
    if what == "no transform":
        (folder / "dataparser_transforms.json").unlink()
    if what == "short":
        checkpoint.write_bytes(checkpoint.read_bytes()[:-4000])
    if what == "no checkpoint":
        checkpoint.write_bytes(b"weights")
    if what == "other shape":
        write_checkpoint(checkpoint, {**run.state, "field.mlp_base.model.0.hash_table": torch.zeros(100, 2)})
    if what == "missing":
        write_checkpoint(checkpoint, {k: v for k, v in run.state.items() if "mlp_head" not in k})
    if what == "not finite":
        write_checkpoint(checkpoint, {k: v / 0 for k, v in run.state.items()})
    return [str(folder)], {
        "untrained": "holds no checkpoint",
        "other shape": "hash table of (100, 2)",
        "missing": "mlp_head",
        "not finite": "not finite",
        "sheared": "does not turn the axes",
    }.get(what, "")


RUNS = ["no run", "nothing", "step", "data", "grid", "untrained"]
TEXTS = ["yaml", "text", "nested", "transform", "sheared", "no transform"]
CHECKPOINTS = ["short", "no checkpoint", "other shape", "missing", "not finite"]


@pytest.mark.parametrize("what", [*RUNS, *TEXTS, *CHECKPOINTS])
def test_damage_is_named(run, capsys, what):
    arguments, said = broken(run, what)
    assert main(["import", *arguments, "work"]) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") <= 3 and "Traceback" not in told
    assert not Path("work").exists()


class Harmful:
    def __reduce__(self):
        return os.mkdir, ("harm",)


def test_nothing_in_a_run_is_executed(run, capsys):
    """Neither what a checkpoint's pickle nor what the config's YAML asks for."""
    config = run.folder / "config.yml"
    text = config.read_text()
    config.write_text(text + "harm: !!python/object/apply:os.mkdir [harm]\nmore: !!python/object/new:os.mkdir [harm]\n")
    assert main(["import", str(run.folder), "work", *COARSE]) == 0
    assert read_config(config)["harm"] == {"args": ["harm"], TAG: "os.mkdir"}
    config.write_text(text)
    write_checkpoint(run.folder / "nerfstudio_models" / "step-000000200.ckpt", run.state, harm=Harmful())
    assert main(["import", str(run.folder), "work", "--overwrite", *COARSE]) == 2
    assert "weights alone" in capsys.readouterr().err
    assert not Path("harm").exists()


@pytest.mark.filterwarnings("ignore")
def test_as_nerfstudios_own_field(runs):
    """Where nerfstudio is installed: its modules, with the same weights, at the same points."""
    fields = pytest.importorskip("nerfstudio.fields.nerfacto_field", exc_type=ImportError)
    rays = pytest.importorskip("nerfstudio.cameras.rays", exc_type=ImportError)
    heads = pytest.importorskip("nerfstudio.field_components.field_heads", exc_type=ImportError)
    spaces = pytest.importorskip("nerfstudio.field_components.spatial_distortions", exc_type=ImportError)
    run = runs["torch"]
    own = fields.NerfactoField(
        run.state["field.aabb"],
        12,
        hidden_dim=16,
        num_levels=4,
        base_res=4,
        max_res=50,
        log2_hashmap_size=9,
        hidden_dim_color=16,
        appearance_embedding_dim=6,
        use_average_appearance_embedding=True,
        spatial_distortion=spaces.SceneContraction(order=float("inf")),
        average_init_density=0.01,
        implementation="torch",
    ).eval()
    weights = {k.removeprefix("field."): v for k, v in run.state.items() if k.startswith("field.")}
    missing, strange = own.load_state_dict(weights, strict=False)
    assert not strange and set(missing) <= {"max_res", "num_levels", "log2_hashmap_size"}
    x, d, at, along = some_points(run, 2000)
    zeros = torch.zeros(len(x), 1)
    places = rays.Frustums(torch.from_numpy(x).float(), torch.from_numpy(d).float(), zeros, zeros, zeros)
    with torch.no_grad():
        out = own(rays.RaySamples(frustums=places, camera_indices=zeros.long()))
    sigma, rgb = field_of(run)(at, along)
    scale = np.cbrt(np.linalg.det(run.run_from_world[:3, :3]))
    density = out[heads.FieldHeadNames.DENSITY][:, 0]
    assert torch.allclose(sigma / scale, density, rtol=1e-4)
    assert float((rgb - out[heads.FieldHeadNames.RGB]).abs().max()) < 1e-4
