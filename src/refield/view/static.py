"""The scene as one HTML file that needs no server and no network: states to step through, boxes, photos, words, and our
own pictures of each visit to wipe between.

viser plays what a server was told back in time; each second of that is a state, with or without boxes and photos, and
the page's own controls go to it. The page is viser's client, about 0.8 MB, with the scene inside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from importlib import resources
from typing import TYPE_CHECKING, Any

from refield.report.page import GENERATOR
from refield.scene.errors import InputError
from refield.view.cast import cloud_of
from refield.view.draw import POINTS, STATE, draw_points, draw_splats, set_stage
from refield.view.marks import CAMERAS, MARKS, Shot, draw_marks, draw_shot, frustum_size, pictured, shots_of
from refield.view.scenery import Scenery
from refield.view.server import opened_server, stop
from refield.view.stage import first_look
from refield.view.told import told
from refield.view.wipe import wipe

if TYPE_CHECKING:
    from viser import SceneApi, ViserServer
    from viser.infra import StateSerializer

ALL_SPLATS = 400_000
"""of all states of a page together, about and at most"""
_FEWEST = 20_000  # of a state
_OLD_SHOTS = 24
_POINTS = 1 / 4  # of the splats
OnStage = Callable[[str], None]


def static_page(scenery: Scenery, on_stage: OnStage = lambda name: None) -> str:
    """The page, of all states of a workspace.

    Raises:
        InputError: an artefact cannot be read.
    """
    look = first_look(scenery.stage, scenery.capture.frames, scenery.world)
    server = opened_server(0)
    try:
        set_stage(server.scene, scenery.world)
        camera = server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = look.position, look.look_at, look.up, look.fov
        html = _recorded(server, scenery, on_stage)
    finally:
        stop(server)
    on_stage("before and after")
    wipes = [wipe(scenery, visit) for visit in range(1, scenery.latest + 1)]
    return _page(html, scenery, wipes)


def splats_of_a_page(states: int, most: int) -> int:
    """How many splats each of so many states has on a page, where a server shows ``most``."""
    return min(most, max(ALL_SPLATS // states, _FEWEST))


def _recorded(server: ViserServer, scenery: Scenery, on_stage: OnStage) -> str:
    """viser's own page, which plays all states one after the other."""
    scene, tape = server.scene, server.get_scene_serializer()
    groups = [scene.add_frame(name, show_axes=False) for name in (CAMERAS, MARKS)]
    before: list[Any] = []
    old = [s for s in shots_of(scenery.capture.frames, None) if not s.new][:_OLD_SHOTS]
    size = frustum_size(scenery.stage, scenery.capture.frames)
    for visit in range(scenery.latest + 1):
        on_stage(f"splats of visit {visit}")
        splats = scenery.make_splats(visit)
        scene.remove_by_name(POINTS)
        draw_splats(scene, scenery.stage, splats)
        for node in before:
            node.visible = False
        change = scenery.changes[visit - 1] if visit else None
        before = [scene.add_frame(f"{name}/{visit}", show_axes=False) for name in (CAMERAS, MARKS)]
        shots = shots_of((), change) if change is not None else old
        _draw_shots(scene, scenery, shots, size, f"{CAMERAS}/{visit}")
        if change is not None:
            draw_marks(scene, scenery.stage, change, scenery.world, f"{MARKS}/{visit}")
        _play_switches(tape, groups)
        scene.remove_by_name(STATE)  # a splat that is hidden takes a browser some time, too
        draw_points(scene, scenery.stage, cloud_of(splats).thinned(_POINTS))
        _play_switches(tape, groups)
    return tape.as_html()


def _play_switches(tape: StateSerializer, groups: Sequence[Any]) -> None:
    """A second for each way to show some of the groups: the first is the lowest bit."""
    for step in range(1 << len(groups)):
        for bit, group in enumerate(groups):
            group.visible = bool(step >> bit & 1)
        tape.insert_sleep(1.0)


def _draw_shots(scene: SceneApi, scenery: Scenery, shots: Sequence[Shot], size: float, under: str) -> None:
    for shot in shots:
        try:
            filled = pictured(shot)
        except InputError as error:
            scenery.warn(str(error))
            filled = shot
        draw_shot(scene, scenery.stage, filled, size, under=under)


def _page(html: str, scenery: Scenery, wipes: Sequence[str]) -> str:
    """viser's page with controls of ours beside its picture, and nothing that could reach the network.

    ``wipes``: for each visit, see `wipe`.
    """
    name = escape(scenery.workspace.path.resolve().name)
    changes = [None, *scenery.changes]
    texts = [told(n, change, scenery.world) for n, change in enumerate(changes)]
    shown = zip(texts, ["", *wipes])
    words = "".join(f'<section class="visit" hidden>{text}{pair}</section>' for text, pair in shown)
    # viser's own script unpacks itself, and sorts splats in a worker that it makes of text
    policy = (
        "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; font-src data:; connect-src data: blob:; "
        "script-src 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; worker-src blob: data:; "
        "base-uri 'none'; form-action 'none'"
    )
    guard = f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    head = f"{guard}{GENERATOR}<style>{_resource('static.css')}</style>"
    html = html.replace('<meta charset="utf-8" />', f'<meta charset="utf-8" />{head}', 1)
    html = html.replace("<title>Viser</title>", f"<title>{name}</title>", 1)
    latest = scenery.latest
    aside = (
        f'<aside><h1>{name}</h1><label for="visit">Visit <output id="number">{latest}</output></label>'
        f'<input type="range" id="visit" max="{max(latest, 1)}" value="{latest}"{"" if latest else " disabled"}>'
        '<p class="switches"><label><input type="checkbox" id="marks" checked> boxes and numbers</label>'
        f'<label><input type="checkbox" id="photos"> photos</label>'
        f'<label><input type="checkbox" id="points"> points, which are drawn quicker</label></p>{words}'
        '<p class="soft">Drag to turn, scroll to come nearer, drag with the right button to go aside.</p></aside>'
    )
    script = f"<script>{_resource('static.js')}</script>"
    root = '<div id="root"></div>'
    assert html.count(root) == 1, "viser's page has changed"
    return html.replace(root, f"{root}{aside}{script}")


def _resource(name: str) -> str:
    return resources.files("refield.view").joinpath(name).read_text(encoding="utf-8")
