"""``refield render`` without a camera file: what is in its films, pictures, depths and opacities."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from refield.cli import main
from refield.commands.viewpoints import free_orbit
from refield.field.encoding import Contraction
from refield.field.render import render_frame
from refield.history import state
from refield.scene.capture import Capture, Frame, centres
from refield.scene.film import film
from refield.scene.images import read_image
from refield.scene.paths import SPREADS, orbit, typical_camera
from refield.scene.transforms_json import load_cameras
from refield.scene.world import world_of
from refield.workspace import Workspace
from tests.captures import CAMERA, looking_at
from tests.conftest import HERE
from tests.fields import oracle_sampler
from tests.folders import contents
from tests.test_cli import FEW, believing, heeds_ctrl_c  # noqa: F401


@pytest.fixture(scope="module")
def changed(tiny, tmp_path_factory):
    """A workspace with one visit that moved something, and its photos; to be copied before anything is written."""
    folder = tmp_path_factory.mktemp("changed")
    for name in ("new", "work"):
        shutil.copytree(tiny / name, folder / name)
    with pytest.MonkeyPatch.context() as patch:
        believing(patch, "moved")
        assert main(["update", str(folder / "work"), str(folder / "new"), *FEW]) == 0
    return folder


@pytest.fixture
def place(changed, tmp_path, monkeypatch):
    for name in ("new", "work"):
        shutil.copytree(changed / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rendered(*more):
    assert main(["render", "work", *more]) == 0


def pngs(folder):
    return [read_image(p) for p in sorted(Path(folder).glob("*.png"))]


def told(command, capsys):
    """The one line that says why a command was refused."""
    assert main(command) == 2
    return capsys.readouterr().err.strip().splitlines()[-1]


def opened(path):
    """A film's pictures (N, H, W, 3) uint8 RGB, and their number a second, by OpenCV's decoder."""
    video, pictures = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        pictures.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
    return np.stack(pictures), video.get(cv2.CAP_PROP_FPS)


def test_an_mp4_holds_the_pictures_that_the_folder_holds(place, capsys):
    views = ["--orbit", "--frames", "9", "--size", "64"]
    rendered(*views, "--out", "pictures")
    assert [p.name for p in sorted((place / "pictures").iterdir())] == [f"{i:05d}.png" for i in range(9)]
    rendered(*views, "--fps", "12.5", "--out", "turn.mp4")
    assert "9 pictures of 64x48, 0.72 s, in turn.mp4" in capsys.readouterr().out
    shown, rate = opened(place / "turn.mp4")
    assert shown.shape == (9, 48, 64, 3) and rate == pytest.approx(12.5)
    still = torch.stack(pngs("pictures")).numpy()
    # colours are stored at half the resolution: means over blocks
    blocks = [x.reshape(9, 12, 4, 16, 4, 3).mean((2, 4)) for x in (shown.astype(float), still.astype(float))]
    assert np.abs(blocks[0] - blocks[1]).mean() < 3 and still.std() > 20
    with av.open(str(place / "turn.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == Fraction(25, 2)
    data = (place / "turn.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "plays only when all has arrived"


def test_colours_of_a_film_are_those_that_went_in(tmp_path):
    colours = torch.tensor([[200, 40, 40], [40, 180, 60], [50, 60, 200], [128, 128, 128], [255, 255, 255], [0, 0, 0]])
    picture = colours.to(torch.uint8).repeat_interleave(32, 0).expand(64, -1, -1)
    for name, off in (("a.mp4", 3), ("a.gif", 0), ("a.webp", 3)):
        with film(tmp_path / name, 10, (192, 64)) as add:
            add(picture)
            add(picture.flip(1))
        if name == "a.mp4":
            with av.open(str(tmp_path / name)) as container:
                frame = next(container.decode(video=0))
                assert frame.colorspace == 1 and frame.color_range == 1  # BT.709, limited
                shown = frame.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray()
        else:
            with Image.open(tmp_path / name) as image:
                shown = np.array(image.convert("RGB"))
        middles = shown[32, 16::32].astype(int)
        assert np.abs(middles - colours.numpy()).max() <= off, name


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_animated_pictures_hold_all_of_them_and_last_as_long(place, suffix):
    views = ["--path", "new/transforms.json", "--frames", "10", "--fps", "24"]
    rendered(*views, "--out", "pictures")
    rendered(*views, "--out", f"walk{suffix}")
    with Image.open(place / f"walk{suffix}") as image:
        assert (image.n_frames, image.size, image.info["loop"]) == (10, (32, 24), 0)
        lasts = 0
        for i, still in enumerate(pngs("pictures")):
            image.seek(i)
            assert np.abs(np.array(image.convert("RGB")).astype(int) - still.numpy()).mean() < 8
            image.load()
            lasts += image.info["duration"]
    assert abs(lasts - 10 / 24 * 1000) <= 6


def test_the_photos_own_cameras(place):
    rendered("--like-photos", "--out", "pictures")
    rendered("--cameras", "work/capture/transforms.json", "--out", "given")
    assert contents(place / "pictures") == contents(place / "given") and len(pngs("given")) == 12
    rendered("--like-photos", "--seconds", "3", "--size", "20", "--out", "photos.mp4")
    shown, rate = opened(place / "photos.mp4")
    assert shown.shape == (12, 16, 20, 3) and rate == pytest.approx(4)


def test_pictures_of_several_sizes_stand_in_the_middle_of_a_film(place):
    record = json.loads((place / "new/transforms.json").read_text())
    shared = {k: v for k, v in record.items() if k not in ("frames", "ply_file_path")}
    upright = {**shared, "w": shared["h"], "h": shared["w"], "cx": shared["cy"], "cy": shared["cx"]}
    record["frames"][1].update({k: upright[k] for k in ("w", "h", "cx", "cy", "fl_x", "fl_y")})
    (place / "mixed.json").write_text(json.dumps(record))
    rendered("--cameras", "mixed.json", "--out", "mixed.webp")
    with Image.open(place / "mixed.webp") as image:
        image.seek(1)
        shown = np.array(image.convert("RGB")).astype(int)
    assert shown.shape == (24, 32, 3)
    assert max(shown[:, :6].max(), shown[:, 26:].max()) < 30 and shown[:, 8:24].mean() > 40


def test_an_orbit_is_that_of_the_capture(place):
    """What the command shows is what the path says, rendered."""
    rendered("--orbit", "--frames", "6", "--out", "pictures")
    workspace = Workspace.open(place / "work")
    capture, world = workspace.capture(), workspace.world()
    (pose, *_), camera = orbit(capture.frames, torch.tensor(world.up), 6), typical_camera(capture.frames)
    assert (centres(capture.frames) - pose[:3, 3]).norm(dim=1).min() < 0.2 * world.size
    frame = load_cameras(place / "new/transforms.json")[0]
    own = type(frame)(frame.path, camera, frame.name, world_from_cam=pose)
    still = (render_frame(state(workspace, 1), own).rgb.clamp(0, 1) * 255).round().to(torch.uint8)
    assert any(torch.equal(picture, still) for picture in pngs("pictures"))


class Balls:
    """A field: solid grey balls of radius 0.3 at the given places."""

    def __init__(self, *places):
        self._places = torch.tensor(places)
        self.sampler = oracle_sampler(self.density, Contraction(torch.zeros(3), 8.0), 0.05)

    def density(self, x):
        return 100.0 * ((x[..., None, :] - self._places).norm(dim=-1) < 0.3).any(-1)

    def __call__(self, x, d):
        return self.density(x), torch.full_like(x, 0.5)


def photos_on_an_oval():
    """From near on two sides of the origin, and from far on the others."""
    turn = torch.arange(72, dtype=torch.float64) * (torch.pi / 36)
    eyes = torch.stack([5 * turn.cos(), 1.5 * turn.sin(), 1 + 0 * turn], -1)
    poses = [looking_at(eye, torch.zeros(3, dtype=torch.float64)) for eye in eyes]
    return [Frame(Path(f"{i}.png"), CAMERA, f"{i}.png", world_from_cam=pose) for i, pose in enumerate(poses)]


def test_an_orbit_leads_around_what_stands_in_its_way():
    frames, warned = photos_on_an_oval(), []
    world = world_of(Capture(tuple(frames)))

    def around(*places):
        return torch.stack(free_orbit(frames, world, [Balls((0.0, 0.0, 0.0)), Balls(*places)], 60, warned.append))

    free = around((0.0, 0.0, 0.0))
    assert torch.equal(free, torch.stack(orbit(frames, torch.tensor(world.up), 60, SPREADS[0]))) and not warned
    side = free[:, 1, 3].argmax()  # where the smoothest is farther out than any photo
    way = free[side, :3, 3]
    assert float(way[1]) > 1.9
    kept = around(tuple(way.tolist()))
    assert not warned and (kept[:, :3, 3] - way).norm(dim=1).min() > 0.3
    around(*((0.0, 0.1 * i, 1.0) for i in range(30)))  # a wall from the middle outwards, and no way around it
    assert len(warned) == 1 and "stands in the orbit's way at" in warned[0]


def test_a_tour_through_the_photos(place):
    rendered("--path", "photos", "--frames", "23", "--out", "tour")
    rendered("--like-photos", "--out", "photos")
    tour = pngs("tour")
    assert len(tour) == 23
    passed = sum(any(torch.equal(a, b) for b in tour) for a in pngs("photos"))
    assert passed >= 11, "the tour leads through the photos' own places"


WAYS = [
    ["--path", "new/transforms.json"],
    ["--cameras", "new/transforms.json"],
    [],
]


@pytest.mark.parametrize("blend", ["wipe", "fade"])
@pytest.mark.parametrize("way", WAYS, ids=lambda way: way[0] if way else "standing")
def test_from_visit_to_visit_begins_and_ends_with_them(place, way, blend):
    few = [] if "--cameras" in way else ["--frames", "8"]
    rendered(*way, *few, "--between", "0", "1", "--blend", blend, "--depth", "--opacity", "--out", "both")
    both, names = pngs("both"), [p.name for p in sorted((place / "both").glob("*.png"))]
    if way:
        for visit in (0, 1):
            rendered(*way, *few, "--visit", str(visit), "--depth", "--opacity", "--out", f"v{visit}")
        ends = [("v0", names[0]), ("v1", names[-1])]
        for layer in ("", "depth", "opacity"):
            for folder, name in ends:
                assert (place / "both" / layer / name).read_bytes() == (place / folder / layer / name).read_bytes()
    else:
        assert (both[0] != both[-1]).float().mean() > 0.005, "something changes"
        ends = [picture.float() for picture in (both[0], both[-1])]
        assert torch.equal(both[0], both[1]) and torch.equal(both[-1], both[-2]), "each is seen for a moment"
        if blend == "fade":
            way_there = ends[1] - ends[0]
            part = ((both[4].float() - ends[0]) * way_there).sum(-1) / way_there.square().sum(-1)
            seen = part[way_there.abs().amin(-1) > 20]
            assert len(seen) and 0.3 < seen.median() < 0.9
        else:
            line = (both[4] == 255).all(-1).all(0).nonzero()[:, 0]
            assert len(line) == 2 and torch.equal(both[4][:, : line[0]], both[-1][:, : line[0]])
            assert torch.equal(both[4][:, line[1] + 1 :], both[0][:, line[1] + 1 :])


def test_there_and_back(place):
    rendered("--between", "0", "1", "0", "--frames", "9", "--out", "both")
    both = pngs("both")
    assert torch.equal(both[0], both[8]) and not torch.equal(both[0], both[4])


def test_a_standing_view_is_one_in_which_much_changes(place):
    rendered("--between", "0", "1", "--frames", "2", "--out", "both")
    for visit in (0, 1):
        rendered("--cameras", "new/transforms.json", "--visit", str(visit), "--out", f"v{visit}")
    changes = [(a.float() - b.float()).abs().mean() for a, b in zip(pngs("v0"), pngs("v1"))]
    a, b = pngs("both")
    assert (a.float() - b.float()).abs().mean() > 0.7 * max(changes)


def test_depths_are_the_fields_and_say_their_scale(place, capsys):
    rendered("--cameras", "new/transforms.json", "--depth", "--opacity", "--out", "pictures")
    out = capsys.readouterr().out
    assert "distance along the ray" in out and "depths in pictures/depth" in out
    scale = json.loads((place / "pictures/depth/scale.json").read_text())
    assert scale["kind"] == "distance along the ray" and f"steps of {scale['units_per_step']:g}" in out
    assert not list((place / "pictures").glob("*depth*.png"))
    field = state(Workspace.open(place / "work"), 1)
    for frame, depth, opacity in zip(
        load_cameras(place / "new/transforms.json"),
        sorted((place / "pictures/depth").glob("*.png")),
        sorted((place / "pictures/opacity").glob("*.png")),
    ):
        true = render_frame(field, frame)
        stored = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16 and stored.max() > 1000
        told = torch.from_numpy(stored.astype(np.float64)) * scale["units_per_step"]
        near = stored < 65535
        assert (told - true.depth)[near].abs().max() <= 0.5001 * scale["units_per_step"]
        assert (true.depth[~near] > 65534 * scale["units_per_step"]).all()
        held = cv2.imread(str(opacity), cv2.IMREAD_UNCHANGED)
        assert held.dtype == np.uint8
        assert np.abs(held - true.opacity.numpy() * 255).max() <= 0.51


def test_depths_of_a_film_lie_beside_it(place):
    rendered("--orbit", "--frames", "3", "--depth", "--opacity", "--out", "turn.gif")
    names = {f"{i:05d}.png" for i in range(3)}
    assert {p.name for p in (place / "turn-depth").iterdir()} == names | {"scale.json"}
    assert {p.name for p in (place / "turn-opacity").iterdir()} == names
    rendered("--orbit", "--frames", "3", "--depth", "--opacity", "--out", "turn.gif")  # ours may be replaced


def test_metres_are_told_where_they_are_known(place):
    world = json.loads((place / "work/capture/world.json").read_text())
    (place / "work/capture/world.json").write_text(json.dumps({**world, "metres_per_unit": 0.25}))
    rendered("--orbit", "--frames", "1", "--depth", "--out", "pictures")
    scale = json.loads((place / "pictures/depth/scale.json").read_text())
    assert scale["metres_per_step"] == pytest.approx(scale["units_per_step"] / 4)


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_films_of_others_are_not_replaced_unasked(place, capsys, suffix):
    out = place / f"film{suffix}"
    views = ["render", "work", "--orbit", "--frames", "2", "--out", out.name]
    for _ in range(2):
        assert main(views) == 0
    picture = Image.fromarray(np.zeros((24, 32, 3), np.uint8))
    if suffix == ".mp4":
        video = cv2.VideoWriter(str(out), cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (32, 24))
        video.write(np.zeros((24, 32, 3), np.uint8))
        video.release()
    else:
        picture.save(out, save_all=True, append_images=[picture.rotate(90)])
    before = contents(place)
    assert "--overwrite" in told(views, capsys) and contents(place) == before
    assert main([*views, "--overwrite"]) == 0 and main(views) == 0


def test_a_text_that_is_called_a_film_is_not_replaced(place, capsys):
    for suffix in (".mp4", ".gif", ".webp"):
        (place / f"film{suffix}").write_text("mine")
        says = told(["render", "work", "--orbit", "--frames", "2", "--out", f"film{suffix}"], capsys)
        assert "was not made by refield" in says and (place / f"film{suffix}").read_text() == "mine"


REFUSED = {
    "no way": ([], r"--orbit.*--like-photos.*--path.*--cameras.*--between"),
    "two ways": (["--orbit", "--like-photos"], r"--like-photos and --orbit.*one of them"),
    "one visit": (["--between", "0"], r"name two or more"),
    "the same visit": (["--between", "1", "1"], r"name two or more"),
    "no such visit": (["--between", "0", "7"], r"no visit 7"),
    "visit and between": (["--visit", "1", "--between", "0", "1"], r"give one of them"),
    "too much": (["--orbit", "--frames", "3", "--fps", "3", "--seconds", "3"], r"two of the three"),
    "no frames": (["--orbit", "--frames", "0"], r"--frames: 0 is none"),
    "endless": (["--orbit", "--seconds", "nan"], r"--seconds: nan is none"),
    "too long": (["--orbit", "--seconds", "99999"], r"makes \d+ pictures"),
    "frames of views": (["--like-photos", "--frames", "3"], r"each view is one picture"),
    "two rates": (["--like-photos", "--fps", "3", "--seconds", "3"], r"how fast 12 views pass"),
    "no size": (["--orbit", "--size", "0"], r"--size: 0"),
    "no path": (["--path", "nowhere.json"], r"nowhere\.json: cannot be read"),
    "a path of one view": (["--path", "one.json"], r"holds one view"),
    "too fast": (["--orbit", "--fps", "60", "--out", "a.gif"], r"60 pictures a second.*up to 50"),
    "another film": (["--orbit", "--out", "a.mov"], r"a\.mov: is no name of a film \(\.mp4, \.gif, \.webp\)"),
    "a folder called a film": (["--orbit", "--out", "b.mp4"], r"is a folder"),
    "inside": (["--orbit", "--out", "work/visits/a.mp4"], r"belongs to the workspace"),
}


@pytest.mark.parametrize("row", REFUSED)
def test_what_cannot_be_is_refused_before_any_work(place, capsys, row):
    more, says = REFUSED[row]
    record = json.loads((place / "new/transforms.json").read_text())
    (place / "one.json").write_text(json.dumps({**record, "frames": record["frames"][:1]}))
    (place / "b.mp4").mkdir()
    (place / "work/field/field.safetensors").write_bytes(b"")  # who comes as far as this says something else
    before = contents(place)
    out = [] if "--out" in more else ["--out", "pictures"]
    assert main(["render", "work", *more, *out]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and re.search(says, said[0]), said
    assert contents(place) == before


def test_without_the_extra_an_mp4_is_refused_by_name(place):
    code = """import sys
