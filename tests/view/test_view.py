"""What the viewer draws and serves, without a browser."""

import math
import shutil
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from refield.cli import main
from refield.export.splats import Splats
from refield.field.volrend import Rendering
from refield.scene.camera import Camera
from refield.scene.pose import exp, transform
from refield.view.draw import covariances
from refield.view.marks import IS, WAS, pictured, places_of, shots_of
from refield.view.scenery import Scenery
from refield.view.stage import first_look
from refield.view.standing import Looking, StandingView, composed
from refield.view.turns import Turns
from refield.workspace import Workspace
from tests.export.solid import BOX, CELL, NEW_FROM_OLD, corners, make_workspace

viser = pytest.importorskip("viser", reason="needs viser (pip install 'refield[view]')")


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    make_workspace(folder)
    return folder / "work"


@pytest.fixture
def scenery(work):
    return Scenery(Workspace.open(work), 3000, pytest.fail)


def test_the_stage_is_the_world_drawn_in_one_size(scenery):
    stage = scenery.stage
    at = torch.stack([f.centre for f in scenery.capture.frames])
    assert np.linalg.norm(stage.points(at), axis=1).max() == pytest.approx(4.0, rel=1e-5)
    x = torch.tensor([0.3, -1.2, 0.7], dtype=torch.float64)
    assert torch.allclose(stage.world_points(stage.points(x)), x, atol=1e-6)
    pose = exp(torch.tensor([0.2, 1.0, -0.4, 1.1, 2.0, -0.3], dtype=torch.float64))
    assert torch.allclose(stage.world_pose(**stage.pose(pose)), pose, atol=1e-6)
    # what is drawn below a node stays in its place as long as the node does
    node, below = (
        viser.transforms.SE3.from_rotation_and_translation(
            viser.transforms.SO3(np.array(p["wxyz"])), np.array(p["position"])
        )
        for p in (stage.pose(pose), stage.seen_from(pose))
    )
    assert np.allclose((node @ below).as_matrix(), np.eye(4), atol=1e-6)
    look = first_look(stage, scenery.capture.frames, scenery.world)
    assert np.linalg.norm(look.position) > 4 and np.allclose(look.look_at, 0, atol=1e-6)


def test_splats_are_turned_and_scaled(scenery):
    turn = exp(torch.tensor([0, 0, 0, 0.3, -0.5, 0.9], dtype=torch.float64))
    w, x, y, z = scenery.stage.pose(turn)["wxyz"]
    one = torch.tensor([[w, x, y, z]], dtype=torch.float32)
    scales = torch.tensor([[0.3, 0.2, 0.05]])
    splats = Splats(torch.zeros(1, 3), scales, one, torch.ones(1), torch.ones(1, 3))
    axes = turn[:3, :3].float() * scales * 2.0
    assert np.allclose(covariances(splats, 2.0)[0], (axes @ axes.T).numpy(), atol=1e-6)


def test_boxes_stand_where_things_were_and_are(scenery):
    places = {(p.number, p.now): p for p in places_of(scenery.changes[0], scenery.world)}
    assert set(places) == {(1, False), (1, True), (2, True), (3, False)}
    for key in ((1, True), (2, True), (3, False)):
        assert torch.cdist(corners(BOX).double(), places[key].box.corners).amin(1).max() < 3 * CELL
    there = transform(NEW_FROM_OLD, places[1, False].box.corners)
    assert torch.allclose(there, places[1, True].box.corners, atol=1e-6)