sys.modules["av"] = None
from refield.cli import main
sys.exit(main(["render", "work", "--orbit", "--frames", "2", "--out", "a.mp4"]))"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=HERE)
    assert done.returncode == 2 and "pip install 'refield[video]', or name a .webp or .gif" in done.stderr
    assert not list(place.glob("a.*"))


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_ctrl_c_leaves_no_half_film(place, heeds_ctrl_c, suffix):  # noqa: F811
    (place / "films").mkdir()
    argv = [sys.executable, "-m", "refield", "render", "work", "--orbit", "--frames", "50000"]
    argv += ["--out", f"films/turn{suffix}"]
    process = subprocess.Popen(argv, cwd=place, stderr=subprocess.DEVNULL, env=HERE)
    while process.poll() is None and not list((place / "films").iterdir()):
        time.sleep(0.02)
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert not list((place / "films").iterdir())


def test_an_earlier_film_stays_until_the_new_one_is_whole(tmp_path):
    picture = torch.zeros(24, 32, 3, dtype=torch.uint8)
    path = tmp_path / "a.mp4"
    with film(path, 10, (32, 24)) as add:
        add(picture)
    before = contents(tmp_path)
    with pytest.raises(KeyboardInterrupt), film(path, 10, (32, 24)) as add:
        add(picture + 100)
        raise KeyboardInterrupt
    assert contents(tmp_path) == before