def test_photos_are_drawn_small_with_their_masks(scenery):
    change = scenery.changes[0]
    height, width = change.frames[0].camera.height, change.frames[0].camera.width
    left = torch.zeros(height, width, dtype=torch.bool)
    left[:, : width // 2] = True
    told = replace(change, masks_in=(left, left), masks_out=())
    shots = shots_of(scenery.capture.frames[:3], told)
    assert [s.name for s in shots] == ["old_0", "old_1", "old_2", "new_0", "new_1"]
    plain, inked = (pictured(shots_of((), c)[0]).picture.astype(float) for c in (change, told))
    assert plain.shape == (height, width, 3) and (plain[:, -9:] == inked[:, -9:]).all()
    part = 140 / 255
    assert np.abs(inked[9:-9, 5:20] - (part * np.array(IS) + (1 - part) * plain[9:-9, 5:20])).max() < 3


def flat(depth, red, camera):
    rgb = torch.zeros(camera.height, camera.width, 3)
    rgb[..., 0] = red
    return Rendering(rgb, torch.full(rgb.shape[:2], depth), torch.ones(rgb.shape[:2]))


def test_pictures_are_composed_of_two_states():
    camera = Camera(40, 30, 20.0, 20.0, 20.0, 15.0)
    look = Looking(camera, torch.eye(4, dtype=torch.float64), 2, 1)
    now, was = flat(2.0, 1.0, camera), flat(3.0, 0.5, camera)
    assert look.states == (2,) and Looking(camera, look.world_from_cam, 2, 1, "sharp", 0.25).states == (2, 1)
    picture = composed(Looking(camera, look.world_from_cam, 2, 1, "sharp", 0.25), camera, [now, was])
    assert (picture.rgb[:, :8, 0] == 128).all() and (picture.rgb[:, 11:, 0] == 255).all()
    # depths are told along the axis: at a corner the way is longer
    assert picture.depth[15, 20] == pytest.approx(2.0, rel=1e-2)
    assert picture.depth[0, 39] == pytest.approx(2.0 / math.sqrt(1 + (19.5 / 20) ** 2 + (14.5 / 20) ** 2), rel=1e-5)
    looks = Looking(camera, look.world_from_cam, 2, 1, "changed")
    assert looks.states == (2, 1)
    grey = (np.array([255, 0, 0]).mean(), np.array([127.5, 0, 0]).mean())
    for pair, shade, ink in (([now, was], grey[0], IS), ([was, now], grey[1], WAS)):
        shown = composed(looks, camera, pair).rgb[5, 5].astype(float)
        assert shown == pytest.approx(0.5 * shade + 0.5 * np.array(ink), abs=1.5)
    nothing = Rendering(now.rgb * 0, now.depth * 0, now.opacity * 0)
    empty = composed(Looking(camera, look.world_from_cam, 2, layer="depth"), camera, [nothing])
    assert not empty.rgb.any() and np.isinf(empty.depth).all()


def test_a_standing_view_gets_finer_and_stops_when_it_is_left(scenery):
    shown, finest = [], threading.Event()
    camera = Camera(60, 40, 60.0, 60.0, 30.0, 20.0)

    def show(picture):
        shown.append(picture.rgb.shape)
        if len(shown) == 3:
            finest.set()

    view = StandingView(scenery.field, show, Turns())
    view.start()
    pose = scenery.capture.frames[0].world_from_cam
    try:
        view.look(Looking(camera, pose, 1))
        view.look(None)  # gone before it stood
        view.look(Looking(camera, pose, 1, 0))
        assert finest.wait(30)
        assert [s[1] for s in shown] == [9, 24, 60]
        view.look(Looking(camera, pose, 1, 0, "sharp", 0.5))  # a wipe begins with what is known
    finally:
        view.end()


def test_who_waits_for_a_picture_goes_first():
    turns, order, begun = Turns(), [], threading.Event()

    def long():
        with turns.later():
            begun.set()
            for _ in range(1000):
                turns.give_way()
                if "urgent" in order:
                    break
                threading.Event().wait(0.01)
            order.append("later")

    worker = threading.Thread(target=long)
    worker.start()
    assert begun.wait(5)
    with turns.first():
        order.append("urgent")
    worker.join(20)
    assert order == ["urgent", "later"]


def test_splats_are_kept_until_the_state_is_another(work, tmp_path):
    shutil.copytree(work, tmp_path / "work")
    workspace = Workspace.open(tmp_path / "work")
    scenery = Scenery(workspace, 3000, pytest.fail)
    made = scenery.make_splats(1)
    (kept,) = (workspace.path / ".view").iterdir()
    again = Scenery(workspace, 3000, pytest.fail).splats(0)  # nothing was updated at the visit: the same state
    assert again is not None and torch.equal(again.means, made.means)
    assert Scenery(workspace, 2000, pytest.fail).splats(0) is None
    kept.write_bytes(b"no tensors")
    assert Scenery(workspace, 3000, pytest.fail).splats(0) is None
    on_box = (made.means - torch.tensor([0.0, 0.0, 0.25])).abs().amax(1) < 0.2
    assert int(on_box.sum()) > 20 and len(made) < 12_000


def test_a_page_is_written_whole_and_holds_everything(work, tmp_path, capsys):
    out = tmp_path / "scene.html"
    assert main(["view", str(work), "--static", str(out), "--splats", "2000"]) == 0
    assert "2 states" in capsys.readouterr().out
    page = out.read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>") and 5e5 < len(page) < 4e6
    assert "Three objects" not in page and "One object moved, one is gone, one is new" in page
    assert page.count('<figure class="wipe"') == 1 and page.count('src="data:image/jpeg') >= 2
    assert "default-src 'none'" in page and 'src="http' not in page and 'href="http' not in page
    assert list(tmp_path.iterdir()) == [out]
    assert main(["view", str(work), "--static", str(out), "--splats", "2000", "--quiet"]) == 0  # our own is replaced
    (tmp_path / "mine.html").write_text("mine")
    for wrong in (tmp_path / "mine.html", tmp_path, work / "visits" / "x.html"):
        assert main(["view", str(work), "--static", str(wrong)]) == 2
    assert main(["view", str(work), "--splats", "3"]) == 2 and (tmp_path / "mine.html").read_text() == "mine"


def test_pages_of_other_sites_are_refused(work):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    from refield.view.server import Viewer

    with Viewer(Workspace.open(work), pytest.fail, port=0, splats=2000) as viewer:
        address = viewer.url.replace("http", "ws")
        assert address.startswith("ws://127.0.0.1:")
        protocol = [f"viser-v{viser.__version__}"]
        with connect(address, origin=viewer.url, subprotocols=protocol) as ours:
            assert ours.recv(timeout=10)
        with pytest.raises(InvalidStatus, match="403"), connect(address, origin="http://evil.example"):
            pass


def test_who_has_gone_is_drawn_for_without_a_word():
    from refield.view.server import opened_server, stop

    server = opened_server(0)
    stop(server)
    server.scene.set_background_image(np.zeros((4, 4, 3), np.uint8), format="jpeg")  # a warning is an error in tests
